"""Reads TRANSFORMs of one device with pyigtl (0.3.4) and prints each as a line of JSON.

Exits with 0 after COUNT messages, with 1 if they do not come within TIMEOUT s.
"""

import argparse
import json
import sys
import time

import pyigtl


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--port", type=int, default=18944)
    parser.add_argument("--device", default="NeedleToTracker")
    parser.add_argument("--count", type=int, default=10)
    parser.add_argument("--timeout", type=float, default=20.0, help="s, for all of them")
    args = parser.parse_args()

    client = pyigtl.OpenIGTLinkClient(host=args.host, port=args.port)
    deadline = time.monotonic() + args.timeout
    for received in range(args.count):
        left = max(0.0, deadline - time.monotonic())
        message = client.wait_for_message(args.device, timeout=left)
        if message is None:
            print(f"{received} of {args.count} messages of {args.device} in time", file=sys.stderr)
            return 1
        matrix = message.matrix.tolist()
        line = {
            "device": message.device_name,
            "timestamp_s": message.timestamp,
            "position_mm": [row[3] for row in matrix[:3]],
            "rotation": [row[:3] for row in matrix[:3]],
        }
        print(json.dumps(line), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
