#!/usr/bin/env bash
# Runs every recipe of examples/recipes and keeps its pictures: results in out/gallery, pictures in docs/images/gallery.
set -euo pipefail
cd "$(dirname "$0")/.."

out=${OUT:-out}/gallery
pictures=docs/images/gallery
vdb_edit=${VDB_EDIT:-}
if [ -z "$vdb_edit" ]; then
    cargo build --release --locked
    vdb_edit=${CARGO_TARGET_DIR:-target}/release/vdb-edit
fi
mkdir -p "$out" "$pictures"
recipes=("$@")
[ $# -gt 0 ] || recipes=(examples/recipes/*.toml)
for recipe in "${recipes[@]}"; do
    case $recipe in
        # An animation: four of its frames.
        *superquadrics.toml) "$vdb_edit" run "$recipe" -o "$out" --frames 1,9,17,24 ;;
        *) "$vdb_edit" run "$recipe" -o "$out" ;;
    esac
done
cp "$out"/*.png "$pictures"
