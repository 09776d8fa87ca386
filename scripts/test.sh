#!/bin/sh
# Runs all checks that must pass before a change is merged: set-up, lints, tests, fuzzing.
#
# FUZZ_SECONDS: how long each fuzz target runs (default 10). With CI set, skipped tests are failures.
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
    if [ "$result" -eq 0 ]; then echo "test: passed"; else echo "test: FAILED"; fi
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
# Most tests wait for DDS and for leases to run out. Those that load the machine run alone (tests/support), and of the
# others with network namespaces three at a time.
step env RUST_TEST_THREADS="${RUST_TEST_THREADS:-4}" cargo test --locked --workspace --no-fail-fast
# The tests of the patched DDS library, a separate package with its own development dependencies.
export CARGO_PROFILE_DEV_DEBUG=line-tables-only
step cargo test --locked --manifest-path third_party/rustdds/Cargo.toml --lib --target-dir target/rustdds
step scripts/fuzz.sh "${FUZZ_SECONDS:-10}"
