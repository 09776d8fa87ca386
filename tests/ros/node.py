"""A ROS 2 node of the tests (rclpy): publishes or subscribes one topic, lists endpoints of topics, or calls
parameter services.

It has the command line, the samples and the output of the peers in tests/peers (README.md there). Samples are
published and taken in serialized form, so that Python keeps up with 1 kHz of 2.9 KB.
"""

import argparse
import functools
import importlib
import json
import signal
import struct
import sys
import time

import numpy
import rclpy
from rcl_interfaces.msg import ParameterValue
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.parameter_client import AsyncParameterClient
from rclpy.qos import DurabilityPolicy, HistoryPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions

# Bytes of the encapsulation header, and of sequence number, time of sending and source timestamp after it.
HEADER = 4
FRONT = 24
# The sequence number of a sample that does not count (--prime).
PRIMING = 2**64 - 1
# Bytes of a payload that a subscriber compares: those of 1 MiB take 15 ms.
MAX_CHECKED = 65536
# RTPS lengthens a payload by up to 3 zeros.
MAX_PADDING = 3
# An RTPS timestamp counts in 2^-32 s.
SOURCE_TOLERANCE_NS = 10
PROGRESS_PERIOD_S = 0.1
MATCH_PERIOD_S = 0.02
INFO_PERIOD_S = 0.2
ACKNOWLEDGEMENT_S = 10
MAX_MISSING_RANGES = 1000
MASK = 2**64 - 1


def emit(event, **fields):
    sys.stdout.write(json.dumps({"event": event, **fields}, separators=(",", ":")) + "\n")
    sys.stdout.flush()


def parse():
    parser = argparse.ArgumentParser(description=__doc__, allow_abbrev=False)
    option = parser.add_argument
    option("--role", choices=["pub", "sub", "info", "parameters"], required=True)
    option("--node", default="", help="node name (default: peer_pub or peer_sub)")
    option("--domain", type=int, default=0)
    option("--topic", default="rt/scan", help="DDS name; of role info: DDS names, separated by commas")
    option("--type", default="sensor_msgs::msg::dds_::LaserScan_", help="DDS name")
    option("--reliability", choices=["r", "be"], default="r")
    option("--durability", choices=["v", "tl"], default="v")
    option("--history", default="10", help="all, or the depth of KEEP_LAST")
    option("--deadline-ms", type=int)
    option("--lifespan-ms", type=int)
    option("--liveliness-ms", type=int, help="MANUAL_BY_TOPIC with this lease duration")
    option("--rate", type=float, default=100.0, help="Hz; 0 is as fast as publish returns")
    option("--count", type=int, default=0)
    option("--duration", type=float, default=0.0, help="s")
    option("--first-seq", type=int, default=0)
    option("--size", default="", help="bytes after the encapsulation header, such as 2948 or 200,4000")
    option("--seed", type=int, default=1)
    option("--wait-match", type=int, default=0)
    option("--hold", action="store_true", help="publish from SIGUSR1 on")
    option("--hold-after", type=int, default=0, help="with --hold: the samples that are published before SIGUSR1")
    option("--writers", type=int, default=1, help="publishers, which publish the samples in turn")
    option("--prime", action="store_true")
    option("--linger", type=float, default=0.0, help="s")
    option("--keep-alive", type=float, help="s; a publisher ends so long after the last sample, acknowledged or not")
    option("--stall-every", type=float, default=0.0, help="s")
    option("--stall-for", type=float, default=0.0, help="s")
    option("--summary", action="store_true")
    options = parser.parse_args()
    options.sizes = [int(size) for size in options.size.split(",")] if options.size else []
    if any(size < FRONT for size in options.sizes):
        parser.error(f"--size: a node's samples have {FRONT} bytes at least")
    if options.role in ("pub", "sub") and not options.topic.startswith("rt/"):
        parser.error(f"--topic {options.topic}: the DDS name of a ROS 2 topic begins with rt/")
    options.ros_topic = options.topic.removeprefix("rt")
    return options


def message_class(dds_type):
    """sensor_msgs.msg.LaserScan of sensor_msgs::msg::dds_::LaserScan_."""
    package, kind, _, name = dds_type.split("::")
    return getattr(importlib.import_module(f"{package}.{kind}"), name.removesuffix("_"))


