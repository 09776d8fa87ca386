#!/bin/sh
# Everything that must be right before a change goes in: set-up, lints, tests, fuzzing.
#
# FUZZ_SECONDS: how long each fuzz target runs (20). With CI set nothing may be skipped.
set -eu
cd "$(dirname "$0")/.."
PATH="$PATH:${CARGO_HOME:-$HOME/.cargo}/bin"

skipped=target/skipped.txt
mkdir -p target
rm -f "$skipped"
list_skipped() {
    result=$?
    if [ -s "$skipped" ]; then
        echo
        echo "******** NOT RUN ON THIS MACHINE: $(wc -l <"$skipped") ********"
        sort "$skipped"
        echo "********"
    fi
    if [ "$result" -eq 0 ]; then echo "test: all that was run passed"; else echo "test: FAILED"; fi
}
trap list_skipped EXIT

step() {
    echo
    echo "==== $* (after $(($(date +%s) - begin)) s)"
    "$@"
}
begin=$(date +%s)

step scripts/setup.sh
step make --no-print-directory peers
step make --no-print-directory lint
# Tests that load the machine or use network namespaces wait for each other (tests/support), so plain
# parallel tests are right.
step cargo test --locked --all-features --no-fail-fast
# The patched DDS library's own ones; a package of its own, so its development dependencies are not ours.
step cargo test --locked --manifest-path third_party/rustdds/Cargo.toml --lib --target-dir target/rustdds
step scripts/fuzz.sh "${FUZZ_SECONDS:-20}"
