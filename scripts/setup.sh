#!/bin/sh
# Installs missing packages and tools for building and testing (Debian and Ubuntu). Safe to run again.
#
# It uses sudo only when a package is missing. Without root it lists what will not run, and continues.
set -eu

say() { echo "setup: $*"; }
has() { command -v "$1" >/dev/null 2>&1; }

# Adds the folders of ip and iptables, which are not in every user's path, and of cargo.
PATH="$PATH:/usr/local/sbin:/usr/sbin:/sbin:${CARGO_HOME:-$HOME/.cargo}/bin"

has_header() { [ -e "/usr/include/$1" ] || [ -e "/usr/local/include/$1" ]; }

# Whether a Python has a module: the first in the path or that of the system.
has_python() {
    for python in python3 /usr/bin/python3; do
        if "$python" -c "import $1" >/dev/null 2>&1; then return 0; fi
    done
    return 1
}

# Finds a CPython 3.11 on x86-64 that can make a virtual environment. PyPI has wheels of ROS 2 Jazzy only for it.
python_of_ros() {
    for python in python3.11 /usr/bin/python3.11 python3 /usr/bin/python3; do
        if "$python" -c 'import platform, sys, venv, ensurepip
found = platform.python_implementation(), sys.version_info[:2], platform.machine(), sys.platform
sys.exit(found != ("CPython", (3, 11), "x86_64", "linux"))' >/dev/null 2>&1; then
            echo "$python"
            return 0
        fi
    done
    return 1
}

