#!/usr/bin/env python3
"""A third-party CANopen master makes a small motion with an emulated drive.

python-canopen maps the PDOs, brings the drive to OPERATION ENABLED in cyclic synchronous position
(CSP), moves it a little and back on its own SYNC, causes a following error and resets the fault,
homes the drive, and disables it. It prints each action on a line. The exit status is 0 if all
succeeded, else 1 with the reason on the last line.

    canopen_enable.py --interface socketcan --channel vcan0 --node 1
"""

import argparse
import sys
import time

import can
import canopen
from canopen.objectdictionary import ODRecord, ODVariable, datatypes
from canopen.profiles.p402 import BaseNode402

CSP = "CYCLIC SYNCHRONOUS POSITION"
CONTROLWORD = 0x6040
STATUSWORD = 0x6041
MODE_OF_OPERATION = 0x6060
MODE_DISPLAY = 0x6061
ACTUAL_POSITION = 0x6064
TARGET_POSITION = 0x607A
INTERPOLATION_PERIOD = 0x60C2
SUPPORTED_MODES = 0x6502
FOLLOWING_ERROR_WINDOW = 0x6065
HOMING_METHOD = 0x6098
HOMING_SPEEDS = 0x6099
DRIVE_FOLLOWS = 1 << 12  # in the statusword, in CSP

EMCY_FOLLOWING_ERROR = 0x8611
EMCY_NO_ERROR = 0x0000
INDEX_PULSE_BELOW = 33  # CiA 402-2, homing methods

TOLERANCE_COUNTS = 2

# Timeout of a wait, for a slow emulated machine. Only a test that fails waits this long.
PATIENCE_S = 10.0


class Failed(Exception):
    """The drive did not do what it was told."""


def object_dictionary() -> canopen.ObjectDictionary:
    """The objects used here, as CiA 301 and CiA 402 define them for any drive."""
    dictionary = canopen.ObjectDictionary()

    def variable(index: int, subindex: int, name: str, data_type: int) -> ODVariable:
        entry = ODVariable(name, index, subindex)
        entry.data_type = data_type
        return entry

    def record(index: int, name: str, types: dict[int, int]) -> None:
        entry = ODRecord(name, index)
        for subindex, data_type in types.items():
            entry.add_member(variable(index, subindex, f"{name} {subindex}", data_type))
        dictionary.add_object(entry)

    u8, u16, u32 = datatypes.UNSIGNED8, datatypes.UNSIGNED16, datatypes.UNSIGNED32
    i8, i32 = datatypes.INTEGER8, datatypes.INTEGER32
    for index, name, data_type in [
        (0x1000, "Device type", u32),
        (CONTROLWORD, "Controlword", u16),
        (STATUSWORD, "Statusword", u16),
        (MODE_OF_OPERATION, "Modes of operation", i8),
        (MODE_DISPLAY, "Modes of operation display", i8),
        (ACTUAL_POSITION, "Position actual value", i32),
        (TARGET_POSITION, "Target position", i32),
        (SUPPORTED_MODES, "Supported drive modes", u32),
        (FOLLOWING_ERROR_WINDOW, "Following error window", u32),
        (HOMING_METHOD, "Homing method", i8),
    ]:
        dictionary.add_object(variable(index, 0, name, data_type))
    record(0x1018, "Identity", {0: u8, 1: u32, 2: u32, 3: u32, 4: u32})
    record(INTERPOLATION_PERIOD, "Interpolation time period", {0: u8, 1: u8, 2: i8})
    record(HOMING_SPEEDS, "Homing speeds", {0: u8, 1: u32, 2: u32})
    mapping = {0: u8} | {subindex: u32 for subindex in range(1, 9)}
    for communication, mapped in [(0x1400, 0x1600), (0x1800, 0x1A00)]:
        record(communication, f"PDO {communication:X}", {0: u8, 1: u32, 2: u8})
        record(mapped, f"PDO mapping {mapped:X}", mapping)
    return dictionary


def say(text: str) -> None:
    print(text, flush=True)


def wait_until(what: str, condition) -> None:
    end = time.monotonic() + PATIENCE_S
    while not condition():
        if time.monotonic() > end:
            raise Failed(f"{what}: not within {PATIENCE_S:g} s")
        time.sleep(0.005)


