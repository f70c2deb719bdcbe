#!/usr/bin/env bash
# Does Blender take a level set of this tool for what it is? Makes one from assets/spot.obj and lets headless Blender
# (the PyPI package bpy, in a virtual environment under target/) load it, mesh it and measure it: see check.py.
#
# The last line is `blender check: P passed, F failed, S skipped`; a check that cannot be run here is skipped, not passed.
#   VDB_EDIT_BLENDER=skip      do not try (it downloads 374 MB and takes 1 GB)
#   VDB_EDIT_BLENDER=require   a check that cannot be run has failed
#   VDB_EDIT=PATH              the command to test, instead of building it
set -euo pipefail
cd "$(dirname "$0")/../.."

bpy_version=5.0.1
wanted=${VDB_EDIT_BLENDER:-try}
target=${CARGO_TARGET_DIR:-target}
venv=$target/blender-venv
work=$target/blender-check

finish() { # passed failed skipped
    echo "blender check: $1 passed, $2 failed, $3 skipped"
    [ "$2" -eq 0 ]
    exit
}

skip() {
    echo "blender check cannot be run: $*" >&2
    if [ "$wanted" = require ]; then finish 0 1 0; else finish 0 0 1; fi
}

# bpy 5.0.1 exists for CPython 3.11 alone.
find_python() {
    local candidate
    for candidate in python3.11 /usr/bin/python3.11 python3; do
        if "$candidate" -c 'import sys; sys.exit(sys.implementation.name != "cpython" or sys.version_info[:2] != (3, 11))' \
            2>/dev/null; then
            echo "$candidate"
            return 0
        fi
    done
    return 1
}

has_bpy() {
    [ -x "$venv/bin/python" ] &&
        "$venv/bin/python" -c "import bpy, sys; sys.exit(bpy.app.version_string != '$bpy_version')" >/dev/null 2>&1
}

make_venv() {
    local python
    python=$(find_python) || skip "there is no CPython 3.11, the only version that bpy $bpy_version is made for"
    scripts/setup.sh blender || skip "shared libraries that bpy needs are missing"
    # The libraries may have been all that was missing.
    ! has_bpy || return 0
    if ! "$python" -c 'import ensurepip' 2>/dev/null; then
        scripts/setup.sh packages python3.11-venv || skip "$python cannot make virtual environments"
    fi
    echo "installing bpy $bpy_version into $venv"
    rm -rf "$venv"
    "$python" -m venv "$venv" || skip "$python could not make the virtual environment $venv"
    if ! timeout 900 "$venv/bin/python" -m pip install --quiet --disable-pip-version-check --no-input --no-cache-dir \
        --only-binary=:all: "bpy==$bpy_version" </dev/null; then
        rm -rf "$venv"
        skip "bpy $bpy_version could not be installed"
    fi
    has_bpy || skip "bpy $bpy_version is installed in $venv and cannot be imported: $(
        "$venv/bin/python" -c 'import bpy' 2>&1 | tail -n 1
    )"
}

[ "$wanted" != skip ] || skip "VDB_EDIT_BLENDER=skip"
has_bpy || make_venv

if [ -z "${VDB_EDIT:-}" ]; then
    cargo build --locked || finish 0 1 0
    VDB_EDIT=$target/debug/vdb-edit
fi
mkdir -p "$work"
"$VDB_EDIT" convert assets/spot.obj -o "$work/spot.vdb" --resolution 128 || finish 0 1 0
"$VDB_EDIT" info "$work/spot.vdb" --json >"$work/info.json" || finish 0 1 0
expected=$("$venv/bin/python" tests/blender/expect.py "$work/info.json" assets/spot.obj) || finish 0 1 0
mapfile -t expected <<<"$expected"

status=0
"$venv/bin/python" tests/blender/check.py "$work/spot.vdb" "${expected[@]}" --png "$work/spot.png" \
    >"$work/check.log" 2>&1 || status=$?
cat "$work/check.log"
passed=$(grep -c '^ok ' "$work/check.log" || true)
failed=$(grep -c '^FAILED ' "$work/check.log" || true)
# A crash of Blender must not look like success.
if [ "$status" -ne 0 ] && [ "$failed" -eq 0 ]; then failed=1; fi
finish "$passed" "$failed" 0
