#!/bin/sh
# Runs each fuzz target for so many seconds: scripts/fuzz.sh SECONDS [TARGET…]
set -eu
cd "$(dirname "$0")/.."
seconds=$1
shift

# The sanitizers are nightly's; this lets a stable toolchain have them. Only cargo-fuzz' own target directory is
# built with it: to change it between builds makes cargo build everything anew.
export RUSTC_BOOTSTRAP=1
if [ $# -eq 0 ]; then
    # The list is words.
    # shellcheck disable=SC2046
    set -- $(cargo fuzz list)
fi
if [ $# -eq 0 ]; then
    echo "fuzz: there are no targets"
    exit 1
fi
for target in "$@"; do
    echo "fuzz: $target for $seconds s"
    cargo fuzz run "$target" -- -max_total_time="$seconds" -rss_limit_mb=2048 -print_final_stats=1 -verbosity=0
done
