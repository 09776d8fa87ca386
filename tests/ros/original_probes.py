"""The probing side of the original Python package, as it appears on the wire (rclpy): QoS depth 10, RELIABLE.

`responder` answers each request. `bridge` sends ten requests a second. Both print the number of messages
that are for them, and end at a message of another version.
"""

import argparse
import json
import sys
import time

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import String

QOS = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
REQUEST = "/adaptive_bridge/probe_req"
RESPONSE = "/adaptive_bridge/probe_resp"
PERIOD_S = 0.1


class Side(Node):
    def __init__(self, name, writes, reads):
        super().__init__(name)
        self.received = 0
        self.writer = self.create_publisher(String, writes, QOS)
        self.create_subscription(String, reads, self.on_message, QOS)

    def on_message(self, message):
        fields = json.loads(message.data)
        if fields["v"] != 1:
            raise ValueError(fields)
        if not self.receive(fields):
            return
        self.received += 1
        sys.stdout.write(json.dumps({"received": self.received}) + "\n")
        sys.stdout.flush()

    def send(self, fields):
        self.writer.publish(String(data=json.dumps(fields)))


class Responder(Side):
    def __init__(self, responder_id):
        super().__init__("probe_responder", RESPONSE, REQUEST)
        self.responder_id = responder_id

    def receive(self, request):
        now_ns = time.time_ns()
        self.send({
            "v": 1, "seq": request["seq"], "probe_id": request["probe_id"], "recv_time_ns": now_ns,
            "reply_time_ns": now_ns, "response_send_time_ns": time.time_ns(), "responder_id": self.responder_id,
        })
        return True


class Bridge(Side):
    def __init__(self):
        super().__init__("adaptive_bridge", REQUEST, RESPONSE)
        self.seq = 0
        self.create_timer(PERIOD_S, self.probe)

    def probe(self):
        self.seq += 1
        self.send({
            "v": 1, "seq": self.seq, "send_time_ns": time.time_ns(), "sender_id": "original",
            "probe_id": f"original-{self.seq}",
        })

    def receive(self, response):
        # Responses to the bridge under test arrive, too.
        return response["seq"] <= self.seq and response["probe_id"] == f"original-{response['seq']}"


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("side", choices=["responder", "bridge"])
    parser.add_argument("--id", default="laptop")
    options = parser.parse_args()
    rclpy.init()
    try:
        rclpy.spin(Responder(options.id) if options.side == "responder" else Bridge())
    except (KeyboardInterrupt, ExternalShutdownException):
        pass


main()
