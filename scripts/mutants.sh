#!/bin/sh
# Breaks the product in one place after the other, with cargo-mutants, and lists what no test notices:
#
#   scripts/mutants.sh policy|config|accounting [ARGUMENT OF cargo mutants…]
#
# for example scripts/mutants.sh policy -F TokenBucket. .cargo/mutants.toml has what is left out, each with its reason.
# The result is in target/mutants/PART/mutants.out; docs/mutations.md has the last one. Each mutation of the policy takes
# seconds, each of the others a build of the library.
set -eu
cd "$(dirname "$0")/.."
PATH="$PATH:${CARGO_HOME:-$HOME/.cargo}/bin"
part=${1:-policy}
[ $# -eq 0 ] || shift

if ! cargo mutants --version >/dev/null 2>&1; then
    cargo install cargo-mutants --locked
fi

source=$PWD
output=$source/target/mutants/$part
mkdir -p "$output"
copy=$(mktemp -d)
trap 'rm -rf "$copy"' EXIT
git ls-files -z --cached --others --exclude-standard | xargs -0 cp --parents --target-directory="$copy"
export CARGO_TARGET_DIR="$source/target/mutants/build"

case $part in
policy)
    # The tests of tests/pure that need only this package, so that a mutation does not rebuild the others.
    mkdir -p "$copy/crates/policy/tests"
    cat >"$copy/crates/policy/tests/pure.rs" <<'END'
//! The tests of the policy in virtual time.
extern crate adaptive_bridge_policy as adaptive_bridge;
#[path = "../../../tests/pure/control_policy/mod.rs"]
mod control_policy;
#[path = "../../../tests/pure/patterns.rs"]
mod patterns;
#[path = "../../../tests/pure/policy.rs"]
mod policy;
END
    set -- --package adaptive-bridge-policy "$@" -- --lib --test pure
    ;;
config)
    set -- --package adaptive-bridge --file 'src/config/**' "$@" -- --lib --test pure
    ;;
accounting)
    # The counters of both processes, and the boards on which they are. tests/dds and tests/shm run the bridge.
    set -- --package adaptive-bridge --file src/shm/board.rs \
        --file 'src/process/egress/{former_samples,output,unsent}.rs' \
        --file 'src/process/egress/output/{catch_up,former,matching,missing}.rs' \
        --file 'src/process/ingress/{input,publishers}.rs' "$@" -- \
        --lib --test shm --test dds
    ;;
*)
    echo "mutants: $part is not policy, config or accounting" >&2
    exit 2
    ;;
esac
cd "$copy"
nice -n 10 cargo mutants --in-place --cargo-arg=--locked --timeout 300 --output "$output" "$@"
