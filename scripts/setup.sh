#!/usr/bin/env bash
# Installs the system packages that are missing, and nothing when all are there (then no network and no root is needed).
#
#   scripts/setup.sh build               what the build needs: a C++ compiler, make, OpenVDB and its headers
#   scripts/setup.sh blender             shared libraries that Blender's Python module loads (tests/blender)
#   scripts/setup.sh packages NAME...    these packages
set -euo pipefail

# libopenvdb-dev 10 includes Boost headers without depending on them; TBB and Imath are linked directly.
openvdb_packages=(libopenvdb-dev libboost-dev libtbb-dev libimath-dev)
blender_packages=(libgl1 libice6 libsm6 libuuid1 libx11-6 libxext6 libxfixes3 libxi6 libxkbcommon0 libxrender1)

say() { printf 'setup: %s\n' "$*" >&2; }
have() { command -v "$1" >/dev/null 2>&1; }

installed() { [ "$(dpkg-query -W -f '${db:Status-Status}' "$1" 2>/dev/null)" = installed ]; }

as_root() {
    if [ "$(id -u)" -eq 0 ]; then
        "$@"
    elif [ -t 0 ]; then
        sudo "$@"
    else
        # Without a terminal a password prompt would wait for ever.
        sudo --non-interactive "$@"
    fi
}

apt_install() {
    as_root env DEBIAN_FRONTEND=noninteractive apt-get install --yes --no-install-recommends \
        -o DPkg::Lock::Timeout=120 "$@" </dev/null
}

# ensure NAME...: installs those packages that are not there.
ensure() {
    local missing=() name
    if ! have dpkg-query || ! have apt-get; then
        say "not a Debian or Ubuntu system; these must be present under the names they have here: $*"
        return 0
    fi
    for name in "$@"; do
        installed "$name" || missing+=("$name")
    done
    [ ${#missing[@]} -gt 0 ] || return 0

    local by_hand="apt-get update && apt-get install --yes --no-install-recommends ${missing[*]}"
    if [ "$(id -u)" -ne 0 ] && ! have sudo; then
        say "missing packages: ${missing[*]}; run as root: $by_hand"
        return 1
    fi
    say "installing ${missing[*]}"
    # Package lists that are present are usually good enough, and then no update is needed.
    if apt_install "${missing[@]}" >/dev/null 2>&1; then
        return 0
    fi
    if ! as_root apt-get update </dev/null >&2 || ! apt_install "${missing[@]}" >&2; then
        say "could not install ${missing[*]}; run as root: $by_hand"
        return 1
    fi
}

build() {
    local needed=()
    have c++ || have g++ || needed+=(g++)
    have make || needed+=(make)
    # Someone who points at an OpenVDB of their own does not want the distribution's.
    if [ -z "${OPENVDB_ROOT:-}${OPENVDB_INCLUDE_DIR:-}" ]; then
        needed+=("${openvdb_packages[@]}")
    fi
    if [ ${#needed[@]} -gt 0 ]; then
        ensure "${needed[@]}"
    fi
    if ! have cargo; then
        say "cargo was not found; install Rust 1.89 or newer from https://rustup.rs and run this again"
        return 1
    fi
}

case "${1:-build}" in
    build) build ;;
    blender) ensure "${blender_packages[@]}" ;;
    packages)
        shift
        [ $# -gt 0 ] || { say "packages: no name given"; exit 2; }
        ensure "$@"
        ;;
    *)
        say "unknown set '$1'; accepted: build, blender, packages NAME..."
        exit 2
        ;;
esac