def qos_of(options):
    keep_all = options.history == "all"
    reliable = options.reliability == "r"
    volatile = options.durability == "v"
    durations = {
        name: Duration(nanoseconds=ms * 10**6)
        for name, ms in (
            ("deadline", options.deadline_ms),
            ("lifespan", options.lifespan_ms),
            ("liveliness_lease_duration", options.liveliness_ms))
        if ms is not None
    }
    manual = options.liveliness_ms is not None
    return QoSProfile(
        **durations,
        liveliness=LivelinessPolicy.MANUAL_BY_TOPIC if manual else LivelinessPolicy.AUTOMATIC,
        history=HistoryPolicy.KEEP_ALL if keep_all else HistoryPolicy.KEEP_LAST,
        depth=0 if keep_all else int(options.history),
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.VOLATILE if volatile else DurabilityPolicy.TRANSIENT_LOCAL,
    )


@functools.lru_cache(maxsize=8)
def xorshift_table(words):
    """Row b: the words that xorshift yields from a state that has bit b only.

    Xorshift is linear over bits, so the words from any state are the XOR of the rows of its bits. A Python loop
    over the words of each sample takes more than 100 us.
    """
    state = numpy.left_shift(numpy.uint64(1), numpy.arange(64, dtype=numpy.uint64))
    table = numpy.empty((words, 64), dtype=numpy.uint64)
    left, right, last = numpy.uint64(13), numpy.uint64(7), numpy.uint64(17)
    for word in range(words):
        state ^= state << left
        state ^= state >> right
        state ^= state << last
        table[word] = state
    return numpy.ascontiguousarray(table.T)


