#!/usr/bin/env python3
"""How many targets can be reached in space while the roll at the start is not known?

For depths in mm, prints how well the positions up to there tell the roll (RMS error of the posterior mean over
draws: 20 positions a mm, position at the start not known, heading known to 12 degrees, curvature known, the needle
bends one way), for uniform noise of +-1 mm and for Gaussian noise of the same variance, and the share of the targets
that one arc of the full curvature still reaches within 1 mm: after bending in a direction drawn at random up to
there, and after going straight, which tells nothing of the roll. Targets are drawn as
`bench-config/target-study.toml` does with `goal.in_plane=false`. Turns of the base cost nothing here. Needs numpy.
docs/targets.md has what follows from it.
"""

import math

import numpy as np

from rotate_to_target import RADIUS_MM, draw_targets

HALF_WIDTH_MM, POSITIONS_PER_MM, HEADING_SD = 1.0, 20, math.radians(12)
SHARE_MAX, TOLERANCE_MM, TARGETS = 0.9, 1.0, 200_000
DRAWS = 60
ROLLS = np.radians(np.arange(-180, 180, 2))
SLOPES = np.linspace(-4 * HEADING_SD, 4 * HEADING_SD, 801)
SLOPE_PRIOR = np.exp(-((SLOPES / HEADING_SD) ** 2) / 2)


def uniform_weights(s, positions, bends):
    """For each bend of one axis: the prior of all slopes and starts that leave every error within the limit."""
    residuals = positions[:, None] - SLOPES * s[:, None]
    weights = []
    for bend in bends:
        errors = residuals - (bend * s**2 / 2 / RADIUS_MM)[:, None]
        starts = 2 * HALF_WIDTH_MM - (errors.max(axis=0) - errors.min(axis=0))
        weights.append(np.sum(SLOPE_PRIOR * starts.clip(0)))
    return np.array(weights)


def gaussian_weights(s, positions, bends):
    """The same for Gaussian noise, by least squares with the prior of the slope as one more row."""
    sd_mm = HALF_WIDTH_MM / math.sqrt(3)
    rows = np.vstack([np.stack([np.ones_like(s), s], axis=1) / sd_mm, [0, 1 / HEADING_SD]])
    deflections = np.outer(s**2 / 2 / RADIUS_MM, bends)
    targets = np.vstack([(positions[:, None] - deflections) / sd_mm, np.zeros(len(bends))])
    left = targets - rows @ np.linalg.lstsq(rows, targets, rcond=None)[0]
    squares = np.sum(left**2, axis=0)
    return np.exp(-(squares - squares.min()) / 2)


def roll_rms_deg(depth_mm, is_uniform, random):
    s = np.arange(1, int(depth_mm * POSITIONS_PER_MM) + 1) / POSITIONS_PER_MM
    sd_mm, squares = HALF_WIDTH_MM / math.sqrt(3), []
    weights_of = uniform_weights if is_uniform else gaussian_weights
    for _ in range(DRAWS):
        roll, weights = random.uniform(-math.pi, math.pi), np.ones(len(ROLLS))
        for component in (np.cos, np.sin):
            path = random.normal(0, HEADING_SD) * s + component(roll) * s**2 / 2 / RADIUS_MM
            noise = random.uniform(-HALF_WIDTH_MM, HALF_WIDTH_MM, len(s)) if is_uniform else random.normal(0, sd_mm, len(s))
            weights *= weights_of(s, path + noise, component(ROLLS))
        mean = np.sum(weights * np.exp(1j * (ROLLS - roll)))
        squares.append(np.angle(mean) ** 2)
    return math.degrees(math.sqrt(np.mean(squares)))


def reached(target, tip, heading):
    """Share of the targets that one arc from a tip in the plane x = 0 reaches, its heading turned about x."""
    x, y, z = (target - tip).T
    c, s = math.cos(heading), math.sin(heading)
    aside, ahead = np.hypot(x, c * y - s * z), s * y + c * z
    return np.mean(np.hypot(RADIUS_MM - aside, ahead) >= RADIUS_MM - TOLERANCE_MM)


target = draw_targets(TARGETS, SHARE_MAX, np.random.default_rng(1))
for depth_mm in (4, 6, 8, 10, 12, 14, 16):
    angle = depth_mm / RADIUS_MM
    arc_end = RADIUS_MM * np.array([0, 1 - math.cos(angle), math.sin(angle)])
    bent, straight = reached(target, arc_end, angle), reached(target, [0, 0, depth_mm], 0.0)
    uniform, gaussian = (roll_rms_deg(depth_mm, kind, np.random.default_rng(2)) for kind in (True, False))
    print(
        f"{depth_mm} mm: roll to {uniform:.0f} degrees (Gaussian noise: {gaussian:.0f}); "
        f"{bent:.1%} after a bend, {straight:.1%} straight",
        flush=True,
    )
