"""Prints the frames on a udp_multicast bus as python-can (4.6.1) reads them, one per line.

Each line is `id#data`, as in candump -L. Prints "listening" first; ends on SIGINT.
"""

import argparse
import signal
import sys

import can


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--group", required=True)
    args = parser.parse_args()

    ended = []
    signal.signal(signal.SIGINT, lambda *_: ended.append(True))
    with can.Bus(interface="udp_multicast", channel=args.group) as bus:
        print("listening", flush=True)
        while not ended:
            message = bus.recv(0.1)
            if message is not None:
                width = 8 if message.is_extended_id else 3
                print(f"{message.arbitration_id:0{width}X}#{message.data.hex().upper()}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
