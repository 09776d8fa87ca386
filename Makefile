# The commands of this project. `make test` must pass before a change is proposed; CI runs `make test-long` too.
FUZZ_SECONDS ?= 10
# Test programs that run no bridge and open no network: files of the project, and policy in virtual time.
PURE_TESTS = performance pure report

build:
	cargo build --locked --release

setup:
	scripts/setup.sh

# The DDS peers of the integration tests, and the programs that tests of another package start.
peers:
	$(MAKE) --no-print-directory -C tests/peers
	cargo build --locked --workspace --bins --example rust_peer

# Sets up, builds and runs lints, unit, property and integration tests, in 30 minutes on two CPUs.
test:
	scripts/test.sh

# The tests that take a minute or more each, and a bounded fuzz run. CI runs both.
test-long:
	FUZZ_SECONDS=$(FUZZ_SECONDS) scripts/test.sh long

# The checks to run after each edit, within a minute of a build. They need no root and no network namespaces.
quick:
	cargo fmt --check
	cargo clippy --locked --workspace --all-targets -- -D warnings
	cargo test --locked --workspace --lib $(PURE_TESTS:%=--test %)

lint:
	cargo fmt --check
	cargo clippy --locked --workspace --all-targets -- -D warnings
	RUSTDOCFLAGS='-D warnings' cargo doc --locked --no-deps --workspace
	@if cargo deny --version >/dev/null 2>&1; then cargo deny --locked check bans licenses sources; \
	else echo '*** NOT CHECKED: licences and versions of dependencies: cargo-deny is not installed (make setup)'; \
	test -z "$$CI"; fi

# Runs a publisher, a critical and a slow subscriber, first without and then with the bridge. Needs no ROS 2 and no root.
demo: build
	target/release/adaptive-bridge demo

# The Debian package: target/debian/adaptive-bridge_*.deb. With ARCH=arm64, which needs Docker, for a robot's computer.
package:
	ARCH=$(ARCH) scripts/package.sh

# Builds for arm64, and runs the package's program and the tests without network under QEMU. Needs Docker.
test-arm64:
	cargo clippy --locked --test arm64 -- -D warnings
	cargo test --locked --test arm64 -- --nocapture

# Builds the image of docker/Dockerfile whole, and runs it. Needs root, Docker and crates.io.
test-image: peers
	cargo test --locked --test root -- --nocapture docker::long::

# Measures the latency and CPU time that the bridge adds. Takes 80 minutes and saves the run in benches/runs. Shorter:
# cargo bench -- --quick, or cargo bench -- --only isolation (benches/README.md).
bench:
	$(MAKE) --no-print-directory -C tests/peers
	cargo build --locked --release --example rust_peer
	cargo bench --locked -- --save

fuzz:
	scripts/fuzz.sh $(FUZZ_SECONDS)

# What takes hours: each fuzz target for SOAK_FUZZ_SECONDS, chaos for SOAK_CHAOS_SECONDS, killed and stopped processes
# with standbys for SOAK_HITLESS_SECONDS, SOAK_VISITORS participants that come and go, outages of SOAK_OUTAGE_SECONDS of the
# subscribers' link and of the bridge's, and memory over time under load for SOAK_TIME.
SOAK_FUZZ_SECONDS ?= 600
SOAK_CHAOS_SECONDS ?= 1800
SOAK_HITLESS_SECONDS ?= 3600
SOAK_OUTAGE_SECONDS ?= 300
SOAK_VISITORS ?= 9500
SOAK_TIME ?= 70m
soak:
	scripts/fuzz.sh $(SOAK_FUZZ_SECONDS)
	ADAPTIVE_BRIDGE_TEST_CHAOS_S=$(SOAK_CHAOS_SECONDS) cargo test --locked --test hosts -- --nocapture chaos::
	ADAPTIVE_BRIDGE_TEST_HITLESS_S=$(SOAK_HITLESS_SECONDS) cargo test --locked --test hosts -- --nocapture standby::long
	ADAPTIVE_BRIDGE_TEST_VISITORS=$(SOAK_VISITORS) cargo test --locked --test hosts -- --nocapture churn::
	ADAPTIVE_BRIDGE_TEST_OUTAGE_S=$(SOAK_OUTAGE_SECONDS) cargo test --locked --test hosts -- --nocapture from_a_long_outage
	cargo bench --locked -- --soak $(SOAK_TIME)

clean:
	cargo clean
	$(MAKE) --no-print-directory -C tests/peers clean

.PHONY: build setup peers test test-long test-arm64 test-image quick lint demo package bench fuzz soak clean