has_faketime() { ls /usr/lib/*/faketime/libfaketimeMT.so.1 >/dev/null 2>&1; }

# need CHECK PACKAGES PURPOSE: adds the packages to the missing ones if the check fails. Of 'a|b' the first package
# that exists is installed.
missing=""
purposes=""
need() {
    check=$1 packages=$2 purpose=$3
    if eval "$check"; then return 0; fi
    missing="$missing $packages"
    purposes="$purposes
  $packages: $purpose"
}
check_all() {
    missing="" purposes=""
    need "has cc" build-essential "to link Rust programs"
    need "has g++" build-essential "the DDS peers of the tests, fuzzing"
    need "has make" build-essential "make"
    need "has pkg-config" pkg-config "building"
    need "has_header dds/ddsi/ddsi_serdata.h" cyclonedds-dev "tests between hosts (Cyclone DDS peer)"
    need "has idlc" cyclonedds-tools "tests between hosts (Cyclone DDS peer)"
    need "has_header fastdds/dds/topic/TopicDataType.hpp" "libfastrtps-dev|libfastdds-dev" \
        "tests between hosts (Fast DDS peer)"
    need "has_header fastcdr/Cdr.h" libfastcdr-dev "tests between hosts (Fast DDS peer)"
    need "has ip" iproute2 "tests between hosts (network namespaces)"
    need "has nsenter" util-linux "tests between hosts (network namespaces)"
    need "has iptables" iptables "tests with a lossy link, adaptive-bridge-eval impair"
    need "has tc" iproute2 "adaptive-bridge-eval impair (netem)"
    need "has strace" strace "system calls per sample in make bench"
    need "has_faketime" faketime "tests with a wall clock that steps"
    if has docker; then
        need "docker compose version >/dev/null 2>&1 || has docker-compose" "docker-compose-v2|docker-compose" \
            "tests of the deployment in containers"
        need "has debootstrap" debootstrap \
            "tests of the deployment in containers and of the package for arm64, without access to a registry"
    fi
    need "has xz" xz-utils "recorded results in the tests of adaptive-bridge-eval report, cargo bench -- --save"
    need "has dpkg-shlibdeps" dpkg-dev "the Debian package, and its tests"
    need "has systemd-nspawn" systemd-container "tests of the services (in a container with systemd)"
    need "has systemd-analyze" systemd "tests of the service units"
    need "has_python prometheus_client" python3-prometheus-client "tests of the metrics page with Prometheus' parser"
    need "has cmake" cmake "tests of the package in a ROS 2 workspace"
    need "has colcon" "colcon|python3-colcon-core" "tests of the package in a ROS 2 workspace"
    if [ "$(uname -m)" = x86_64 ]; then
        need "python_of_ros >/dev/null" "python3.11-venv|python3-venv" "tests with ROS 2 nodes (rclpy)"
    fi
    need "has_python colcon_ros" python3-colcon-ros "tests of the package in a ROS 2 workspace"
    need "has_python colcon_metadata" python3-colcon-metadata "tests of the package in a ROS 2 workspace"
    need "has_python colcon_package_information" python3-colcon-package-information \
        "tests of the package in a ROS 2 workspace"
    need "has_python ament_index_python" "python3-ament-index|python3-ament-index-python" \
        "tests of the package in a ROS 2 workspace"
}

# Prints the first package of 'a|b' that is in the package lists.
existing() {
    for package in $(echo "$1" | tr '|' ' '); do
        if apt-cache show "$package" >/dev/null 2>&1; then echo "$package"; return 0; fi
    done
}

install_missing() {
    if ! has apt-get; then
        say "this is not Debian or Ubuntu; install these by hand:$purposes"
        return 0
    fi
    as_root=""
    if [ "$(id -u)" -ne 0 ]; then
        if has sudo && { sudo -n true 2>/dev/null || [ -t 0 ]; }; then
            as_root="sudo"
        else
            return 0
        fi
    fi
    say "missing:$purposes"
    say "apt-get update${as_root:+ (with sudo)}"
    $as_root apt-get update -qq || say "apt-get update failed; continuing with the old package lists"
    packages=""
    for names in $(echo "$missing" | tr ' ' '\n' | sort -u); do
        package=$(existing "$names")
        if [ -n "$package" ]; then packages="$packages $package"; fi
    done
    if [ -z "$packages" ]; then return 0; fi
    say "apt-get install$packages"
    # Word splitting is intended: the list has one package per word.
    # shellcheck disable=SC2086
    $as_root env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends $packages \
        || say "apt-get install failed"
}

check_all
if [ -n "$missing" ]; then
    install_missing
    check_all
fi
if [ -n "$missing" ]; then
    say "******** not installed (no root, or no such package); these parts will not run:$purposes"
fi
if ! has cc; then
    say "error: a C compiler is needed to link Rust programs: apt-get install build-essential"
    exit 1
fi

# Installs rclpy for the tests with ROS 2 nodes, in the exact versions of the list. Without it these tests do not run.
for release in jazzy kilted; do
    ros=$(dirname "$0")/../target/ros/$release
    ros_list=$(dirname "$0")/../tests/ros/$release.txt
    if cmp -s "$ros_list" "$ros/requirements.txt"; then continue; fi
    if ! python=$(python_of_ros); then
        say "******** no CPython 3.11 for x86-64 with venv: the tests with ROS 2 nodes (rclpy) will not run"
        break
    fi
    say "pip install -r tests/ros/$release.txt (250 MB in target/ros/$release)"
    rm -rf "$ros"
    # The copy of the list marks a complete installation.
    if "$python" -m venv "$ros" \
        && "$ros/bin/pip" install --quiet --disable-pip-version-check --no-deps --only-binary :all: -r "$ros_list" \
        && "$ros/bin/python" -c "import rclpy, sensor_msgs.msg, std_msgs.msg"; then
        cp "$ros_list" "$ros/requirements.txt"
    else
        say "******** the installation of rclpy failed: the tests with ROS 2 nodes of $release will not run"
    fi
done

if ! has cargo; then
    say "error: the Rust toolchain is missing; install it, then run this again:"
    say "  curl --proto '=https' --tlsv1.2 -sSf https://sh.rustup.rs | sh -s -- -y"
    exit 1
fi
for component in clippy rustfmt; do
    case $component in clippy) tool=clippy ;; *) tool=fmt ;; esac
    if cargo $tool --version >/dev/null 2>&1; then continue; fi
    if has rustup; then
        say "rustup component add $component"
        rustup component add $component
    else
        say "error: cargo $tool is missing; install the component $component of your Rust toolchain"
        exit 1
    fi
done
if ! cargo fuzz --version >/dev/null 2>&1; then
    say "cargo install cargo-fuzz --locked"
    cargo install cargo-fuzz --locked
fi
if ! cargo deb --version >/dev/null 2>&1; then
    say "cargo install cargo-deb --locked"
    cargo install cargo-deb --locked
fi
if ! cargo deny --version >/dev/null 2>&1; then
    say "cargo install cargo-deny --locked (three minutes on two cores)"
    cargo install cargo-deny --locked || say "******** not installed: make lint does not check dependencies"
fi
say "done"
