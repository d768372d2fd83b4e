"""Relays frames between a bench and its drives, each on a bus of its own, and changes some of them on their way. A
bus is a SocketCAN interface, or the udp_multicast of python-can.

    can_relay.py --bench udp:239.75.1.1:43114 --drives udp:239.75.1.1:43113 \
        --rule 'node=1 from=4mm clear=0x0200' --rule 'node=2 from=4mm emcy=0x8611'

A rule is a list of KEY=VALUE: node, from and until, and one action. Without from or until it has no beginning or end.
    from, until    a depth (4mm, from node 1's first position on), a time (2.5s, from the relay's start on) or a
                   number of SYNCs (1sync)
    set, clear     sets or clears these bits of the statusword, in TPDO1 and in SDO answers
    emcy           sends an emergency message of the node with this code, once
    edit           replaces the code of the node's emergency messages
    drop=emcy      loses the node's emergency messages
    hold           replaces the controlword to the drive in RPDO1; confirms and loses a controlword written by SDO

Every other frame passes unchanged. The relay prints what the rules do, and each new controlword to a drive, with time
and depth: "12.345 s 4.003 mm node 1: controlword 0x0002 by SDO". It ends on SIGINT. Messages over UDP are packed and
unpacked by python-can (4.6.1).
"""

import argparse
import select
import signal
import socket
import struct
import sys
import time
from dataclasses import dataclass, field

SYNC = 0x080
EMCY, TPDO1, RPDO1, SDO_ANSWER, SDO_REQUEST = 0x080, 0x180, 0x200, 0x580, 0x600
# Expedited SDO: command and object, two bytes of data.
STATUSWORD_READ = bytes([0x4B, 0x41, 0x60, 0x00])
CONTROLWORD_WRITTEN = bytes([0x2B, 0x40, 0x60, 0x00])
CONTROLWORD_CONFIRMED = bytes([0x60, 0x40, 0x60, 0x00, 0, 0, 0, 0])
EMCY_REGISTER = 0x21


class UdpBus:
    """One side over UDP: a socket that receives the group, and one with its own port that sends."""

    def __init__(self, address):
        # Not needed over SocketCAN, and slow to load in an emulated machine.
        import can
        from can.interfaces.udp_multicast import utils

        self.message, self.pack, self.unpack = can.Message, utils.pack_message, utils.unpack_message
        group, port = address.split(":")
        self.destination = (group, int(port))
        self.receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.receiver.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self.receiver.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
        self.receiver.bind((group, int(port)))
        joined = struct.pack("=4sl", socket.inet_aton(group), socket.INADDR_ANY)
        self.receiver.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, joined)
        self.sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.sender.bind(("", 0))
        self.sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
        self.own_port = self.sender.getsockname()[1]

    def fileno(self):
        return self.receiver.fileno()

    def receive(self):
        """The next frame: identifier, data, and raw bytes; None if this relay sent it."""
        datagram, (_, port) = self.receiver.recvfrom(4096)
        if port == self.own_port:
            return None
        frame = self.unpack(datagram)
        return frame.arbitration_id, bytes(frame.data), datagram

    def send(self, datagram):
        self.sender.sendto(datagram, self.destination)

    def send_frame(self, cob_id, data):
        frame = self.message(
            timestamp=time.time(), arbitration_id=cob_id, is_extended_id=False, data=data
        )
        self.send(self.pack(frame))


class CanBus:
    """One side over SocketCAN, which does not receive what this relay sends. It reads struct can_frame itself:
    python-can is too slow for an emulated machine."""

    FRAME = struct.Struct("=IB3x8s")

    def __init__(self, interface):
        self.socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        self.socket.bind((interface,))

    def fileno(self):
        return self.socket.fileno()

    def receive(self):
        """The next frame: identifier, data, and raw bytes."""
        raw = self.socket.recv(CanBus.FRAME.size)
        cob_id, length, data = CanBus.FRAME.unpack(raw)
        return cob_id, data[:length], raw

    def send(self, raw):
        self.socket.send(raw)

    def send_frame(self, cob_id, data):
        self.send(CanBus.FRAME.pack(cob_id, len(data), data))


def open_bus(name):
    return UdpBus(name.removeprefix("udp:")) if name.startswith("udp:") else CanBus(name)


@dataclass
class Moment:
    """The progress of the run: time, depth and SYNCs."""

    began: float
    counts_per_mm: float
    syncs: int = 0
    zero_counts: int | None = None
    depth_mm: float = 0.0

    def see_depth(self, counts):
        if self.zero_counts is None:
            self.zero_counts = counts
        self.depth_mm = (counts - self.zero_counts) / self.counts_per_mm

    def has_come(self, limit):
        value, unit = limit
        now = {
            "mm": self.depth_mm,
            "s": time.monotonic() - self.began,
            "sync": self.syncs,
        }
        return now[unit] >= value

    def say(self, node, text):
        seconds = time.monotonic() - self.began
        print(f"{seconds:.4f} s {self.depth_mm:.4f} mm node {node}: {text}", flush=True)


def limit(text):
    for unit in ("sync", "mm", "s"):
        if text.endswith(unit):
            return float(text.removesuffix(unit)), unit
    raise ValueError(f"{text}: expected a number with mm, s or sync")


def number(text):
    return int(text, 0)


