#!/bin/sh
# Makes the Debian package, with manual pages and completions: scripts/package.sh [OPTIONS OF CARGO DEB…]
#
# ARCH: its architecture, that of this machine or arm64, which is built in a container (scripts/arm64.sh).
# PROGRAM: an executable to package; without it, the script builds one.
set -eu
cd "$(dirname "$0")/.."
PATH="$PATH:${CARGO_HOME:-$HOME/.cargo}/bin"

if ! cargo deb --version >/dev/null 2>&1; then
    cargo install cargo-deb --locked
fi
case "${ARCH:-}" in
'' | "$(dpkg --print-architecture)" | "$(uname -m)") ;;
arm64) exec scripts/arm64.sh env PROGRAM="${PROGRAM:-}" scripts/package.sh "$@" ;;
*)
    echo "package: ARCH=$ARCH is neither this machine's architecture nor arm64" >&2
    exit 2
    ;;
esac
# Where cargo and cargo-deb have executables of another architecture.
release=${CARGO_BUILD_TARGET:+$CARGO_BUILD_TARGET/}release
if [ -z "${PROGRAM:-}" ]; then
    cargo build --locked --release --bin adaptive-bridge
    PROGRAM=${CARGO_TARGET_DIR:-target}/$release/adaptive-bridge
fi

made=target/package
rm -rf $made
mkdir -p $made/man $made/completions "$made/$release" target/debian
# By itself cargo-deb keeps the line tables of the profile, most of the program.
"${STRIP:-strip}" -o "$made/$release/adaptive-bridge" "$PROGRAM"
"$made/$release/adaptive-bridge" man $made/man
for shell in bash fish zsh; do
    "$made/$release/adaptive-bridge" completions $shell >$made/completions/$shell
done
# cargo-deb expects the executable in a target directory.
CARGO_TARGET_DIR=$made cargo deb --locked --no-build --output target/debian/ "$@"
