#!/bin/sh
# Runs each fuzz target for a number of seconds, 10 by default: scripts/fuzz.sh [SECONDS [TARGET…]]
#
# A run begins with the inputs in fuzz/seeds and fuzz/regressions, which tests/pure/regressions.rs also runs, and with the
# inputs that earlier runs on this machine found (fuzz/corpus).
set -eu
cd "$(dirname "$0")/.."
PATH="$PATH:${CARGO_HOME:-$HOME/.cargo}/bin"
seconds=${1:-10}
[ $# -eq 0 ] || shift

if ! cargo fuzz --version >/dev/null 2>&1; then
    cargo install cargo-fuzz --locked
fi

# Lets a stable toolchain use the sanitizers, which are features of nightly. It is set only for builds in cargo-fuzz'
# own target directory, because cargo rebuilds everything when it changes.
export RUSTC_BOOTSTRAP=1
# Link-time optimisation takes minutes and does not help to find bugs.
export CARGO_PROFILE_RELEASE_LTO=off
# Neither does the last of the speed: with coverage and the address sanitizer, much of the time goes to them.
export CARGO_PROFILE_RELEASE_OPT_LEVEL=1
all=$(cargo fuzz list)
if [ $# -eq 0 ]; then
    # Word splitting is intended: the list has one target per word.
    # shellcheck disable=SC2086
    set -- $all
fi
if [ $# -eq 0 ]; then
    echo "fuzz: there are no targets"
    exit 1
fi

echo "fuzz: building"
cargo fuzz build
logs=$(mktemp -d)
trap 'rm -rf "$logs"' EXIT

# Runs one target, and prints how many inputs it executed; or the log, if it failed.
run() {
    target=$1
    log=$logs/$target
    corpus=fuzz/corpus/$target
    mkdir -p "$corpus" "fuzz/regressions/$target"
    # The default configuration file has 5 KiB, so inputs may have 8 KiB. An input that takes longer than 10 s counts
    # as a crash.
    if ! cargo fuzz run "$target" "$corpus" "fuzz/seeds/$target" "fuzz/regressions/$target" -- \
        -max_total_time="$seconds" -max_len=8192 -timeout=10 -rss_limit_mb=2048 \
        -print_final_stats=1 -verbosity=0 >"$log" 2>&1; then
        cat "$log"
        input=$(sed -n 's/.*Test unit written to \.*\/*//p' "$log" | tail -n 1)
        echo "fuzz: $target FAILED. To reproduce: RUSTC_BOOTSTRAP=1 cargo fuzz run $target ${input:-INPUT}"
        echo "fuzz: after the fix, keep the input: mv ${input:-INPUT} fuzz/regressions/$target/"
        return 1
    fi
    executions=$(sed -n 's/^stat::number_of_executed_units: *//p' "$log")
    echo "fuzz: $target: ${executions:-?} executions in $seconds s"
    rmdir "fuzz/regressions/$target" 2>/dev/null || true
}

# As many targets at once as there are CPUs; each has one thread.
at_once=$(nproc)
while [ $# -gt 0 ]; do
    running=""
    while [ $# -gt 0 ] && [ "$(echo "$running" | wc -w)" -lt "$at_once" ]; do
        run "$1" &
        running="$running $!"
        shift
    done
    failed=0
    for process in $running; do
        wait "$process" || failed=1
    done
    if [ "$failed" -ne 0 ]; then exit 1; fi
done
