"""Relays the tip positions of one OpenIGTLink server as another server, with pyigtl (0.3.4) on both sides.

Prints "listening PORT" once it serves; with port 0 the system chooses the port. Every new position keeps its stamp.
The relay ends with its only client, or after DURATION s; with --stay it serves one client after the other until then.
While the file CARRIED exists, the tool's TIP is at the position "x y z" (mm) in it, with 0.1 mm of noise, as if an
operator held it there.
"""

import argparse
import logging
import sys
import time
from pathlib import Path

import numpy as np
import pyigtl


def carried_to_mm(file):
    """Where the tool is carried to, if it is. The file may go at any moment, also between a question and reading it."""
    try:
        return [float(word) for word in file.read_text().split()] if file else None
    except FileNotFoundError:
        return None


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--from-host", default="127.0.0.1")
    parser.add_argument("--from-port", type=int, default=18944)
    parser.add_argument("--port", type=int, default=0)
    parser.add_argument("--device", default="NeedleToTracker")
    parser.add_argument("--duration", type=float, default=300.0, help="s, at most")
    parser.add_argument("--stay", action="store_true", help="serve one client after the other")
    parser.add_argument("--carried", type=Path, help="file with the position of the tool's tip")
    parser.add_argument("--tip", type=float, nargs=3, default=[0.0, 0.0, 0.0], help="the tip on the sensor, mm")
    args = parser.parse_args()
    # pyigtl logs the end of a client as an error.
    logging.disable(logging.ERROR)

    source = pyigtl.OpenIGTLinkClient(host=args.from_host, port=args.from_port)
    if source.wait_for_message(args.device, timeout=60.0) is None:
        print(f"no {args.device} from {args.from_host}:{args.from_port} in 60 s", file=sys.stderr)
        return 1
    server = pyigtl.OpenIGTLinkServer(port=args.port, local_server=True)
    print(f"listening {server.server_address[1]}", flush=True)

    end = time.monotonic() + args.duration
    served = 0
    noise = np.random.default_rng(1)
    while time.monotonic() < end:
        message = source.wait_for_message(args.device, timeout=1.0)
        place_mm = carried_to_mm(args.carried)
        if message is not None and place_mm:
            sensor_mm = place_mm - message.matrix[:3, :3] @ np.array(args.tip)
            message.matrix[:3, 3] = noise.normal(sensor_mm, 0.1)
        if server.is_connected() and message is not None:
            server.send_message(message, wait=False)
            served += 1
        elif served > 0 and not server.is_connected() and not args.stay:
            break
    print(f"{served} positions relayed", flush=True)
    return 0 if served > 0 else 1


if __name__ == "__main__":
    sys.exit(main())
