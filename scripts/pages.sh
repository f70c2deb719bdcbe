#!/usr/bin/env bash
# Writes docs/operators: the pages, and their pictures by the commands that stand in them.
set -euo pipefail
cd "$(dirname "$0")/.."

vdb_edit=${VDB_EDIT:-}
if [ -z "$vdb_edit" ]; then
    cargo build --release --locked
    vdb_edit=${CARGO_TARGET_DIR:-target}/release/vdb-edit
fi
vdb_edit=$(realpath "$vdb_edit")
root=$PWD
"$vdb_edit" man --markdown -o docs/operators
mkdir -p docs/operators/images
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
ln -s "$root/assets" "$scratch/assets"
vdb-edit() { "$vdb_edit" "$@" --quiet; }
cd "$scratch"
for page in "$root"/docs/operators/*.md; do
    name=$(basename "$page" .md)
    commands=$(sed -n '/^```sh$/,/^```$/p' "$page" | grep '^vdb-edit ' || true)
    [ -n "$commands" ] || continue
    eval "$commands"
    cp "$name.png" "$root/docs/operators/images/"
done
