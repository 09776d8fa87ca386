#!/bin/sh
# Runs the checks that must pass before a change is merged: scripts/test.sh [long]
#
# Without an argument: set-up, lints and all tests but the long ones. With `long`: the long tests, and each fuzz target for
# FUZZ_SECONDS (default 10). With CI set, skipped tests are failures.
set -eu
case "${1-}" in
"" | long) what="test${1:+-$1}" ;;
*) echo "usage: scripts/test.sh [long]" >&2; exit 2 ;;
esac
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
    if [ "$result" -eq 0 ]; then echo "$what: passed"; else echo "$what: FAILED"; fi
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
# Most tests wait for DDS and for leases to run out. Those that load the machine run alone (tests/support), and of the
# others with network namespaces three at a time.
export RUST_TEST_THREADS="${RUST_TEST_THREADS:-4}"
if [ "$what" = test-long ]; then
    step cargo test --locked --workspace --tests -- ::long::
    step scripts/fuzz.sh "${FUZZ_SECONDS:-10}"
    exit
fi
step make --no-print-directory lint
step cargo test --locked --workspace --no-fail-fast -- --skip ::long::
# The tests of the patched DDS library, a separate package with its own development dependencies.
export CARGO_PROFILE_DEV_DEBUG=line-tables-only
step cargo test --locked --manifest-path third_party/rustdds/Cargo.toml --lib --target-dir target/rustdds
