#!/bin/sh
# Runs a command where programs are built for arm64 and run by QEMU: scripts/arm64.sh COMMAND…
#
# That is a container of Debian testing (docker/arm64), which the first call makes: a few minutes, 3 GB. Its
# cargo builds for arm64, into target/arm64. It has this folder, the downloaded crates, and no network.
set -eu
cd "$(dirname "$0")/.."
cargo_home=${CARGO_HOME:-$HOME/.cargo}
PATH="$PATH:/usr/local/sbin:/usr/sbin:/sbin:$cargo_home/bin"

image=adaptive-bridge-arm64
base=debian:testing-slim
bootstrapped=adaptive-bridge-arm64-base
fail() { echo "arm64: $*" >&2; exit 1; }
has_image() { docker image inspect "$1" >/dev/null 2>&1; }

docker info >/dev/null 2>&1 \
    || fail "the Docker Engine does not answer: apt-get install docker.io, and run this as root or in group docker"
if has_image $bootstrapped; then
    base=$bootstrapped
elif ! has_image $base && ! docker pull --quiet $base >/dev/null 2>&1; then
    # Without a registry Debian's own tool makes the like.
    if ! command -v debootstrap >/dev/null || [ "$(id -u)" -ne 0 ]; then
        fail "the image $base is not available: apt-get install debootstrap, and run this as root"
    fi
    root=$(mktemp -d)
    trap 'rm -rf --one-file-system "$root"' EXIT
    debootstrap --variant=minbase testing "$root" >&2
    tar -C "$root" -c . | docker import - $bootstrapped >&2
    base=$bootstrapped
fi
# The builder that every engine has. It builds again only what has changed.
log=$(DOCKER_BUILDKIT=0 docker build --network host --build-arg BASE_IMAGE=$base --tag $image docker/arm64 2>&1) \
    || fail "the image cannot be built: $log"
cargo fetch --locked --quiet

set -- $image "$@"
if cargo_deb=$(command -v cargo-deb); then set -- --volume "$cargo_deb:/usr/local/bin/cargo-deb:ro" "$@"; fi
# Unconfined, because QEMU is registered for the command in a user namespace.
docker run --rm --init --network none --user "$(id -u):$(id -g)" --shm-size 1g \
    --security-opt seccomp=unconfined --security-opt apparmor=unconfined \
    --volume "$PWD:$PWD" --volume "$cargo_home/registry:/cargo/registry" --workdir "$PWD" "$@"
