#!/usr/bin/env bash
# Our parsers on input that is guided by coverage (libFuzzer, with AddressSanitizer), FUZZ_SECONDS each: needs a nightly compiler and
# `cargo install --locked cargo-fuzz`. Arguments are names of targets; all if none are given.
set -euo pipefail
cd "$(dirname "$0")/.."

if ! cargo +nightly fuzz --version >/dev/null 2>&1; then
    echo 'cargo-fuzz or a nightly compiler is missing: rustup toolchain install nightly; cargo install --locked cargo-fuzz' >&2
    exit 1
fi
targets=("$@")
[ $# -gt 0 ] || targets=(texts recipes meshes scans ranges points)
seconds=${FUZZ_SECONDS:-600}
for target in "${targets[@]}"; do
    mkdir -p "fuzz/corpus/$target"
    cargo +nightly fuzz run "$target" "fuzz/corpus/$target" "fuzz/seeds/$target" -- \
        "-max_total_time=$seconds" -max_len=8192 -timeout=10 -rss_limit_mb=4096 -print_final_stats=1
done
