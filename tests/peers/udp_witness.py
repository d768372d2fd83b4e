"""Prints the frames on a udp_multicast bus as python-can (4.6.1) reads them, one per line.

Each line is `id#data`, as in candump -L. Prints "listening" first; ends on SIGINT.
"""

import argparse
import os
import signal
import socket
import sys

import can


# The SDO requests of a bring-up come faster than Python reads them; the default buffer holds some 270 frames.
RECEIVE_BUFFER_BYTES = 2_000_000


def enlarge_receive_buffer(bus):
    with socket.socket(fileno=os.dup(bus.fileno())) as udp:
        udp.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--group", required=True)
    args = parser.parse_args()

    ended = []
    signal.signal(signal.SIGINT, lambda *_: ended.append(True))
    with can.Bus(interface="udp_multicast", channel=args.group) as bus:
        enlarge_receive_buffer(bus)
        print("listening", flush=True)
        while not ended:
            message = bus.recv(0.1)
            if message is not None:
                width = 8 if message.is_extended_id else 3
                print(f"{message.arbitration_id:0{width}X}#{message.data.hex().upper()}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
