#!/usr/bin/env python3
"""What a display costs the control thread: the same insertion in turn without any, with the one line on a
terminal of 120 x 40, with the console on it, and with the console on a terminal that takes no output from 3 s on.

    usage: benches/console_timing.py [--rounds 5] [--depth 12] [--profile release]

Both programs run here, over UDP. It prints medians over the completed runs of the manifest's `timing`, in us,
and the ratio to those without a display. A run that was stopped is named and not counted. It needs a build:
cargo build --release.
"""

import argparse
import fcntl
import json
import os
import pathlib
import pty
import statistics
import struct
import subprocess
import tempfile
import termios
import threading
import time

ROOT = pathlib.Path(__file__).resolve().parent.parent
GROUP = "239.74.163.3:43113"
TRACKER = "127.0.0.1:18955"
SET = [f'can.interface="udp:{GROUP}"', f'tracker.address="{TRACKER}"']
RUN = ["insertion.speed_mm_per_s=2.5", 'insertion.plane_out_of_reach="insert"']
ROWS = [
    ("set-point after its feedback, p50", "set_point_us_p50"),
    ("set-point after its feedback, p99", "set_point_us_p99"),
    ("SYNC after its deadline, p50", "sync_late_us_p50"),
    ("SYNC after its deadline, p99", "sync_late_us_p99"),
    ("SYNC after its deadline, at most", "sync_late_us_max"),
]


def settings(pairs):
    return [word for pair in pairs for word in ("--set", pair)]


def on_terminal(command, frozen):
    """Starts `command` on a terminal of 120 x 40, whose output is read, for 3 s only if it is `frozen`."""
    master, slave = pty.openpty()
    fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("4H", 40, 120, 0, 0))
    begun = time.monotonic()
    running = subprocess.Popen(
        ["setsid", "--ctty", *command], stdin=slave, stdout=subprocess.DEVNULL, stderr=slave
    )
    os.close(slave)
    over = threading.Event()

    def read():
        while not over.is_set() and not (frozen and time.monotonic() - begun > 3.0):
            try:
                os.read(master, 65536)
            except OSError:
                return

    threading.Thread(target=read, daemon=True).start()
    return running, master, over


def insert(kind, depth_mm, programs):
    with tempfile.TemporaryDirectory() as folder:
        config = str(ROOT / "bench-config/vcan.toml")
        stage = subprocess.Popen(
            [programs / "vcan-stage", config, *settings(SET)], stderr=subprocess.PIPE, text=True
        )
        stage.stderr.readline()
        depth = [f"insertion.depth_mm={depth_mm}", f'record.dir="{folder}"']
        command = [programs / "needle-bench", "run", config, *settings(SET + RUN + depth)]
        try:
            if kind == "none":
                subprocess.run([*command, "-q"], capture_output=True, check=False)
            else:
                words = [] if kind == "line" else ["--console"]
                running, master, over = on_terminal([*command, *words], kind == "frozen")
                deadline = time.monotonic() + 60
                while not is_over(folder) and time.monotonic() < deadline:
                    time.sleep(0.2)
                while running.poll() is None and time.monotonic() < deadline:
                    # The console stays until the operator leaves it.
                    os.write(master, b"q")
                    time.sleep(0.5)
                over.set()
                running.kill()
                running.wait()
                os.close(master)
        finally:
            stage.terminate()
            stage.wait()
        (manifest,) = pathlib.Path(folder).glob("*/manifest.json")
        return json.loads(manifest.read_text())


def is_over(folder):
    manifests = pathlib.Path(folder).glob("*/manifest.json")
    return any(json.loads(manifest.read_text()).get("outcome") for manifest in manifests)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--depth", type=float, default=12.0, help="mm")
    parser.add_argument("--profile", default="release", help="debug or release")
    arguments = parser.parse_args()
    programs = ROOT / "target" / arguments.profile
    kinds = ["none", "line", "console", "frozen"]
    found = {kind: [] for kind in kinds}
    for number in range(arguments.rounds):
        for kind in kinds:
            manifest = insert(kind, arguments.depth, programs)
            load = os.getloadavg()[0]
            print(f"round {number + 1}, {kind}: {manifest['outcome']}, load average {load:.1f}")
            if manifest["outcome"] != "completed":
                print(f"  {manifest['stop_reason']}")
                continue
            found[kind].append(manifest["timing"])
    print("| | none | one line | ratio | `--console` | ratio | frozen | ratio |")
    print("|---|---|---|---|---|---|---|---|")
    for name, key in ROWS:
        medians = {k: statistics.median(run[key] for run in found[k]) for k in kinds}
        base = medians["none"]
        cells = [f"{base:.0f}"]
        for kind in kinds[1:]:
            ratio = f"{medians[kind] / base:.2f}" if base else ""
            cells += [f"{medians[kind]:.0f}", ratio]
        print(f"| {name} | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
