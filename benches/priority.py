#!/usr/bin/env python3
"""Measures the latency of a small sample beside large ones on the same lane, with and without a priority.

    make peers && cargo build --release
    benches/priority.py target/release/adaptive-bridge

A route `estop` (50 bytes, 47 Hz) and a route `camera` (4 MiB, 60 Hz or as many as the machine can) are on the critical
lane, between independent DDS programs. Two bridges run during the whole measurement, `equal` without a priority and
`urgent` with `priority: 1` for `estop`, each in a DDS domain of its own; `direct` is without a bridge. They take turns,
alone and beside the camera, and each round begins with another one. The output has the percentiles of all rounds
together, the lowest and highest of a round in brackets, and the ratios of the p99. No CPU affinity is set.
Scheduling is normal, or with `--scheduling fifo`, which needs root, SCHED_FIFO: 30 for the programs of the e-stop, so
that none of their waits counts, 20 for the bridge, 10 for the programs of the camera.
"""

import argparse
import csv
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

PEERS = Path(__file__).resolve().parent.parent / "tests/peers/build"
# Not a divisor of the camera's rate, or the e-stop would meet the camera always or never.
ESTOP_HZ = 47
DOMAINS = {"direct": 73, "equal": 74, "urgent": 75}


class Bridge:
    """A running bridge whose route `estop` has that priority."""

    def __init__(self, options, name, priority, folder):
        config = folder / f"{name}.yaml"
        urgent = f", priority: {priority}" if priority else ""
        config.write_text(
            f"instance: priority_{os.getpid()}_{name}\nros: {{domain_id: {DOMAINS[name]}}}\n"
            "topics:\n"
            "  - {id: camera, input_topic: /camera, message_type: sensor_msgs/msg/Image, max_sample_bytes: 4300000}\n"
            f"  - {{id: estop, input_topic: /estop, message_type: std_msgs/msg/String{urgent}}}\n"
            f"shared_memory: {{root_path: {folder}/{name}}}\nclassifier: {{enabled: false}}\n")
        self.log = folder / f"{name}.log"
        program = options.bridge
        with open(self.log, "w") as log:
            self.process = subprocess.Popen(
                [*scheduled(options, 20), program, "up", "--config", config], stdout=log, stderr=log,
                env={**os.environ, "RUST_LOG": "info", "NO_COLOR": "1"})
        deadline = time.monotonic() + 30
        while self.log.read_text().count("egress is up") < 2 or "ingress is up" not in self.log.read_text():
            if self.process.poll() is not None or time.monotonic() > deadline:
                self.end()
                sys.exit(f"{program} did not start within 30 s:\n{self.log.read_text()}")
            time.sleep(0.1)

    def end(self):
        self.process.terminate()
        self.process.wait()


def scheduled(options, fifo):
    """Returns the start of a command line that gives a program that priority of SCHED_FIFO, if it is to have one."""
    return ("chrt", "--fifo", str(fifo)) if options.scheduling == "fifo" else ()


def start(options, role, name, topic, *arguments):
    fifo = scheduled(options, 30 if topic.endswith("estop") else 10)
    return subprocess.Popen(
        [*fifo, PEERS / f"{options.peer}_peer", "--role", role, "--topic", topic, "--domain", str(DOMAINS[name]), "--summary",
         *map(str, arguments)], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)


def summary(process):
    output, _ = process.communicate(timeout=60)
    return next(event for event in map(json.loads, output.splitlines()) if event["event"] == "summary")