class Master:
    """Commands one drive by python-canopen's CiA 402 node."""

    def __init__(self, network: canopen.Network, node_id: int, period_ms: int):
        self.network = network
        self.period_s = period_ms / 1000
        self.drive = BaseNode402(node_id, object_dictionary())
        self.drive.sdo.RESPONSE_TIMEOUT = PATIENCE_S
        self.drive.TIMEOUT_SWITCH_OP_MODE = PATIENCE_S
        self.drive.TIMEOUT_SWITCH_STATE_FINAL = PATIENCE_S
        self.drive.TIMEOUT_SWITCH_STATE_SINGLE = PATIENCE_S
        self.drive.TIMEOUT_CHECK_TPDO = PATIENCE_S
        # python-canopen waits for the reset before it sends the rising edge, so the wait is in vain.
        self.drive.TIMEOUT_RESET_FAULT = 0.0
        network.add_node(self.drive)

    def identify(self) -> None:
        sdo = self.drive.sdo
        self.drive.nmt.state = "PRE-OPERATIONAL"
        device_type = sdo[0x1000].raw
        if device_type & 0xFFFF != 402:
            raise Failed(f"0x1000 is {device_type:#010x}: not a CiA 402 drive")
        vendor, product = sdo[0x1018][1].raw, sdo[0x1018][2].raw
        say(f"node {self.drive.id}: a CiA 402 drive, vendor {vendor:#x}, product {product:#x}")

    def map_pdos(self) -> None:
        for pdo, mapped in [
            (self.drive.rpdo[1], (CONTROLWORD, TARGET_POSITION)),
            (self.drive.tpdo[1], (STATUSWORD, ACTUAL_POSITION)),
        ]:
            pdo.read()
            pdo.clear()
            for index in mapped:
                pdo.add_variable(index)
            pdo.cob_id = pdo.predefined_cob_id
            pdo.trans_type = 1
            pdo.enabled = True
            pdo.save()
            pdo.read()
            found = [variable.index for variable in pdo.map]
            if (found, pdo.trans_type, pdo.enabled) != (list(mapped), 1, True):
                raise Failed(f"{pdo.name} reads back otherwise than written: {found}, {pdo.trans_type}")
            say(f"{pdo.name}: {', '.join(f'{index:04X}' for index in mapped)}, on every SYNC")
        self.drive.setup_402_state_machine(read_pdos=False)

    def choose_csp(self) -> None:
        period = self.drive.sdo[INTERPOLATION_PERIOD]
        period[1].raw, period[2].raw = round(self.period_s * 1000), -3
        # The setter only logs a failure.
        self.drive.op_mode = CSP
        if self.drive.op_mode != CSP:
            raise Failed(f"0x6060 set to CSP, 0x6061 says {self.drive.op_mode}")
        say(f"mode: {CSP.lower()}, every {period[1].raw} ms")

    def start_cycle(self) -> None:
        # A drive whose target is its position cannot jump when it is enabled.
        self.command(self.drive.sdo[ACTUAL_POSITION].raw)
        self.drive.nmt.state = "OPERATIONAL"
        self.drive.rpdo[1].start(self.period_s)
        self.network.sync.start(self.period_s)
        self.cycle()
        say(f"cycle: statusword {self.drive.statusword:#06x}, at {self.position} counts")

    def enable(self) -> None:
        if self.drive.is_faulted():
            say("the drive is in FAULT: reset")
            self.drive.reset_from_fault()
        self.drive.state = "OPERATION ENABLED"
        wait_until("bit 12 of 6041, drive follows", lambda: self.drive.statusword & DRIVE_FOLLOWS)
        say(f"{self.drive.state}: statusword {self.drive.statusword:#06x}, at {self.position} counts")

    def move(self, counts: int, counts_per_cycle: int) -> None:
        start = self.position
        target = start + counts
        setpoint = start
        while setpoint != target:
            left = target - setpoint
            setpoint += max(-counts_per_cycle, min(counts_per_cycle, left))
            self.command(setpoint)
            self.cycle()
        wait_until(f"6064 at {target} counts", lambda: self.is_at(target))
        by_sdo = self.drive.sdo[ACTUAL_POSITION].raw
        if abs(by_sdo - target) > TOLERANCE_COUNTS:
            raise Failed(f"6064 is {by_sdo} by SDO and {self.position} by PDO, at rest")
        say(f"moved {counts:+d} counts: from {start} to {self.position}")

    def is_at(self, target: int) -> bool:
        if self.drive.state != "OPERATION ENABLED":
            raise Failed(f"it left OPERATION ENABLED: {self.drive.state}")
        return abs(self.position - target) <= TOLERANCE_COUNTS

    def fail_and_reset(self, window_counts: int) -> None:
        """Causes a following error, and resets the fault."""
        self.drive.sdo[FOLLOWING_ERROR_WINDOW].raw = window_counts
        start = self.position
        self.command(start + 100 * window_counts)
        wait_until("state FAULT", self.drive.is_faulted)
        wait_until("emergency 8611", lambda: self.emergencies() == [EMCY_FOLLOWING_ERROR])
        say(f"{self.drive.state}: {self.drive.emcy.log[-1]}")
        # The target becomes the position: the drive must not move when it is enabled again.
        self.command(self.position)
        self.drive.reset_from_fault()
        wait_until("emergency 0000", lambda: self.emergencies()[-1] == EMCY_NO_ERROR)
        wait_until("bit 12 of 6041, drive follows", lambda: self.drive.statusword & DRIVE_FOLLOWS)
        if abs(self.position - start) > window_counts:
            raise Failed(f"it moved from {start} to {self.position} counts on its way")
        say(f"{self.drive.state} after the reset: statusword {self.drive.statusword:#06x}")

    def emergencies(self) -> list[int]:
        return [emcy.code for emcy in self.drive.emcy.log]

    def home(self) -> None:
        self.drive.sdo[HOMING_METHOD].raw = INDEX_PULSE_BELOW
        # python-canopen may read the statusword before the drive has started, and take a drive that stands for an
        # interrupted homing. Then it must read it again.
        end = time.monotonic() + PATIENCE_S
        while not self.drive.homing(PATIENCE_S):
            if time.monotonic() > end:
                raise Failed(f"no homing: statusword {self.drive.statusword:#06x}")
        wait_until("6064 at 0 counts", lambda: abs(self.position) <= TOLERANCE_COUNTS)
        say(f"homed: statusword {self.drive.statusword:#06x}, at {self.position} counts")

    def disable(self) -> None:
        self.drive.state = "SWITCH ON DISABLED"
        say(f"{self.drive.state}: statusword {self.drive.statusword:#06x}")

    def leave(self) -> None:
        """Disables the drive, also after a failure, and ends the cycle."""
        if CONTROLWORD in self.drive.rpdo_pointers:
            self.drive.rpdo_pointers[CONTROLWORD].raw = 0
            time.sleep(3 * self.period_s)
        self.drive.rpdo[1].stop()
        self.network.sync.stop()
        self.drive.nmt.state = "PRE-OPERATIONAL"

    def command(self, position: int) -> None:
        self.drive.rpdo_pointers[TARGET_POSITION].raw = position

    def cycle(self) -> None:
        """Waits for the next TPDO."""
        if self.drive.tpdo[1].wait_for_reception(PATIENCE_S) is None:
            raise Failed(f"no TPDO1 within {PATIENCE_S:g} s of SYNC")

    @property
    def position(self) -> int:
        return self.drive.tpdo_values[ACTUAL_POSITION]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--interface", default="socketcan", help="python-can's name for it")
    parser.add_argument("--channel", default="vcan0")
    parser.add_argument("--node", type=int, default=1)
    parser.add_argument("--period-ms", type=int, default=20, help="of SYNC")
    parser.add_argument("--counts", type=int, default=400, help="how far to move, there and back")
    parser.add_argument("--counts-per-cycle", type=int, default=20)
    options = parser.parse_args()

    with canopen.Network() as network:
        network.connect(interface=options.interface, channel=options.channel)
        master = Master(network, options.node, options.period_ms)
        try:
            master.identify()
            master.map_pdos()
            master.choose_csp()
            master.start_cycle()
            master.enable()
            master.move(options.counts, options.counts_per_cycle)
            master.move(-options.counts, options.counts_per_cycle)
            master.fail_and_reset(options.counts)
            master.move(options.counts, options.counts_per_cycle)
            master.home()
            master.disable()
        except (Failed, RuntimeError, canopen.SdoCommunicationError, canopen.SdoAbortedError) as error:
            for emcy in master.drive.emcy.log:
                say(f"emergency: {emcy}")
            say(f"failed: node {options.node}: {error}")
            return 1
        finally:
            master.leave()
    say("done")
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except (can.CanError, OSError) as error:
        sys.exit(f"failed: {error}")
