#!/usr/bin/env python3
"""Shows where ingress and the critical lane spend CPU time on large samples.

    make peers && cargo build --release
    benches/profile.py target/release/adaptive-bridge --peer fast --bytes 1048576 --rate 30

Samples the two processes with perf (Debian: linux-perf) while one publisher and one subscriber of an independent
library run, and adds up the samples by what their functions do. The table has the CPU time of one sample of the topic
in us. perf's clock also works in virtual machines. Needs root, or kernel.perf_event_paranoid=-1.
"""

import argparse
import json
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

PEERS = Path(__file__).resolve().parent.parent / "tests/peers/build"
DOMAIN = 64
FREQUENCY_HZ = 4_000
# The first pattern that a function's name matches decides.
KINDS = {
    "copies into and out of the kernel": r"_copy_(to|from)_iter|copy_user|rep_movs|check_object_size",
    "clearing and mapping of pages": r"clear_page|page_fault|handle_mm|alloc_pages|rmqueue|free_unref|zap_|lru_|"
                                     r"get_page_from|clear_huge|vma|madvise|mas_|filemap|shmem",
    "copies in the process": r"mem(move|cpy|set)|__mem",
    "allocator": r"malloc|calloc|realloc|^_int_free|cfree|free_|unlink_chunk|consolidate",
    "wake-ups and sleep": r"finish_task|schedul|epoll|futex|try_to_wake|select_task|idle|hrtimer|irqentry|ttwu|"
                          r"update_curr|enqueue_|dequeue_|pick_next|exit_to_user",
    "sockets and system calls": r"udp|sock|skb|^ip_|__ip_|netif|loopback|sk_|syscall|SYSCALL|fdget|recvmsg|sendmsg|"
                                r"nf_|eth_|dev_|fib_|__local_bh|spin_(un)?lock|route",
    "clocks": r"clock_gettime|SystemTime|Utc|Timestamp|Instant|ktime",
    "RTPS": r"rustdds|speedy|bytes::|bit_vec|btree",
    "bridge and iceoryx2": r"adaptive_bridge|iceoryx",
}


def start_bridge(program, folder, largest):
    config = folder / "profile.yaml"
    config.write_text(
        f"instance: profile\nros: {{domain_id: {DOMAIN}}}\n"
        "topics: [{id: scan, input_topic: /scan, message_type: sensor_msgs/msg/LaserScan, "
        f"max_sample_bytes: {largest}}}]\n"
        f"shared_memory: {{root_path: {folder}/shm}}\nclassifier: {{enabled: false}}\n")
    log = folder / "log"
    with open(log, "w") as output:
        bridge = subprocess.Popen([program, "up", "--config", config], stdout=output, stderr=output,
                                  env={"RUST_LOG": "info", "NO_COLOR": "1", "PATH": "/usr/bin:/bin"})
    deadline = time.monotonic() + 30
    while log.read_text().count("egress is up") < 2 or "ingress is up" not in log.read_text():
        if bridge.poll() is not None or time.monotonic() > deadline:
            sys.exit(f"{program} did not start within 30 s:\n{log.read_text()}")
        time.sleep(0.1)
    pids = {}
    for child in subprocess.run(["pgrep", "-P", str(bridge.pid)], capture_output=True, text=True).stdout.split():
        words = Path(f"/proc/{child}/cmdline").read_text().split("\0")
        if "ingress" in words:
            pids["ingress"] = child
        elif "critical" in words:
            pids["critical lane"] = child
    return bridge, pids


def cpu_s(pid):
    tasks = Path(f"/proc/{pid}/task").iterdir()
    return sum(int((task / "schedstat").read_text().split()[0]) for task in tasks) / 1e9


def kind_of(function):
    return next((kind for kind, pattern in KINDS.items() if re.search(pattern, function)), "other")


def shares(recording):
    """The share of each kind in the samples of a recording."""
    report = subprocess.run(
        ["perf", "report", "-i", recording, "--no-children", "-g", "none", "--stdio", "-F", "overhead,symbol"],
        capture_output=True, text=True, check=True).stdout
    sums = {}
    for line in report.splitlines():
        match = re.match(r"\s+([\d.]+)%\s+\[.\] (.*)", line)
        if match:
            kind = kind_of(match[2].strip())
            sums[kind] = sums.get(kind, 0) + float(match[1])
    return sums


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("program", help="the adaptive-bridge executable")
    parser.add_argument("--peer", choices=("fast", "cyclone"), default="fast")
    parser.add_argument("--bytes", type=int, default=1 << 20, help="size of a sample")
    parser.add_argument("--rate", type=int, default=30, help="samples a second")
    parser.add_argument("--seconds", type=int, default=10, help="duration of the recording")
    options = parser.parse_args()
    peer = PEERS / f"{options.peer}_peer"
    if not peer.exists():
        sys.exit(f"{peer} is not built: run `make peers`")
    common = ["--domain", str(DOMAIN), "--size", str(options.bytes), "--summary", "--history", "1000"]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        bridge, pids = start_bridge(options.program, folder, max(1 << 20, options.bytes))
        subscriber = subprocess.Popen([peer, "--role", "sub", "--topic", "rt/adaptive_bridge/critical/scan", *common],
                                      stdout=subprocess.PIPE, text=True)
        time.sleep(1)
        publisher = subprocess.Popen(
            [peer, "--role", "pub", "--topic", "rt/scan", "--wait-match", "1", "--rate", str(options.rate),
             "--count", str(options.rate * (options.seconds + 4)), *common], stdout=subprocess.PIPE, text=True)
        time.sleep(2)
        before = {role: cpu_s(pid) for role, pid in pids.items()}
        recordings = {role: folder / f"{pid}.data" for role, pid in pids.items()}
        perf = [subprocess.Popen(["perf", "record", "-q", "-e", "cpu-clock", "-F", str(FREQUENCY_HZ), "-p", pid,
                                  "-o", recordings[role], "sleep", str(options.seconds)])
                for role, pid in pids.items()]
        for one in perf:
            if one.wait() != 0:
                sys.exit("perf failed: install linux-perf, and run this as root")
        used = {role: (cpu_s(pid) - before[role]) * 1e6 / (options.rate * options.seconds)
                for role, pid in pids.items()}
        publisher.wait()
        subscriber.terminate()
        lines = [json.loads(line) for line in subscriber.communicate()[0].splitlines()]
        summary = next(line for line in lines if line["event"] == "summary")
        bridge.terminate()
        bridge.wait()
        print(f"{options.bytes} bytes at {options.rate} Hz, {options.peer}; received {summary['received']}, "
              f"missing {summary['missing_count']}; us of CPU time for each sample\n")
        columns = {role: shares(recordings[role]) for role in pids}
        print("| | " + " | ".join(pids) + " |\n|---|" + "---|" * len(pids))
        for kind in [*KINDS, "other"]:
            cells = [f"{columns[role].get(kind, 0) * used[role] / 100:.0f}" for role in pids]
            print(f"| {kind} | " + " | ".join(cells) + " |")
        print("| all | " + " | ".join(f"{used[role]:.0f}" for role in pids) + " |")


main()
