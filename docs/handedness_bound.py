#!/usr/bin/env python3
"""How early can positions show that they are those of a mirrored needle?

Prints, for depths in mm, the largest expected log odds of the true hand over the mirrored one, over
programs of turning the base: small angles, Gaussian noise of the variance of +-1 mm uniform, 20
positions a mm; position, heading and roll at the start are not known, curvature and torsion are.
Needs numpy. decisions/0010-believing-the-tracker.md has what follows from it.
"""
import math

import numpy as np

CURVATURE_PER_MM = 1 / 122
SD_MM = 1 / math.sqrt(3)
POSITIONS_PER_MM = 20
POINTS = 301
PIECES = 8


def log_odds(rotation_rad, depth_mm):
    """Half the squared distance of the two paths over the noise, at the best fit of the mirrored one."""
    grid = np.linspace(0, depth_mm, POINTS)

    def twice_integrated(curve):
        for _ in range(2):
            steps = (curve[1:] + curve[:-1]) / 2 * (grid[1] - grid[0])
            curve = np.concatenate([[0], np.cumsum(steps)])
        return curve

    # What a start at another position and heading explains.
    base, _ = np.linalg.qr(np.stack([np.ones(POINTS), grid], 1))
    across = [CURVATURE_PER_MM * twice_integrated(f(rotation_rad)) for f in (np.cos, np.sin)]
    c, s = (a - base @ (base.T @ a) for a in across)
    true, mirrored = c + 1j * s, c - 1j * s
    # The mirrored one may have started at any roll.
    apart = 2 * (np.vdot(true, true).real - abs(np.vdot(mirrored, true)))
    return 0.5 * apart / POINTS * POSITIONS_PER_MM * depth_mm / SD_MM**2


def largest(depth_mm, rng):
    """Over constant turns, and over a random search of turns in pieces."""
    grid = np.linspace(0, depth_mm, POINTS)
    best = max(log_odds(rate * grid, depth_mm) for rate in np.linspace(0.02, 0.6, 59))

    def of(rates):
        each = np.repeat(rates, math.ceil((POINTS - 1) / PIECES))[: POINTS - 1]
        turned = np.cumsum(each * depth_mm / (POINTS - 1))
        return log_odds(np.concatenate([[0], turned]), depth_mm)

    for _ in range(6):
        rates = rng.uniform(-0.3, 0.3, PIECES)
        found, step = of(rates), 0.2
        for _ in range(1500):
            tried = rates + rng.normal(0, step, PIECES)
            odds = of(tried)
            if odds > found:
                rates, found = tried, odds
            else:
                step = max(step * 0.995, 0.01)
        best = max(best, found)
    return best


rng = np.random.default_rng(1)
for depth_mm in (15, 20, 22, 23, 25, 30):
    print(f"{depth_mm} mm: {largest(depth_mm, rng):.1f}")
