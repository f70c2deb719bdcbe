#!/usr/bin/env bash
# An editing session on two real models: a cow and a goat's head become level sets, the head is moved to the cow's
# rump, the two are united, and the seam is smoothed inside a sphere. Leaves .vdb, .obj and .png files in out/.
set -euo pipefail
cd "$(dirname "$0")/.."

out=${OUT:-out}
# Voxels along the cow. The head ends up at three fifths of that length, so that both have voxels of the same size.
resolution=${RESOLUTION:-256}
head_resolution=$((resolution * 3 / 5))

# Seconds with milliseconds, as an integer of milliseconds, without a process of its own.
now_ms() { local t=${EPOCHREALTIME/[.,]/}; echo $((t / 1000)); }
seconds() { printf '%d.%02d s' $(($1 / 1000)) $(($1 % 1000 / 10)); }

step() {
    local title=$1 start shown='' word
    shift
    # As one would type it: an argument that has spaces needs its quotes.
    for word in "$@"; do
        case $word in
            *' '*) shown+=" '$word'" ;;
            *) shown+=" $word" ;;
        esac
    done
    printf '\n%s\n  $%s\n' "$title" "$shown"
    start=$(now_ms)
    "$@"
    printf '  %s\n' "$(seconds $(($(now_ms) - start)))"
}

began=$(now_ms)
step 'Build (the first one takes minutes)' cargo build --release --locked
export PATH="${CARGO_TARGET_DIR:-$PWD/target}/release:$PATH"
mkdir -p "$out"

session=$(now_ms)
step 'A cow becomes a level set' \
    vdb-edit convert assets/spot.obj -o "$out/spot.vdb" --resolution "$resolution"
step "So does a goat's head" \
    vdb-edit convert assets/goathead.obj -o "$out/goathead.vdb" --resolution "$head_resolution"
# The goat looks along -x and its neck is open towards +x and -y; the cow looks along -z and its rump is at z = 0.9.
step 'The head is scaled, turned and put onto the rump' \
    vdb-edit transform "$out/goathead.vdb" -o "$out/goathead-placed.vdb" \
    --scale 0.065 --rotate y,90 --rotate x,-20 --translate -0.045,0.33,0.9
step 'The two are united' \
    vdb-edit csg union "$out/spot.vdb" "$out/goathead-placed.vdb" -o "$out/union.vdb"
# The seam lies within 0.29 of this centre.
step 'The seam is smoothed, inside a sphere' \
    vdb-edit smooth "$out/union.vdb" -o "$out/chimera.vdb" --method curvature --iterations 200 \
    --region 'sphere center=0,0.12,0.775 radius=0.36'
step 'The result becomes a mesh' \
    vdb-edit convert "$out/chimera.vdb" -o "$out/chimera.obj"
step 'A picture before' \
    vdb-edit render "$out/union.vdb" -o "$out/before.png" --size 960x720
step 'A picture after' \
    vdb-edit render "$out/chimera.vdb" -o "$out/after.png" --size 960x720
step 'The invariants of a level set hold' \
    vdb-edit info "$out/chimera.vdb" --check

finished=$(now_ms)
cat <<END

Done in $(seconds $((finished - began))), of which the session took $(seconds $((finished - session))).
  $out/chimera.vdb   the edited level set, for Houdini, Blender and everything that reads OpenVDB
  $out/chimera.obj   the same as a mesh
  $out/before.png    the union, with its crease
  $out/after.png     the smoothed seam
END
