#!/usr/bin/env python3
"""How long after the drives' feedback the next set-points are on the bus: the bench and a loop of pyigtl
and python-canopen in turn, with the same drives and tracker (vcan-stage), as one witness sees them.

    usage: benches/set_point_timing.py [--interface udp|vcan0] [--rounds 10] [--seconds 10] [--realtime]

The witness takes the times at which the kernel received the frames: from the second TPDO1 after a SYNC to the
second RPDO1 after it, in each cycle. The bench steers a needle in that time: it estimates the pose with its
default observer. The loop in Python takes the newest position of the tracker, sends the targets at which the
drives stand, moved by less than a count, to drives without power, and estimates nothing. It needs the packages of
tests/peers/requirements.txt and a build: cargo build (--profile release: cargo build --release).
"""

import argparse
import statistics
import subprocess
import sys
import time

from sync_timing import PERIOD_S, ROOT, Rig, Witness, python_can_bus, quantile

SYNC, TPDO1, RPDO1 = 0x80, (0x181, 0x182), (0x201, 0x202)


def answers_us(frames):
    """Of the frames without the first and last second: second TPDO1 to second RPDO1 of each cycle, us."""
    frames = [frame for frame in frames if frames[0][0] + 1 <= frame[0] <= frames[-1][0] - 1]
    found, feedback, set_points = [], [], []
    for at_s, arbitration_id in frames:
        if arbitration_id == SYNC:
            feedback, set_points = [], []
        elif arbitration_id in TPDO1:
            feedback.append(at_s)
        elif len(feedback) == 2:
            set_points.append(at_s)
            if len(set_points) == 2:
                found.append((at_s - feedback[1]) * 1e6)
    return found


def python_loop(interface, seconds):
    """Both drives Operational, without power, with pyigtl's newest position in each cycle."""
    sys.path.insert(0, str(ROOT / "tests/peers"))
    import canopen
    import pyigtl
    from canopen_enable import ACTUAL_POSITION, Master

    tracker = pyigtl.OpenIGTLinkClient(host="127.0.0.1", port=18944)
    with canopen.Network() as network:
        network.connect(**python_can_bus(interface))
        masters = [Master(network, node, round(PERIOD_S * 1000)) for node in (1, 2)]
        waiting, tip_mm = set(), None

        def answer(message_map):
            nonlocal tip_mm
            waiting.discard(message_map.cob_id)
            if waiting:
                return
            waiting.update(TPDO1)
            message = tracker.get_latest_messages()
            for one in message:
                tip_mm = one.matrix[:3, 3]
            for master, home in zip(masters, homes):
                offset = 0 if tip_mm is None else 0.4 * (tip_mm[0] > 0)
                master.command(round(home + offset))
                master.drive.rpdo[1].transmit()

        for master in masters:
            master.identify()
            master.map_pdos()
            master.choose_csp()
            master.command(master.drive.sdo[ACTUAL_POSITION].raw)
            master.drive.nmt.state = "OPERATIONAL"
        homes = [master.drive.sdo[ACTUAL_POSITION].raw for master in masters]
        waiting.update(TPDO1)
        for master in masters:
            master.drive.tpdo[1].add_callback(answer)
        network.sync.start(PERIOD_S)
        time.sleep(seconds)
        network.sync.stop()


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--interface", default="udp")
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--seconds", type=float, default=10)
    parser.add_argument("--realtime", action="store_true")
    parser.add_argument("--profile", default="debug", choices=["debug", "release"])
    parser.add_argument("--as-loop", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.as_loop:
        python_loop(args.interface, args.seconds)
        return

    rig = Rig(ROOT / "target" / args.profile, args.interface)
    found = {"bench": [], "loop in Python": []}
    for number in range(args.rounds):
        for name, rows in found.items():
            with rig.stage():
                witness = Witness(args.interface, {SYNC, *TPDO1, *RPDO1})
                witness.start()
                if name == "bench":
                    rig.run(args.seconds, args.realtime)
                else:
                    loop = [sys.executable, __file__, "--as-loop", "--interface", args.interface]
                    loop += ["--seconds", str(args.seconds)]
                    subprocess.run(loop, check=True, stdout=subprocess.DEVNULL)
                answers = sorted(answers_us(witness.finish()))
            if len(answers) < 100:
                sys.exit(f"{name}: hardly any set-point was seen: {len(answers)}")
            row = [quantile(answers, q) for q in (0.5, 0.99, 1.0)]
            rows.append(row)
            p50, p99, most = row
            print(f"{number + 1} {name}: p50 {p50:.0f}, p99 {p99:.0f}, at most {most:.0f} us, {len(answers)} cycles")
    print("\nmedian of the rounds, us")
    for name, rows in found.items():
        p50, p99, most = (statistics.median(column) for column in zip(*rows))
        print(f"{name}: p50 {p50:.0f}, p99 {p99:.0f}, at most {most:.0f}")


if __name__ == "__main__":
    main()
