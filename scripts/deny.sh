#!/usr/bin/env bash
# Licences, origins and known faults of everything that is linked (deny.toml), by cargo-deny: `cargo install --locked cargo-deny`
# once. Without the network the licences, origins and versions are checked, and it is said that the faults are not.
set -euo pipefail
cd "$(dirname "$0")/.."

if ! cargo deny --version >/dev/null 2>&1; then
    echo 'cargo-deny is missing: cargo install --locked cargo-deny' >&2
    exit 1
fi
cargo deny --locked --offline check licenses bans sources
cargo deny --locked fetch db || { echo 'advisories: not checked, the database cannot be had' >&2; exit 0; }
cargo deny --locked check advisories
