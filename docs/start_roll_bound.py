#!/usr/bin/env python3
"""How many targets can be reached in space while the roll at the start is not known?

For depths in mm, prints the standard deviation of the roll that positions up to there leave at best
(Cramer-Rao: small angles, Gaussian noise of the variance of +-1 mm uniform, 20 positions a mm, position at
the start not known, heading known to 12 degrees, curvature known, the needle bends one way), and the share of
the targets that one arc of the full curvature still reaches within 1 mm: after bending in a direction drawn at
random up to there, and after going straight, which tells nothing of the roll. Targets are drawn as
`bench-config/target-study.toml` does with `goal.in_plane=false`. Turns of the base cost nothing here. Needs numpy.
docs/targets.md has what follows from it.
"""

import math

import numpy as np

from rotate_to_target import RADIUS_MM, draw_targets

SD_MM, POSITIONS_PER_MM, HEADING_SD = 1 / math.sqrt(3), 20, math.radians(12)
SHARE_MAX, TOLERANCE_MM, TARGETS = 0.9, 1.0, 200_000


def roll_sd_deg(depth_mm):
    """What a small turn of the plane of bending does to the positions: across it, by the deflection."""
    s = np.arange(1, int(depth_mm * POSITIONS_PER_MM) + 1) / POSITIONS_PER_MM
    columns = np.stack([np.ones_like(s), s, s**2 / 2 / RADIUS_MM], axis=1)
    information = columns.T @ columns / SD_MM**2
    information[1, 1] += 1 / HEADING_SD**2
    return math.degrees(math.sqrt(np.linalg.inv(information)[2, 2]))


def reached(target, tip, heading):
    """Share of the targets that one arc from a tip in the plane x = 0 reaches, its heading turned about x."""
    x, y, z = (target - tip).T
    c, s = math.cos(heading), math.sin(heading)
    aside, ahead = np.hypot(x, c * y - s * z), s * y + c * z
    return np.mean(np.hypot(RADIUS_MM - aside, ahead) >= RADIUS_MM - TOLERANCE_MM)


target = draw_targets(TARGETS, SHARE_MAX, np.random.default_rng(1))
for depth_mm in (8, 10, 12, 14, 16, 20):
    angle = depth_mm / RADIUS_MM
    arc_end = RADIUS_MM * np.array([0, 1 - math.cos(angle), math.sin(angle)])
    bent, straight = reached(target, arc_end, angle), reached(target, [0, 0, depth_mm], 0.0)
    print(f"{depth_mm} mm: roll to {roll_sd_deg(depth_mm):.0f} degrees; {bent:.1%} after a bend, {straight:.1%} straight")
