#!/usr/bin/env python3
"""Compares hop and CPU time of two builds of the bridge, between independent programs of one DDS library.

    make peers && cargo build --release
    benches/compare_builds.py OLD/adaptive-bridge target/release/adaptive-bridge

Both builds run during the whole comparison, each in a DDS domain of its own. They and a direct flow without a bridge
take turns: only one receives samples at a time, and each round begins with another one. The hop of a build in a round
is its median latency minus that of the direct flow. The output has the medians over the rounds, and their ratio
with its 95 % confidence interval (bootstrap over the rounds). Scheduling is normal. Without --cpus no CPU affinity is
set.
"""

import argparse
import json
import os
import random
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

PEERS = Path(__file__).resolve().parent.parent / "tests/peers/build"
OUTPUT = "rt/adaptive_bridge/critical/scan"
INPUT = "rt/scan"
# The rate in Hz and the sample size in bytes of each case.
CASES = {"100hz": (100, 2_948), "1khz": (1_000, 2_948), "1mib": (30, 1 << 20), "4mib": (30, 4 << 20)}
DIRECT_DOMAIN = 63


def scheduling(cpu):
    return f"scheduling: {{cpus: [{'' if cpu is None else cpu}]}}"


class Build:
    """A running bridge of one build."""

    def __init__(self, name, program, domain, folder, cpus, standby):
        self.name, self.domain = name, domain
        config = folder / f"{name}.yaml"
        config.write_text(
            f"instance: compare_{os.getpid()}_{name}\nros: {{domain_id: {domain}}}\n"
            "topics: [{id: scan, input_topic: /scan, message_type: sensor_msgs/msg/LaserScan, "
            "max_sample_bytes: 8388608}]\n"
            f"shared_memory: {{root_path: {folder}/{name}}}\n"
            f"lanes: {{critical: {{queue_depth: 512, {scheduling(cpus[1])}{standby}}}}}\n"
            f"processes: {{ingress: {{{scheduling(cpus[0])}{standby}}}}}\nclassifier: {{enabled: false}}\n")
        environment = {**os.environ, "RUST_LOG": "info", "NO_COLOR": "1"}
        self.log = folder / f"{name}.log"
        with open(self.log, "w") as log:
            self.process = subprocess.Popen(
                [program, "up", "--config", config], stdout=log, stderr=log, env=environment)
        deadline = time.monotonic() + 30
        while self.log.read_text().count("egress is up") < 2 or "ingress is up" not in self.log.read_text():
            if self.process.poll() is not None or time.monotonic() > deadline:
                sys.exit(f"{program} did not start within 30 s:\n{self.log.read_text()}")
            time.sleep(0.1)
        started = [line for line in self.log.read_text().splitlines() if "started child=" in line]
        # With their standbys, ingress-2 and egress-critical-2.
        critical_path = [line for line in started if '"ingress' in line or '"egress-critical' in line]
        self.pids = [int(line.split("pid=")[1].split()[0]) for line in critical_path]

    def cpu_s(self):
        """CPU time of all threads of ingress, the critical lane and their standbys so far."""
        tasks = [task for pid in self.pids for task in Path(f"/proc/{pid}/task").iterdir()]
        return sum(int((task / "schedstat").read_text().split()[0]) for task in tasks) / 1e9

    def end(self):
        self.process.terminate()
        self.process.wait()


def summary(process):
    output, _ = process.communicate(timeout=60)
    events = [json.loads(line) for line in output.splitlines()]
    return next(event for event in events if event["event"] == "summary")


def start_peer(program, arguments, cpu):
    """Starts a peer that runs on one CPU, or on any if it is None."""
    command = ["taskset", "--cpu-list", str(cpu)] if cpu is not None else []
    return subprocess.Popen([*command, program, *arguments], stdout=subprocess.PIPE, text=True)