def measure(options, name, camera, folder):
    """Returns the latencies of the e-stop's samples in us, and the received and sent samples of both publishers."""
    prefix = "rt" if name == "direct" else "rt/adaptive_bridge/critical"
    record = folder / "samples.csv"
    image = ("--type", "sensor_msgs::msg::dds_::Image_", "--size", options.camera_bytes, "--history", options.history)
    small = ("--type", "std_msgs::msg::dds_::String_", "--size", 50, "--history", 100)
    subscriber = start(options, "sub", name, f"{prefix}/estop", *small, "--record", record)
    viewer = start(options, "sub", name, f"{prefix}/camera", *image) if camera else None
    time.sleep(1.5)
    source = None
    if camera:
        source = start(options, "pub", name, "rt/camera", *image, "--rate", options.camera_hz, "--wait-match", 1)
        time.sleep(1)
    publisher = start(options, "pub", name, "rt/estop", *small, "--rate", ESTOP_HZ, "--wait-match", 1, "--count",
                      int(ESTOP_HZ * options.seconds), "--linger", 0.2)
    sent = summary(publisher)["ok"]
    samples = {"estop_sent": sent}
    if camera:
        source.terminate()
        samples["camera_sent"] = summary(source)["ok"]
        viewer.terminate()
        samples["camera_received"] = summary(viewer)["received"]
    subscriber.terminate()
    samples["estop_received"] = summary(subscriber)["received"]
    with open(record) as rows:
        latencies = [int(row["latency_ns"]) / 1e3 for row in csv.DictReader(rows)]
    # The first ones wait for the endpoints to match.
    return latencies[ESTOP_HZ // 2:], samples


def percentile(values, share):
    return sorted(values)[min(int(len(values) * share), len(values) - 1)]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bridge", help="the adaptive-bridge executable")
    parser.add_argument("--peer", choices=("cyclone", "fast"), default="cyclone")
    parser.add_argument("--scheduling", choices=("normal", "fifo"), default="normal")
    parser.add_argument("--rounds", type=int, default=6)
    parser.add_argument("--seconds", type=float, default=6.0, help="duration of each flow in each round")
    parser.add_argument("--camera-bytes", type=int, default=4 << 20)
    parser.add_argument("--camera-hz", type=float, default=60, help="samples that are due too soon are skipped")
    parser.add_argument("--history", default="2", help="depth of the camera's publisher and subscriber")
    parser.add_argument("--only", choices=DOMAINS, action="append", help="repeatable; default: all three")
    parser.add_argument("--json", help="also write every latency to this file")
    options = parser.parse_args()
    names = options.only or list(DOMAINS)
    flows = [(name, camera) for name in names for camera in (False, True)]
    results = {flow: [] for flow in flows}
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)
        bridges = []
        try:
            for name, priority in (("equal", 0), ("urgent", 1)):
                if name in names:
                    bridges.append(Bridge(options, name, priority, folder))
            for number in range(options.rounds):
                turn = number % len(flows)
                for flow in flows[turn:] + flows[:turn]:
                    latencies, samples = measure(options, *flow, folder)
                    results[flow].append(latencies)
                    print(f"round {number + 1}: {flow[0]}{' beside the camera' if flow[1] else ''}: "
                          f"p50 {percentile(latencies, 0.5):.0f}, p99 {percentile(latencies, 0.99):.0f} us, {samples}",
                          file=sys.stderr)
        finally:
            for bridge in bridges:
                bridge.end()
    if options.json:
        Path(options.json).write_text(json.dumps([[*flow, rounds] for flow, rounds in results.items()]))
    p99s = {}
    for (name, camera), rounds in results.items():
        every = [latency for latencies in rounds for latency in latencies]
        shown = []
        for share in (0.5, 0.99):
            each = [percentile(latencies, share) for latencies in rounds]
            shown.append(f"p{share * 100:g} {percentile(every, share):.0f} ({min(each):.0f} to {max(each):.0f}) us")
        p99s[name, camera] = [percentile(latencies, 0.99) for latencies in rounds]
        print(f"{name}{' beside the camera' if camera else ' alone'}: {', '.join(shown)}, {len(every)} samples")
    for name in names:
        alone, beside = (statistics.median(p99s[name, camera]) for camera in (False, True))
        print(f"{name}: median of the p99 beside the camera {beside:.0f} us, alone {alone:.0f} us, "
              f"ratio {beside / alone:.2f}")


main()
