#!/usr/bin/env bash
# The bridge to OpenVDB under valgrind (reads and writes beyond what was allocated, memory used after it was freed or before it was
# set, leaks), its C++ compiled so that undefined behaviour ends the program (GCC's UndefinedBehaviorSanitizer, which needs no
# library when it traps). Valgrind sees OpenVDB's own code as well, which an instrumented build of the bridge alone would not.
#
# Arguments are names of test binaries and words of test names: vdb_files vdb_reference if none are given.
set -euo pipefail
cd "$(dirname "$0")/.."

command -v valgrind >/dev/null || { echo 'valgrind is missing (Debian: apt-get install valgrind)' >&2; exit 1; }
tests=("$@")
[ $# -gt 0 ] || tests=(vdb_files vdb_reference)
export CARGO_TARGET_DIR=${CARGO_TARGET_DIR:-target}/sanitize
mkdir -p "$CARGO_TARGET_DIR"
export CXXFLAGS='-g -fsanitize=undefined -fsanitize-undefined-trap-on-error -fno-sanitize=vptr'
build=()
for test in "${tests[@]}"; do build+=(--test "$test"); done
cargo test --locked --no-run --message-format=json "${build[@]}" |
    sed -n 's/.*"executable":"\([^"]*\)".*/\1/p' | grep '/deps/' | sort -u >"$CARGO_TARGET_DIR/sanitize.list"
failed=0
while read -r binary; do
    echo "=== $(basename "$binary")"
    # One test at a time: valgrind runs one thread at a time anyway.
    valgrind --quiet --error-exitcode=99 --leak-check=full --show-leak-kinds=definite --errors-for-leak-kinds=definite \
        --suppressions=scripts/valgrind.supp "$binary" --test-threads=1 || failed=1
done <"$CARGO_TARGET_DIR/sanitize.list"
[ "$failed" -eq 0 ] && echo 'sanitize: nothing found'
exit "$failed"