def measure(program, build, rate_hz, size, seconds, cpus):
    """Returns the median latency in us, the CPU time per sample in us, and the number of missing samples.

    Without a build it measures the direct flow.
    """
    domain = build.domain if build else DIRECT_DOMAIN
    common = ["--domain", str(domain), "--size", str(size), "--summary", "--history", "1000"]
    subscriber = start_peer(
        program, ["--role", "sub", "--topic", OUTPUT if build else INPUT, *common], cpus[1])
    # Time for the endpoints to match on both sides.
    time.sleep(1.0)
    before_s = build.cpu_s() if build else 0
    publisher = start_peer(
        program, ["--role", "pub", "--topic", INPUT, "--wait-match", "1", "--rate", str(rate_hz),
                  "--count", str(int(rate_hz * seconds)), *common], cpus[0])
    sent = summary(publisher)
    time.sleep(0.3)
    cpu_s = build.cpu_s() - before_s if build else 0
    subscriber.terminate()
    received = summary(subscriber)
    return received["latency_us"]["p50"], cpu_s * 1e6 / max(sent["ok"], 1), sent["ok"] - received["received"]


def ratio_of_medians(pairs):
    old, new = (statistics.median(values) for values in zip(*pairs))
    return new / old if old > 0 else float("nan")


def interval(pairs):
    """The 95 % confidence interval of the ratio, from 2,000 resamplings of the rounds."""
    source = random.Random(1)
    values = sorted(ratio_of_medians([source.choice(pairs) for _ in pairs]) for _ in range(2_000))
    return values[50], values[-51]


def show(case, rows):
    missing = {name: sum(row[name][2] for row in rows) for name in ("direct", "old", "new")}
    print(f"{case}: missing {missing}")
    hops = [(row["old"][0] - row["direct"][0], row["new"][0] - row["direct"][0]) for row in rows]
    cpus = [(row["old"][1], row["new"][1]) for row in rows]
    for what, pairs in (("hop", hops), ("CPU per sample", cpus)):
        low, high = interval(pairs)
        old, new = (statistics.median(values) for values in zip(*pairs))
        print(f"  {what}: old {old:.1f} us, new {new:.1f} us, new/old {ratio_of_medians(pairs):.3f} "
              f"({low:.3f} to {high:.3f})")


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("old", help="the adaptive-bridge executable of the old build")
    parser.add_argument("new", help="the adaptive-bridge executable of the new build")
    parser.add_argument("--peers", choices=("cyclone", "fast"), default="cyclone", help="their DDS library")
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=4.0, help="duration of each flow in each round")
    parser.add_argument("--case", choices=CASES, action="append", help="repeatable; default: all cases")
    parser.add_argument("--cpus", type=int, nargs=2, default=(None, None), metavar=("INGRESS", "LANE"),
                        help="give ingress and the critical lane a CPU each")
    parser.add_argument("--peer-cpus", type=int, nargs=2, default=(None, None), metavar=("PUBLISHER", "SUBSCRIBER"),
                        help="run the programs on these CPUs; with --cpus the rounds differ less")
    parser.add_argument("--standbys", choices=("none", "warm"), nargs=2, metavar=("OLD", "NEW"),
                        help="whether ingress and the critical lane have standbys; default: as the build has it")
    parser.add_argument("--json", help="also write every round to this file")
    options = parser.parse_args()
    program = PEERS / f"{options.peers}_peer"
    if not program.exists():
        sys.exit(f"{program} is not built: run `make peers`")
    rounds = {}
    with tempfile.TemporaryDirectory() as folder:
        standbys = [f", standby: {standby}" for standby in options.standbys or ()] or ["", ""]
        builds = [
            Build(name, executable, domain, Path(folder), options.cpus, standby)
            for name, executable, domain, standby in (
                ("old", options.old, 61, standbys[0]), ("new", options.new, 62, standbys[1]))]
        try:
            for case in options.case or CASES:
                rate_hz, size = CASES[case]
                rounds[case] = []
                for number in range(options.rounds):
                    print(f"{case}: round {number + 1} of {options.rounds}", file=sys.stderr)
                    flows = [None, *builds]
                    turn = number % len(flows)
                    row = {}
                    for build in flows[turn:] + flows[:turn]:
                        name = build.name if build else "direct"
                        row[name] = measure(program, build, rate_hz, size, options.seconds, options.peer_cpus)
                    rounds[case].append(row)
        finally:
            for build in builds:
                build.end()
    if options.json:
        Path(options.json).write_text(json.dumps(rounds))
    for case, rows in rounds.items():
        show(case, rows)


main()
