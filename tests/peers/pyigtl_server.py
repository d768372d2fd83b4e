"""Serves tip positions along a curve as OpenIGTLink TRANSFORMs, with pyigtl (0.3.4).

The curve is the arc of a needle of radius 122 mm that is inserted along z at 5 mm/s and bends
towards x. Prints "listening PORT" once it listens; with port 0 the system chooses the port. Serves
one client, for DURATION s from its connection.
"""

import argparse
import math
import sys
import time

import numpy as np
import pyigtl

RADIUS_MM = 122.0
SPEED_MM_PER_S = 5.0


def tip_pose(depth_mm):
    """The tip's pose after depth_mm of insertion: position on the arc, z along the needle."""
    angle = depth_mm / RADIUS_MM
    pose = np.eye(4)
    pose[0, 0] = pose[2, 2] = math.cos(angle)
    pose[0, 2] = math.sin(angle)
    pose[2, 0] = -math.sin(angle)
    pose[:3, 3] = [RADIUS_MM * (1 - math.cos(angle)), 0.0, RADIUS_MM * math.sin(angle)]
    return pose


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--port", type=int, default=18944)
    parser.add_argument("--device", default="NeedleToTracker")
    parser.add_argument("--rate", type=float, default=40.0, help="samples per second")
    parser.add_argument("--duration", type=float, default=60.0, help="s, from the connection")
    args = parser.parse_args()

    server = pyigtl.OpenIGTLinkServer(port=args.port, local_server=True)
    print(f"listening {server.server_address[1]}", flush=True)
    deadline = time.monotonic() + 60.0
    while not server.is_connected():
        if time.monotonic() > deadline:
            print("no client within 60 s", file=sys.stderr)
            return 1
        time.sleep(0.01)

    start = time.monotonic()
    sample = 0
    while (elapsed := time.monotonic() - start) < args.duration and server.is_connected():
        pose = tip_pose(SPEED_MM_PER_S * elapsed)
        message = pyigtl.TransformMessage(pose, timestamp=time.time(), device_name=args.device)
        server.send_message(message, wait=False)
        sample += 1
        time.sleep(max(0.0, start + sample / args.rate - time.monotonic()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
