#!/usr/bin/env python3
"""How punctual SYNC is: the bench, python-canopen and python-can in turn on one bus, as one witness
sees them, with cyclictest beside each.

    usage: benches/sync_timing.py [--interface udp|vcan0] [--rounds 10] [--seconds 20] [--realtime]

The witness takes the time at which the kernel received each SYNC. Of each sender it prints the standard
deviation of the intervals, and by how much they differ from 10 ms, p50 and p99. For the bench it also
prints how late its manifest says that they were sent, and how long after the feedback the set-points were;
for all, how late cyclictest was woken in the same seconds, and jitterdebugger with --realtime. It needs the packages of
tests/peers/requirements.txt, cyclictest (Debian: rt-tests), with --realtime jitterdebugger, and a build: cargo build.
"""

import argparse
import contextlib
import json
import pathlib
import socket
import statistics
import struct
import subprocess
import sys
import tempfile
import threading
import time

PERIOD_S = 0.01
GROUP, PORT = "239.74.163.2", 43113
SO_TIMESTAMPNS = 35
ROOT = pathlib.Path(__file__).resolve().parent.parent


class Witness(threading.Thread):
    """Notes when the kernel received each frame of these identifiers: pairs of s and identifier."""

    def __init__(self, interface, identifiers):
        super().__init__(daemon=True)
        self.frames, self.ended, self.is_udp = [], False, interface == "udp"
        self.identifiers = identifiers
        if self.is_udp:
            self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
            self.socket.bind((GROUP, PORT))
            member = struct.pack("4s4s", socket.inet_aton(GROUP), socket.inet_aton("0.0.0.0"))
            self.socket.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, member)
        else:
            self.socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
            filters = b"".join(struct.pack("=II", identifier, 0x7FF) for identifier in identifiers)
            self.socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, filters)
            self.socket.bind((interface,))
        self.socket.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        self.socket.settimeout(0.2)

    def run(self):
        import msgpack

        while not self.ended:
            try:
                data, control, _, _ = self.socket.recvmsg(2048, 64)
            except TimeoutError:
                continue
            if self.is_udp:
                arbitration_id = msgpack.unpackb(data)["arbitration_id"]
            else:
                arbitration_id = struct.unpack_from("=I", data)[0] & 0x7FF
            if arbitration_id in self.identifiers and control:
                seconds, nanos = struct.unpack("qq", control[0][2])
                self.frames.append((seconds + nanos * 1e-9, arbitration_id))

    def finish(self):
        self.ended = True
        self.join()
        self.socket.close()
        return self.frames


def quantile(sorted_values, q):
    return sorted_values[min(int(q * len(sorted_values)), len(sorted_values) - 1)]


def figures(frames):
    """Of the SYNCs without the first and last half second, us."""
    times = [at_s for at_s, _ in frames]
    times = times and [t for t in times if times[0] + 0.5 <= t <= times[-1] - 0.5]
    if len(times) < 100:
        sys.exit("hardly any SYNC was seen")
    intervals = [b - a for a, b in zip(times, times[1:])]
    errors = sorted(abs(interval - PERIOD_S) for interval in intervals)
    return {
        "syncs": len(times),
        "interval_sd_us": statistics.pstdev(intervals) * 1e6,
        "error_us_p50": quantile(errors, 0.5) * 1e6,
        "error_us_p99": quantile(errors, 0.99) * 1e6,
    }


class Wakes:
    """How late cyclictest is woken; with a real-time priority jitterdebugger too, which always has one."""

    def __init__(self, seconds, realtime):
        self.folder = tempfile.TemporaryDirectory()
        loops = str(int(seconds / PERIOD_S))
        priority = ["-p", "79", "-m"] if realtime else []
        cyclictest = ["cyclictest", "-q", "-i", "10000", "-l", loops, "-h", "100000", *priority]
        commands = [[*cyclictest, f"--json={self.folder.name}/cyclictest.json"]]
        if realtime:
            commands.append(["jitterdebugger", "-i", "10000", "-l", loops, "-o", self.folder.name])
        silent = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        self.processes = [subprocess.Popen(command, **silent) for command in commands]

    def figures(self):
        for process in self.processes:
            process.wait()
        found = {}
        for name, file, threads in (
            ("cyclictest", "cyclictest.json", "thread"),
            ("jitterdebugger", "results.json", "cpu"),
        ):
            path = pathlib.Path(self.folder.name, file)
            if path.exists():
                histograms = (one["histogram"] for one in json.loads(path.read_text())[threads].values())
                rows = (row for histogram in histograms for row in histogram.items())
                late = sorted(us for text, count in rows for us in [int(text)] * count)
                found[f"{name}_us_p50"] = quantile(late, 0.5)
                found[f"{name}_us_p99"] = quantile(late, 0.99)
        return found


