#!/usr/bin/env python3
"""Two third-party drives: LocalNodes of python-canopen, each with a CiA 402 axis.

NMT, SDO server, object dictionary and heartbeat are python-canopen's (2.4.1). The axis implements the minimum of cyclic
synchronous position: at each SYNC it reports its position and takes the target that it received before. Prints "ready"
once both have booted. On SIGINT it prints position, statusword and settings of each drive, and ends.
"""

import argparse
import logging
import signal
import struct
import sys
import threading

import canopen
from canopen.objectdictionary import ODRecord, ODVariable, datatypes

U8, U16, U32 = datatypes.UNSIGNED8, datatypes.UNSIGNED16, datatypes.UNSIGNED32
I8, I16, I32 = datatypes.INTEGER8, datatypes.INTEGER16, datatypes.INTEGER32

CSP = 8
# Bits of the controlword (CiA 402-2, table of commands).
DISABLE_VOLTAGE, QUICK_STOP = 0x02, 0x04
# Statuswords of the states, with "voltage enabled" and "remote".
SWITCH_ON_DISABLED, READY, SWITCHED_ON, ENABLED, QUICK_STOP_ACTIVE = 0x250, 0x231, 0x233, 0x237, 0x217
DRIVE_FOLLOWS = 1 << 12


def object_dictionary(node_id: int, vendor: int, product: int) -> canopen.ObjectDictionary:
    dictionary = canopen.ObjectDictionary()

    def variable(index, subindex, data_type, default):
        entry = ODVariable(f"{index:04X}:{subindex:02X}", index, subindex)
        entry.data_type, entry.default, entry.access_type = data_type, default, "rw"
        return entry

    def record(index, *members):
        entry = ODRecord(f"{index:04X}", index)
        for subindex, (data_type, default) in enumerate(members):
            entry.add_member(variable(index, subindex, data_type, default))
        dictionary.add_object(entry)

    for index, data_type, default in [
        (0x1000, U32, 0x0002_0192),
        (0x1001, U8, 0),
        (0x1005, U32, 0x80),
        (0x1017, U16, 0),
        (0x6007, I16, 1),
        (0x603F, U16, 0),
        (0x6040, U16, 0),
        (0x6041, U16, SWITCH_ON_DISABLED),
        (0x605A, I16, 2),
        (0x6060, I8, 0),
        (0x6061, I8, 0),
        (0x6064, I32, 0),
        (0x6065, U32, 2000),
        (0x607A, I32, 0),
        (0x6085, U32, 10_000),
        (0x6502, U32, 1 << (CSP - 1)),
    ]:
        dictionary.add_object(variable(index, 0, data_type, default))
    record(0x1016, (U8, 1), (U32, 0))
    record(0x1018, (U8, 4), (U32, vendor), (U32, product), (U32, 1), (U32, 1000 + node_id))
    record(0x1029, (U8, 1), (U8, 0))
    record(0x607D, (U8, 2), (I32, 0), (I32, 0))
    record(0x60C2, (U8, 2), (U8, 1), (I8, -3))
    mapping = [(U8, 0)] + [(U32, 0)] * 8
    for communication, cob_id in [(0x1400, 0x200 + node_id), (0x1800, 0x180 + node_id)]:
        record(communication, (U8, 2), (U32, 1 << 31 | cob_id), (U8, 255))
        record(communication + 0x200, *mapping)
    return dictionary


