#!/usr/bin/env python3
"""One long insertion of 300 mm with scattered faults that a run tolerates, and its memory use.

    usage: benches/soak.py [--hours 24]           virtual stage, virtual time
           benches/soak.py --udp [--hours 0.333]  vcan-stage over UDP, real time

Every 1/24 of the time a frame of a drive is lost, doubled or late. Over UDP, the tracker falls silent for 2 s
in between, and the run goes on by itself (tracker.resume = "automatic"). It prints the outcome, what was
counted, and the resident memory at each quarter, at most, and after the record was closed. It needs a build:
cargo build --release.
"""

import argparse
import json
import os
import pathlib
import select
import socket
import subprocess
import tempfile
import threading
import time

ROOT = pathlib.Path(__file__).resolve().parent.parent
GROUP = "239.74.163.4:43113"
TRACKER = ("127.0.0.1", 18957)
DEPTH_MM = 300
PARTS = 24
FAULTS = [
    'kind = "drop", frames = "pdo", axis = "insertion", count = 1',
    'kind = "duplicate", frames = "pdo", axis = "rotation", count = 1',
    'kind = "drop", frames = "heartbeat", axis = "rotation", count = 1',
    'kind = "drop", frames = "pdo", toward = "drives", axis = "rotation", count = 1',
]


def settings(pairs):
    return [word for pair in pairs for word in ("--set", pair)]


def faults(seconds):
    times = [seconds * part / PARTS for part in range(1, PARTS)]
    listed = [f"{{ at_s = {at:.1f}, {FAULTS[n % len(FAULTS)]} }}" for n, at in enumerate(times)]
    return f"emulator.fault=[{', '.join(listed)}]"


def relay(silence_every_s):
    """A port whose client gets what the tracker sends, but for 2 s every so often; the count of silences."""
    listener = socket.create_server(("127.0.0.1", 0))
    silences = []

    def serve():
        bench, _ = listener.accept()
        tracker = socket.create_connection(TRACKER)
        begun = time.monotonic()
        until, silent_at = begun, begun + 1.5 * silence_every_s
        while True:
            ready, _, _ = select.select([tracker], [], [], 0.1)
            now = time.monotonic()
            if now >= silent_at:
                until, silent_at = now + 2.0, silent_at + silence_every_s
                silences.append(now - begun)
            try:
                data = tracker.recv(65536) if ready else b""
                if ready and not data:
                    return
                # Whole messages: the tracker sends one at a time.
                if data and now >= until:
                    bench.sendall(data)
            except OSError:
                return

    threading.Thread(target=serve, daemon=True).start()
    return listener.getsockname()[1], silences


def resident_mb(pid):
    try:
        lines = pathlib.Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:
        return None
    return next((int(line.split()[1]) / 1024 for line in lines if line.startswith("VmRSS")), None)


def watch(bench, started):
    """The resident memory of `bench` by the wall clock, MB, until it has ended."""
    seen = []
    while bench.poll() is None:
        mb = resident_mb(bench.pid)
        if mb is not None:
            seen.append((time.monotonic() - started, mb))
        time.sleep(0.5)
    return seen


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--udp", action="store_true")
    parser.add_argument("--hours", type=float)
    parser.add_argument("--profile", default="release", help="debug or release")
    arguments = parser.parse_args()
    seconds = 3600 * (arguments.hours or (1 / 3 if arguments.udp else 24))
    programs = ROOT / "target" / arguments.profile
    with tempfile.TemporaryDirectory(dir=os.environ.get("TMPDIR")) as folder:
        run = [
            f'record.dir="{folder}"',
            f"insertion={{ depth_mm = {DEPTH_MM}, plane_out_of_reach = \"insert\" }}",
            f"insertion.speed_mm_per_s={DEPTH_MM / seconds:.6f}",
            f"stage.insertion.max_mm={DEPTH_MM + 5}",
        ]
        stage, silences = None, []
        if arguments.udp:
            config = str(ROOT / "bench-config/vcan.toml")
            bus = f'can.interface="udp:{GROUP}"'
            there = [bus, f'tracker.address="{TRACKER[0]}:{TRACKER[1]}"']
            command = [programs / "vcan-stage", config, *settings([*there, faults(seconds)])]
            stage = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
            stage.stderr.readline()
            port, silences = relay(seconds / 12)
            run += [bus, f'tracker.address="127.0.0.1:{port}"', 'tracker.resume="automatic"']
            words = ["run", config, *settings(run)]
        else:
            words = ["run", *settings([*run, faults(seconds)])]
        started = time.monotonic()
        with open(pathlib.Path(folder) / "said", "w", encoding="utf-8") as said:
            bench = subprocess.Popen([programs / "needle-bench", *words, "-q", "--json"], stdout=said)
            seen = watch(bench, started)
        if stage:
            stage.terminate()
            stage.wait()
        (manifest,) = pathlib.Path(folder).glob("*/manifest.json")
        manifest = json.loads(manifest.read_text())
        size = sum(file.stat().st_size for file in pathlib.Path(folder).glob("*/*"))
        took = time.monotonic() - started
        print(f"{manifest['outcome']}: {manifest.get('stop_reason')}")
        print(f"{manifest['duration_s']:.0f} s of the run in {took:.0f} s, {size / 1e6:.0f} MB recorded")
        told = json.loads((pathlib.Path(folder) / "said").read_text())
        print(f"silences of the tracker: {len(silences)}, holds: {told['holds']}")
        print(f"lost of the record: {manifest.get('dropped')}")
        print(f"timing: {json.dumps(manifest.get('timing'))}")
        parts = [seen[min(len(seen) - 1, len(seen) * part // 4)][1] for part in range(1, 5)]
        print("resident, MB, at each quarter of the time:", ", ".join(f"{mb:.0f}" for mb in parts))
        print(f"resident at most: {max(mb for _, mb in seen):.0f} MB")


if __name__ == "__main__":
    main()