def python_can_bus(interface):
    """What python-can calls this bus."""
    if interface == "udp":
        return {"interface": "udp_multicast", "channel": GROUP}
    return {"interface": "socketcan", "channel": interface}


class Rig:
    """The bench and its drives on one bus, of one build."""

    def __init__(self, build, interface):
        self.build = build
        self.common = [str(ROOT / "bench-config/vcan.toml"), "--set", f"can.interface={interface}"]

    @contextlib.contextmanager
    def stage(self):
        """Drives and tracker, while the block runs."""
        silent = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        stage = subprocess.Popen([self.build / "vcan-stage", *self.common], **silent)
        time.sleep(1)
        try:
            yield
        finally:
            stage.kill()
            stage.wait()

    def run(self, seconds, realtime):
        """What the manifest of an insertion that takes so long says of its timing."""
        with tempfile.TemporaryDirectory() as runs:
            run = [self.build / "needle-bench", "run", *self.common, "--set", f"record.dir={runs}", "-q"]
            depth = ["--set", f"insertion.depth_mm={2 * seconds}", "--set", "insertion.speed_mm_per_s=2"]
            command = [*run, *depth, *(["--realtime"] if realtime else [])]
            ended = subprocess.run(command, capture_output=True, text=True)
            manifests = list(pathlib.Path(runs).glob("*/manifest.json"))
            if ended.returncode != 0 or not manifests:
                sys.exit(f"the bench did not run: {ended.stderr}")
            return json.loads(manifests[0].read_text())["timing"]


def bench(interface, seconds, realtime):
    rig = Rig(ROOT / "target/debug", interface)
    with rig.stage():
        timing = rig.run(seconds, realtime)
    return {
        "sent_us_p50": timing["sync_late_us_p50"],
        "sent_us_p99": timing["sync_late_us_p99"],
        "skipped": timing["syncs_skipped"],
        "set_point_us_p50": timing["set_point_us_p50"],
        "set_point_us_p99": timing["set_point_us_p99"],
    }


def python(what, interface, seconds):
    bus = python_can_bus(interface)
    code = {
        "python-canopen": f"""
import canopen, time
network = canopen.Network()
network.connect(**{bus!r})
network.sync.start({PERIOD_S})
time.sleep({seconds})
network.sync.stop()
network.disconnect()
""",
        "python-can": f"""
import can, time
with can.Bus(**{bus!r}) as bus:
    message = can.Message(arbitration_id=0x80, is_extended_id=False)
    task = bus.send_periodic(message, {PERIOD_S})
    time.sleep({seconds})
    task.stop()
""",
    }[what]
    subprocess.run([sys.executable, "-c", code], check=True)
    return {}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--interface", default="udp")
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--seconds", type=float, default=20)
    parser.add_argument("--realtime", action="store_true")
    args = parser.parse_args()

    senders = ["bench", "python-canopen", "python-can"]
    found = {sender: [] for sender in senders}
    for number in range(args.rounds):
        for sender in senders:
            witness = Witness(args.interface, {0x80})
            witness.start()
            wakes = Wakes(args.seconds, args.realtime)
            if sender == "bench":
                more = bench(args.interface, args.seconds, args.realtime)
            else:
                more = python(sender, args.interface, args.seconds)
            row = {**figures(witness.finish()), **more, **wakes.figures()}
            found[sender].append(row)
            text = ", ".join(f"{key} {value:.0f}" for key, value in row.items())
            print(f"{number + 1} {sender}: {text}", flush=True)
    print("\nmedian of the rounds")
    for sender, rows in found.items():
        keys = rows[0].keys()
        medians = {key: statistics.median(row[key] for row in rows) for key in keys}
        text = ", ".join(f"{key} {value:.0f}" for key, value in medians.items())
        print(f"{sender}: {text}")
    for other in senders[1:]:
        for key in ("interval_sd_us", "error_us_p99"):
            wins = sum(a[key] < b[key] for a, b in zip(found["bench"], found[other]))
            print(f"{key}: the bench was ahead of {other} in {wins} of {args.rounds} rounds")


if __name__ == "__main__":
    main()