@dataclass
class Rule:
    """A fault of one node, and when it applies."""

    node: int
    begins: tuple | None = None
    ends: tuple | None = None
    set: int = 0
    clear: int = 0
    emcy: int | None = None
    edit: int | None = None
    drop: bool = False
    hold: int | None = None
    is_done: bool = field(default=False, init=False)

    @classmethod
    def parse(cls, text):
        kinds = {
            "node": ("node", number),
            "from": ("begins", limit),
            "until": ("ends", limit),
            "set": ("set", number),
            "clear": ("clear", number),
            "emcy": ("emcy", number),
            "edit": ("edit", number),
            "drop": ("drop", ["emcy"].index),
            "hold": ("hold", number),
        }
        values = {}
        for pair in text.split():
            key, _, value = pair.partition("=")
            if key not in kinds:
                raise argparse.ArgumentTypeError(f"{key}: expected one of {', '.join(kinds)}")
            name, parse = kinds[key]
            try:
                values[name] = parse(value)
            except ValueError as error:
                raise argparse.ArgumentTypeError(f"{pair}: {error}") from error
        if "node" not in values:
            raise argparse.ArgumentTypeError(f"{text}: node is missing")
        rule = cls(**values)
        rule.drop = "drop" in values
        return rule

    def is_on(self, moment):
        begun = self.begins is None or moment.has_come(self.begins)
        return begun and not (self.ends is not None and moment.has_come(self.ends))


class Relay:
    def __init__(self, bench, drives, rules, moment):
        self.bench, self.drives, self.rules, self.moment = bench, drives, rules, moment
        self.controlwords = {}

    def rules_of(self, node):
        return [rule for rule in self.rules if rule.node == node and rule.is_on(self.moment)]

    def edited(self, node, statusword):
        for rule in self.rules_of(node):
            word = (statusword | rule.set) & ~rule.clear
            if word != statusword and not rule.is_done:
                rule.is_done = True
                self.moment.say(node, f"statusword {statusword:#06x} becomes {word:#06x}")
            statusword = word
        return statusword

    def from_drives(self, cob_id, data, raw):
        node, kind = cob_id & 0x7F, cob_id & 0x780
        if kind == TPDO1 and len(data) == 6:
            statusword, counts = struct.unpack("<Hi", data)
            if node == 1:
                self.moment.see_depth(counts)
            word = self.edited(node, statusword)
            if word != statusword:
                return self.bench.send_frame(cob_id, struct.pack("<Hi", word, counts))
        elif kind == SDO_ANSWER and data.startswith(STATUSWORD_READ):
            (statusword,) = struct.unpack_from("<H", data, 4)
            word = struct.pack("<H", self.edited(node, statusword))
            return self.bench.send_frame(cob_id, data[:4] + word + data[6:])
        elif kind == EMCY and node != 0 and len(data) == 8:
            rules = self.rules_of(node)
            if any(rule.drop for rule in rules):
                return self.moment.say(node, f"emergency lost: {data.hex()}")
            for code in [rule.edit for rule in rules if rule.edit is not None][-1:]:
                self.moment.say(node, f"emergency {data.hex()} becomes {code:#06x}")
                return self.bench.send_frame(cob_id, struct.pack("<H", code) + data[2:])
        self.bench.send(raw)

    def to_drives(self, cob_id, data, raw):
        node, kind = cob_id & 0x7F, cob_id & 0x780
        held = [rule.hold for rule in self.rules_of(node) if rule.hold is not None]
        if cob_id == SYNC:
            self.moment.syncs += 1
        elif kind == RPDO1 and len(data) == 6:
            self.print_controlword(node, data, "RPDO", held)
            if held:
                data = struct.pack("<H", held[-1]) + data[2:]
                return self.drives.send_frame(cob_id, data)
        elif kind == SDO_REQUEST and data.startswith(CONTROLWORD_WRITTEN):
            self.controlwords.pop((node, "SDO"), None)
            self.print_controlword(node, data[4:6], "SDO", held)
            if held:
                return self.bench.send_frame(SDO_ANSWER + node, CONTROLWORD_CONFIRMED)
        self.drives.send(raw)

    def print_controlword(self, node, data, way, held):
        (word,) = struct.unpack_from("<H", data)
        if self.controlwords.get((node, way)) != word:
            self.controlwords[node, way] = word
            lost = " lost" if held else ""
            self.moment.say(node, f"controlword {word:#06x} by {way}{lost}")

    def send_emergencies(self):
        for rule in self.rules:
            if rule.emcy is not None and not rule.is_done and rule.is_on(self.moment):
                rule.is_done = True
                data = struct.pack("<HB5x", rule.emcy, EMCY_REGISTER)
                self.bench.send_frame(EMCY + rule.node, data)
                self.moment.say(rule.node, f"emergency {rule.emcy:#06x}")


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--bench", required=True, metavar="BUS")
    parser.add_argument("--drives", required=True, metavar="BUS")
    parser.add_argument("--rule", type=Rule.parse, action="append", default=[], metavar="RULE")
    parser.add_argument("--counts-per-mm", type=float, default=4646.0)
    args = parser.parse_args()

    ended = []
    signal.signal(signal.SIGINT, lambda *_: ended.append(True))
    bench, drives = open_bus(args.bench), open_bus(args.drives)
    moment = Moment(time.monotonic(), args.counts_per_mm)
    relay = Relay(bench, drives, args.rule, moment)
    ways = {bench: relay.to_drives, drives: relay.from_drives}
    print("relaying", flush=True)
    while not ended:
        ready, _, _ = select.select(list(ways), [], [], 0.1)
        for bus in ready:
            frame = bus.receive()
            if frame is not None:
                ways[bus](*frame)
            relay.send_emergencies()
    return 0


if __name__ == "__main__":
    sys.exit(main())
