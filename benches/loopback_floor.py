#!/usr/bin/env python3
"""Shows what a program between two others on one host costs if all three talk UDP, without any protocol.

    benches/loopback_floor.py

A sender sends each sample as datagrams of 64 KiB, as Fast DDS does, to a receiver: directly, or through forwarders that
know no protocol and parse nothing:

  one, each datagram       one process sends each datagram on when it has it
  one, whole sample        one process sends a sample on when it has all of it
  two, each datagram       one process receives into shared memory, and a second one sends from there, as the bridge

All take turns in each round. The hop is the difference from direct in the same round, from the first send to the last
datagram received; CPU is the time of the processes in between. Figures are medians of the rounds, in brackets the lowest
and the highest. Needs only Python 3.10, whose interpreter takes a part of the CPU time.
"""

import argparse
import mmap
import os
import signal
import socket
import statistics
import struct
import sys
import time

DATAGRAM = 65_000
RATE_HZ = 30
BUFFER = 16 << 20
FORWARDERS = ["one, each datagram", "one, whole sample", "two, each datagram"]


def open_socket(port=None):
    """A socket that receives on a port, or one that sends to it."""
    opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    # With SO_RCVBUFFORCE and SO_SNDBUFFORCE, which need CAP_NET_ADMIN.
    for option, force in ((socket.SO_RCVBUF, 33), (socket.SO_SNDBUF, 32)):
        try:
            opened.setsockopt(socket.SOL_SOCKET, force, BUFFER)
        except PermissionError:
            opened.setsockopt(socket.SOL_SOCKET, option, BUFFER)
    if port is None:
        opened.bind(("127.0.0.1", 0))
    else:
        opened.connect(("127.0.0.1", port))
    return opened


def port_of(opened):
    return opened.getsockname()[1]