class Drive:
    """A node and its axis."""

    def __init__(self, network: canopen.Network, node_id: int, vendor: int, product: int):
        self.lock = threading.Lock()
        self.node = canopen.LocalNode(node_id, object_dictionary(node_id, vendor, product))
        self.node.add_read_callback(self.read)
        self.node.add_write_callback(self.write)
        self.network = network
        self.controlword, self.statusword = 0, SWITCH_ON_DISABLED
        self.position = self.target = 0
        self.enabled_syncs = 0
        self.watched = []
        # Whether TPDO1 has the mapping that is sent here; None if not checked since it was written.
        self.is_mapped = None
        network.add_node(self.node)
        network.subscribe(0x200 + node_id, self.take_rpdo)
        network.subscribe(0x80, self.take_sync)
        self.node.nmt.send_command(0x81)
        self.node.nmt.send_command(0x80)

    def read(self, index, subindex, **_):
        return {
            0x6041: self.statusword,
            0x6061: self.node.sdo[0x6060].raw if index == 0x6061 else 0,
            0x6064: self.position,
        }.get(index)

    def write(self, index, data, **_):
        if index == 0x1A00:
            self.is_mapped = None
        if index == 0x1016:
            self.watched.append(struct.unpack("<I", data)[0])
        if index == 0x6040:
            with self.lock:
                self.controlword = struct.unpack("<H", data)[0]
                self.change_state()

    def mapped(self, index):
        """The objects that the master has mapped, each as index, subindex and bits in one number."""
        count = self.node.sdo[index][0].raw
        return [self.node.sdo[index][n].raw for n in range(1, count + 1)]

    def take_rpdo(self, _cob_id, data, _time):
        if self.node.nmt.state == "OPERATIONAL" and len(data) == 6:
            with self.lock:
                self.controlword, self.target = struct.unpack("<Hi", data)

    def take_sync(self, _cob_id, _data, _time):
        if self.node.nmt.state != "OPERATIONAL":
            return
        if self.is_mapped is None:
            self.is_mapped = self.mapped(0x1A00) == [0x6041_0010, 0x6064_0020]
        if not self.is_mapped:
            return
        with self.lock:
            answer = struct.pack("<Hi", self.statusword, self.position)
            if self.change_state() == ENABLED | DRIVE_FOLLOWS:
                self.enabled_syncs += 1
                self.position = self.target
        self.network.send_message(0x180 + self.node.id, answer)

    def change_state(self):
        """Makes one transition of the CiA 402 state machine towards the state that the controlword requests."""
        word, state = self.controlword, self.statusword & ~DRIVE_FOLLOWS
        if not word & DISABLE_VOLTAGE:
            state = SWITCH_ON_DISABLED
        elif not word & QUICK_STOP:
            state = QUICK_STOP_ACTIVE if state in (ENABLED, QUICK_STOP_ACTIVE) else SWITCH_ON_DISABLED
        elif word & 0x0F == 0x06 and state != QUICK_STOP_ACTIVE:
            state = READY
        elif word & 0x01 and state == READY:
            state = SWITCHED_ON
        elif word & 0x0F == 0x0F and state in (SWITCHED_ON, ENABLED):
            state = ENABLED | DRIVE_FOLLOWS
        elif word & 0x0F == 0x07 and state == ENABLED:
            state = SWITCHED_ON
        self.statusword = state
        return state


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--interface", default="socketcan", help="python-can's name for it")
    parser.add_argument("--channel", default="vcan0")
    parser.add_argument("--vendor", type=int, default=0x2F1)
    parser.add_argument("--product", type=int, default=0x402)
    options = parser.parse_args()
    logging.basicConfig(level=logging.WARNING)

    ended = threading.Event()
    signal.signal(signal.SIGINT, lambda *_: ended.set())
    with canopen.Network() as network:
        network.connect(interface=options.interface, channel=options.channel)
        drives = [Drive(network, n, options.vendor, options.product) for n in (1, 2)]
        print("ready", flush=True)
        ended.wait()
        for drive in drives:
            sdo = drive.node.sdo
            print(
                f"node {drive.node.id}: at {drive.position} counts, statusword"
                f" {drive.statusword:#06x}, {drive.enabled_syncs} SYNCs enabled,"
                f" mode {sdo[0x6060].raw}, RPDO1 {[hex(m) for m in drive.mapped(0x1600)]},"
                f" heartbeat {sdo[0x1017].raw} ms, watched {[hex(entry) for entry in drive.watched]}",
                flush=True,
            )
    return 0


if __name__ == "__main__":
    sys.exit(main())
