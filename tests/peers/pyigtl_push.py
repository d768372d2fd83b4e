"""Sends a fixed pose as a client to an OpenIGTLink server, with pyigtl (0.3.4), for DURATION s."""

import argparse
import sys
import time

import numpy as np
import pyigtl


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--port", type=int, default=18944)
    parser.add_argument("--device", default="NeedleToTracker")
    parser.add_argument("--rate", type=float, default=40.0, help="samples per second")
    parser.add_argument("--duration", type=float, default=60.0, help="s")
    args = parser.parse_args()

    client = pyigtl.OpenIGTLinkClient(host=args.host, port=args.port)
    pose = np.eye(4)
    pose[:3, 3] = [1.5, -2.5, 100.25]
    end = time.monotonic() + args.duration
    while time.monotonic() < end:
        if client.is_connected():
            message = pyigtl.TransformMessage(pose, device_name=args.device)
            client.send_message(message, wait=False)
        time.sleep(1.0 / args.rate)
    return 0


if __name__ == "__main__":
    sys.exit(main())