def content(seed, sequence, size):
    """The pseudorandom bytes of a sample, as in tests/peers/common.cpp."""
    value = (seed * 0x100000001B3 + sequence + 0x9E3779B97F4A7C15) & MASK
    value = ((value ^ (value >> 30)) * 0xBF58476D1CE4E5B9) & MASK
    value = ((value ^ (value >> 27)) * 0x94D049BB133111EB) & MASK
    value = (value ^ (value >> 31)) | 1
    rows = [bit for bit in range(64) if value >> bit & 1]
    table = xorshift_table((size + 7) // 8)
    return numpy.bitwise_xor.reduce(table[rows], axis=0).tobytes()[:size]


def distribution(values_ns):
    if not values_ns:
        return None
    values = numpy.sort(numpy.array(values_ns, dtype=numpy.int64)) / 1e3

    def at(share):
        return float(values[min(len(values) - 1, int(share * len(values)))])

    return {"min": at(0), "p50": at(0.5), "p95": at(0.95), "p99": at(0.99), "max": at(1)}


class Signals:
    """SIGINT and SIGTERM end the node, SIGUSR1 lets a publisher begin."""

    def __init__(self):
        self.stop = False
        self.go = False
        signal.signal(signal.SIGINT, self.on_stop)
        signal.signal(signal.SIGTERM, self.on_stop)
        signal.signal(signal.SIGUSR1, self.on_go)

    def on_stop(self, *_):
        self.stop = True

    def on_go(self, *_):
        self.go = True


class Matches:
    """Reports changes of the number of matched endpoints."""

    def __init__(self, count):
        self.count = count
        self.current = 0
        self.look_at = 0.0

    def look(self):
        now = time.monotonic()
        if now < self.look_at:
            return
        self.look_at = now + MATCH_PERIOD_S
        current = self.count()
        if current != self.current:
            emit("matched", current=current, change=current - self.current)
            self.current = current


class Publisher:
    def __init__(self, node, options, signals):
        self.options = options
        self.signals = signals
        self.sizes = options.sizes or [2948]
        for size in self.sizes:
            xorshift_table((size - FRONT + 7) // 8)
        message = message_class(options.type)
        qos = qos_of(options)
        self.publishers = [
            node.create_publisher(message, options.ros_topic, qos) for _ in range(options.writers)]
        self.publisher = self.publishers[0]
        self.matches = Matches(self.publisher.get_subscription_count)
        self.attempted = self.ok = self.skipped_ticks = 0
        self.calls_ns = []

    def run(self):
        options, signals = self.options, self.signals
        while not signals.stop and self.matches.current < options.wait_match:
            self.pause(MATCH_PERIOD_S)
        if not options.hold_after:
            self.wait_for_go()
        if options.prime:
            self.publisher.publish(b"\0\1\0\0" + struct.pack("<QQQ", PRIMING, 0, 0))
            while not signals.stop and not self.acknowledged(0.1):
                pass

        elapsed = self.publish_all()
        if options.keep_alive is not None:
            time.sleep(options.keep_alive)
            return
        acknowledged = self.acknowledged(0)
        # Also after SIGTERM: a publisher that ends at once takes the last samples with it.
        deadline = time.monotonic() + ACKNOWLEDGEMENT_S
        while not acknowledged and time.monotonic() < deadline:
            acknowledged = self.acknowledged(0.1)
        emit("sent", acknowledged=acknowledged)
        end = time.monotonic() + options.linger
        while not signals.stop and (left := end - time.monotonic()) > 0:
            self.pause(min(left, MATCH_PERIOD_S))
        emit(
            "summary", role="pub", attempted=self.attempted, ok=self.ok, failed=self.attempted - self.ok,
            first=options.first_seq, last=options.first_seq + max(self.attempted - 1, 0),
            skipped_ticks=self.skipped_ticks, call_us=distribution(self.calls_ns),
            rate_hz=max(self.ok - 1, 0) / elapsed if elapsed > 0 else 0.0, elapsed_s=elapsed,
            acknowledged=acknowledged, hash="",
        )

    def wait_for_go(self):
        while not self.signals.stop and self.options.hold and not self.signals.go:
            self.pause(MATCH_PERIOD_S)

    def publish_all(self):
        options, signals = self.options, self.signals
        period = 1 / options.rate if options.rate > 0 else 0.0
        begin = due = progress_at = time.monotonic()
        while not options.count or self.attempted < options.count:
            if options.duration and due - begin >= options.duration:
                break
            while not signals.stop and (left := due - time.monotonic()) > 0:
                self.pause(min(left, MATCH_PERIOD_S))
            if options.hold_after and self.attempted == options.hold_after:
                self.wait_for_go()
                due = time.monotonic()
            if signals.stop:
                break
            self.write()
            self.matches.look()
            now = time.monotonic()
            if options.summary and now >= progress_at:
                progress_at = now + PROGRESS_PERIOD_S
                self.emit_progress()
            due += period
            # Ticks that were missed are skipped, as a ROS 2 timer does.
            if period and now - due >= period:
                skipped = int((now - due) / period)
                self.skipped_ticks += skipped
                due += skipped * period
        self.emit_progress()
        return time.monotonic() - begin

    def write(self):
        sequence = self.options.first_seq + self.attempted
        size = self.sizes[sequence % len(self.sizes)]
        rest = content(self.options.seed, sequence, size - FRONT)
        before_ns = time.monotonic_ns()
        front = struct.pack("<QQQ", sequence, before_ns, time.time_ns())
        self.attempted += 1
        try:
            writer = self.publishers[(self.attempted - 1) % len(self.publishers)]
            writer.publish(b"\0\1\0\0" + front + rest)
            self.ok += 1
            ok = True
        except Exception as error:  # An RCLError, which rclpy does not export.
            print(f"publish {sequence}: {error}", file=sys.stderr)
            ok = False
        call_ns = time.monotonic_ns() - before_ns
        self.calls_ns.append(call_ns)
        if not self.options.summary:
            emit("write", seq=sequence, call_us=call_ns / 1e3, ok=ok)

    def acknowledged(self, seconds):
        self.matches.look()
        return all([one.wait_for_all_acked(Duration(seconds=seconds)) for one in self.publishers])

    def pause(self, seconds):
        self.matches.look()
        time.sleep(seconds)

    def emit_progress(self):
        emit("progress", attempted=self.attempted, ok=self.ok)


class Subscriber:
    def __init__(self, node, options, signals):
        self.options = options
        self.signals = signals
        self.node = node
        self.message = message_class(options.type)
        for size in options.sizes or [2948]:
            xorshift_table((min(size - FRONT, MAX_CHECKED) + 7) // 8)
        self.subscription = node.create_subscription(
            self.message, options.ros_topic, self.on_sample, qos_of(options), raw=True)
        self.matches = Matches(self.subscription.handle.get_publisher_count)
        self.seen = set()
        self.last = None
        self.duplicates = self.out_of_order = self.bad = self.padded = self.bytes = 0
        self.source_kept = self.source_changed = 0
        self.sizes = (0, 0)
        self.headers = {}
        self.latencies_ns = []
        self.arrived_ns = None
        self.max_gap_ns = 0

    def on_sample(self, sample):
        """Takes the rest of a burst too: the executor takes one sample per wake-up, at about 100 us each, and
        without its source timestamp."""
        self.record(sample, None)
        handle = self.subscription.handle
        with handle:
            for _ in range(64):
                taken = handle.take_message(self.message, True)
                if taken is None:
                    break
                self.record(taken[0], taken[1]["source_timestamp"])

    def record(self, sample, source_ns):
        now_ns = time.monotonic_ns()
        size = len(sample) - HEADER
        if size < FRONT:
            self.bad += 1
            return
        sequence, sent_ns, stamp_ns = struct.unpack_from("<QQQ", sample, HEADER)
        if sequence == PRIMING:
            return
        if self.arrived_ns is not None:
            self.max_gap_ns = max(self.max_gap_ns, now_ns - self.arrived_ns)
        self.arrived_ns = now_ns
        self.bytes += size
        self.sizes = (min(self.sizes[0] or size, size), max(self.sizes[1], size))
        header = bytes(sample[:HEADER]).hex()
        self.headers[header] = self.headers.get(header, 0) + 1
        self.check(sample, sequence, size)
        if sequence in self.seen:
            self.duplicates += 1
        else:
            self.seen.add(sequence)
            if self.last is None or sequence > self.last:
                self.last = sequence
            else:
                self.out_of_order += 1
        self.latencies_ns.append(now_ns - sent_ns)
        if source_ns is not None and abs(source_ns - stamp_ns) <= SOURCE_TOLERANCE_NS:
            self.source_kept += 1
        elif source_ns is not None:
            self.source_changed += 1
        if not self.options.summary:
            emit("sample", seq=sequence, size=size, header=header, latency_us=(now_ns - sent_ns) / 1e3)

    def check(self, sample, sequence, size):
        """Compares the sample with what was sent."""
        sizes = self.options.sizes
        expected = sizes[sequence % len(sizes)] if sizes else size
        rest = content(self.options.seed, sequence, min(expected - FRONT, MAX_CHECKED))
        got = bytes(sample[HEADER + FRONT:])
        if got[:len(rest)] == rest and len(got) == expected - FRONT:
            return
        padding = got[expected - FRONT:]
        if sizes and got[:len(rest)] == rest and padding and len(padding) <= MAX_PADDING and not any(padding):
            self.padded += 1
        else:
            self.bad += 1

    def run(self):
        options = self.options
        executor = SingleThreadedExecutor()
        executor.add_node(self.node)
        begin = stalled = progress_at = time.monotonic()
        progress = 0
        while not self.signals.stop:
            executor.spin_once(timeout_sec=MATCH_PERIOD_S)
            self.matches.look()
            now = time.monotonic()
            if options.summary and len(self.seen) != progress and now >= progress_at:
                progress_at = now + PROGRESS_PERIOD_S
                progress = len(self.seen)
                emit("progress", received=progress, last=self.last)
            if options.stall_every and now - stalled >= options.stall_every:
                end = now + options.stall_for
                while not self.signals.stop and time.monotonic() < end:
                    time.sleep(0.01)
                    self.matches.look()
                stalled = time.monotonic()
            if options.count and len(self.seen) >= options.count:
                break
            if options.duration and now - begin >= options.duration:
                break
        self.emit_summary()

    def emit_summary(self):
        numbers = sorted(self.seen)
        pairs = zip(numbers, numbers[1:])
        missing = [(one + 1, other - 1) for one, other in pairs if other > one + 1]
        emit(
            "summary", role="sub", received=len(numbers), unnumbered=0,
            first=numbers[0] if numbers else None, last=numbers[-1] if numbers else None,
            missing=missing[:MAX_MISSING_RANGES],
            missing_count=sum(last - first + 1 for first, last in missing),
            duplicates=self.duplicates, out_of_order=self.out_of_order, bad=self.bad, padded=self.padded,
            bytes=self.bytes, size_min=self.sizes[0], size_max=self.sizes[1], headers=self.headers,
            source_timestamps_kept=self.source_kept, source_timestamps_changed=self.source_changed,
            latency_us=distribution(self.latencies_ns), max_gap_ms=self.max_gap_ns / 1e6, hash="",
        )


class Info:
    """Reports the endpoints of the topics as `ros2 topic info --verbose` shows them, and all nodes."""

    def __init__(self, node, options, signals):
        self.node = node
        self.topics = options.topic.split(",")
        self.signals = signals

    def run(self):
        while not self.signals.stop:
            # DDS names: those of ROS 2 topics begin with rt/, which others do not have.
            endpoints = [
                {"topic": topic, "kind": kind, "node": endpoint.node_name,
                 "namespace": endpoint.node_namespace, "type": endpoint.topic_type,
                 "type_hash": str(endpoint.topic_type_hash)}
                for topic in self.topics
                for kind, list_endpoints in (
                    ("writer", self.node.get_publishers_info_by_topic),
                    ("reader", self.node.get_subscriptions_info_by_topic))
                for endpoint in list_endpoints(topic, no_mangle=True)
            ]
            nodes = [
                {"name": name, "namespace": namespace, "enclave": enclave}
                for name, namespace, enclave in self.node.get_node_names_and_namespaces_with_enclaves()
            ]
            emit("endpoints", endpoints=endpoints, nodes=nodes)
            time.sleep(INFO_PERIOD_S)
        emit("summary")


class Parameters:
    """Calls the parameter services of nodes: one call for each line of stdin, a JSON object such as
    {"node": "/a/b", "call": "get", "names": ["c.d"]}."""

    def __init__(self, node, options, signals):
        self.node = node
        self.clients = {}

    def run(self):
        for line in sys.stdin:
            call = json.loads(line)
            client = self.clients.get(call["node"])
            if client is None:
                client = self.clients[call["node"]] = AsyncParameterClient(self.node, call["node"])
            # Of all six services, as `ros2 param` waits. The test waits for the reply, and it fails if there is none.
            client.wait_for_services()
            futures = [self.begin(client, call) for _ in range(call.get("times", 1))]
            for future in futures if call.get("waits", True) else []:
                rclpy.spin_until_future_complete(self.node, future)
            replies = [future.result() for future in futures if future.done()]
            emit("reply", answered=len(replies), reply=self.fields(replies[0]) if replies else None)
        emit("summary")

    @staticmethod
    def begin(client, call):
        names = call.get("names", [])
        given = [Parameter(name, value=value) for name, value in call.get("values", {}).items()]
        return {
            "list": lambda: client.list_parameters(names, call.get("depth", 0)),
            "get": lambda: client.get_parameters(names),
            "types": lambda: client.get_parameter_types(names),
            "describe": lambda: client.describe_parameters(names),
            "set": lambda: client.set_parameters(given),
            "set_atomically": lambda: client.set_parameters_atomically(given),
        }[call["call"]]()

    @staticmethod
    def fields(reply):
        """The reply as JSON, with the value of a parameter in place of its message."""
        if isinstance(reply, ParameterValue):
            return parameter_value_to_python(reply)
        if hasattr(reply, "get_fields_and_field_types"):
            return {name: Parameters.fields(getattr(reply, name)) for name in reply.get_fields_and_field_types()}
        if isinstance(reply, (str, bool, int, float)):
            return reply
        return [Parameters.fields(item) for item in reply]


def main():
    options = parse()
    signals = Signals()
    # Without log files in the home folder, and without signal handlers of rclpy.
    rclpy.init(
        args=["--ros-args", "--disable-external-lib-logs"], domain_id=options.domain,
        signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node(options.node or f"peer_{options.role}")
    peers = {"pub": Publisher, "sub": Subscriber, "info": Info, "parameters": Parameters}
    peer = peers[options.role](node, options, signals)
    emit("ready", library=f"rclpy, {rclpy.get_rmw_implementation_identifier()}")
    peer.run()
    # The participant says goodbye.
    node.destroy_node()
    rclpy.shutdown()


main()