def start(cpu, work, samples):
    """Runs work in a process on that CPU; returns what reads its numbers when it has ended."""
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        os.sched_setaffinity(0, {cpu})
        # After a lost datagram it would wait for ever.
        signal.alarm(samples // RATE_HZ + 10)
        began = time.process_time()
        numbers = work() or []
        os.write(writer, struct.pack(f"{len(numbers) + 1}d", time.process_time() - began, *numbers))
        os._exit(0)
    os.close(writer)

    def result():
        with open(reader, "rb") as results:
            packed = results.read()
        os.waitpid(child, 0)
        if not packed:
            sys.exit("a process has failed, or a datagram was lost: run as root, or raise net.core.rmem_max to 16 MiB")
        return struct.unpack(f"{len(packed) // 8}d", packed)

    return result


def send(port, lengths, samples):
    out, buffer = open_socket(port), memoryview(bytearray(DATAGRAM))
    due = time.monotonic()
    for _ in range(samples):
        due += 1 / RATE_HZ
        time.sleep(max(0.0, due - time.monotonic()))
        struct.pack_into("d", buffer, 0, time.monotonic())
        for length in lengths:
            out.send(buffer[:length])


def receive(source, lengths, samples):
    buffer, latencies = bytearray(DATAGRAM), []
    for _ in range(samples):
        for _ in lengths:
            source.recv_into(buffer)
        latencies.append(time.monotonic() - struct.unpack_from("d", buffer)[0])
    return [statistics.median(latencies)]


def forward_each(source, port, lengths, samples):
    out, buffer = open_socket(port), memoryview(bytearray(DATAGRAM))
    for _ in range(samples * len(lengths)):
        out.send(buffer[:source.recv_into(buffer)])


def forward_whole(source, port, lengths, samples):
    out, parts = open_socket(port), [memoryview(bytearray(DATAGRAM)) for _ in lengths]
    for _ in range(samples):
        received = [part[:source.recv_into(part)] for part in parts]
        for part in received:
            out.send(part)


def receive_into(source, slot, filled, lengths, samples):
    slot = memoryview(slot)
    for _ in range(samples):
        for place in range(len(lengths)):
            source.recv_into(slot[place * DATAGRAM:(place + 1) * DATAGRAM])
            os.eventfd_write(filled, 1)


def send_from(slot, filled, port, lengths, samples):
    out, slot = open_socket(port), memoryview(slot)
    for _ in range(samples):
        sent = 0
        while sent < len(lengths):
            for _ in range(os.eventfd_read(filled)):
                out.send(slot[sent * DATAGRAM:sent * DATAGRAM + lengths[sent]])
                sent += 1


def measure(kind, lengths, samples, cpus):
    """The latency in us, and the CPU time of the processes in between for a sample in us."""
    last, source = open_socket(), open_socket()
    args = lengths, samples
    between = []
    if kind == "one, each datagram":
        between = [start(cpus[1], lambda: forward_each(source, port_of(last), *args), samples)]
    elif kind == "one, whole sample":
        between = [start(cpus[1], lambda: forward_whole(source, port_of(last), *args), samples)]
    elif kind == "two, each datagram":
        # Two samples never overlap at this rate.
        slot, filled = mmap.mmap(-1, len(lengths) * DATAGRAM), os.eventfd(0)
        between = [start(cpus[1], lambda: receive_into(source, slot, filled, *args), samples),
                   start(cpus[0], lambda: send_from(slot, filled, port_of(last), *args), samples)]
    receiver = start(cpus[(len(between) + 1) % 2], lambda: receive(last, *args), samples)
    sender = start(cpus[0], lambda: send(port_of(source if between else last), *args), samples)
    sender()
    _, latency = receiver()
    cpu = sum(result()[0] for result in between)
    return latency * 1e6, cpu * 1e6 / samples


def quantity(values):
    return f"{statistics.median(values):,.0f} ({min(values):,.0f} to {max(values):,.0f})"


def main():
    arguments = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--rounds", type=int, default=12)
    arguments.add_argument("--samples", type=int, default=30, help="of each round, at 30 Hz")
    arguments.add_argument("--bytes", type=int, nargs="+", default=[256 << 10, 1 << 20, 4 << 20])
    arguments.add_argument(
        "--cpus", type=int, nargs=2, metavar=("A", "B"), default=[0, 1],
        help="each process runs on the other CPU than the one before it (default: 0 1)")
    options = arguments.parse_args()
    if not set(options.cpus) <= os.sched_getaffinity(0):
        arguments.error(f"--cpus: choose two of {sorted(os.sched_getaffinity(0))}")
    print(f"{options.rounds} rounds of {options.samples} samples at {RATE_HZ} Hz, CPUs {options.cpus}")
    print("| bytes | between | latency, us | hop, us | CPU, us a sample |\n|---|---|---|---|---|")
    for size in options.bytes:
        whole, rest = divmod(size, DATAGRAM)
        lengths = [DATAGRAM] * whole + ([rest] if rest else [])
        rounds = []
        for index in range(options.rounds):
            if sys.stderr.isatty():
                print(f"\r{size} bytes, round {index + 1} of {options.rounds}", end="", file=sys.stderr)
            kinds = ["direct", *FORWARDERS]
            kinds = kinds[index % 4:] + kinds[:index % 4]
            rounds.append({kind: measure(kind, lengths, options.samples, options.cpus) for kind in kinds})
        if sys.stderr.isatty():
            print(end="\r\033[K", file=sys.stderr)
        for kind in ["direct", *FORWARDERS]:
            latency = quantity([one[kind][0] for one in rounds])
            if kind == "direct":
                print(f"| {size:,} | nothing | {latency} | | |")
                continue
            hop = quantity([one[kind][0] - one["direct"][0] for one in rounds])
            cpu = quantity([one[kind][1] for one in rounds])
            print(f"| {size:,} | {kind} | {latency} | {hop} | {cpu} |")


if __name__ == "__main__":
    main()
