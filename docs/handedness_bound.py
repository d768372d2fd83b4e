#!/usr/bin/env python3
"""How early can positions show that they are those of a mirrored needle?

Prints, for depths in mm, the largest expected log odds of the true hand over the mirrored one, over
programs of turning the base: small angles, Gaussian noise of the variance of +-1 mm uniform, 20
positions a mm (40 Hz at 2 mm/s) and 40 (at 1 mm/s); position, heading and roll at the start are not known, curvature and torsion are.
With a file that NEEDLE_ROTATIONS made (tests/pure/faults/contradictions.rs) it prints the depths at which
the rotations that the bench commanded reach the log odds that a decision needs; the heading at the start is
then known as the bench is told by default. Then follows when a registration that is turned by 90 degrees about z
is decided, the roll at the start being told.
Needs numpy. decisions/0010-believing-the-tracker.md has what follows from it.
"""
import csv
import itertools
import math
import sys

import numpy as np

CURVATURE_PER_MM = 1 / 122
SD_MM = 1 / math.sqrt(3)
POINTS = 301
PIECES = 8
# One correct run in 10,000 is stopped, and half of the mirrored ones are: d' = 3.72, half its square.
DECIDES = 6.9
# What the bench is told of the heading at the start (observer.invariant.start_sd.yaw_deg).
HEADING_SD = math.radians(12)


def log_odds(rotation_rad, depth_mm, positions_per_mm, heading_sd=math.inf):
    """Half the squared distance of the two paths over the noise, at the best fit of the mirrored one."""
    grid = np.linspace(0, depth_mm, POINTS)

    def twice_integrated(curve):
        for _ in range(2):
            steps = (curve[1:] + curve[:-1]) / 2 * (grid[1] - grid[0])
            curve = np.concatenate([[0], np.cumsum(steps)])
        return curve

    # What a start at another position and heading explains. The last row is what is known of the heading.
    weight = math.sqrt(positions_per_mm * depth_mm / POINTS) / SD_MM
    rows = np.vstack([weight * np.stack([np.ones(POINTS), grid], 1), [0, 1 / heading_sd]])
    base, _ = np.linalg.qr(rows)
    across = [weight * CURVATURE_PER_MM * twice_integrated(f(rotation_rad)) for f in (np.cos, np.sin)]
    c, s = (a - base @ (base.T @ a) for a in (np.append(a, 0) for a in across))
    true, mirrored = c + 1j * s, c - 1j * s
    # The mirrored one may have started at any roll.
    return np.vdot(true, true).real - abs(np.vdot(mirrored, true))


def largest(depth_mm, positions_per_mm, rng):
    """Over constant turns, and over a random search of turns in pieces."""
    grid = np.linspace(0, depth_mm, POINTS)
    best = max(log_odds(rate * grid, depth_mm, positions_per_mm) for rate in np.linspace(0.02, 0.6, 59))

    def of(rates):
        each = np.repeat(rates, math.ceil((POINTS - 1) / PIECES))[: POINTS - 1]
        turned = np.cumsum(each * depth_mm / (POINTS - 1))
        return log_odds(np.concatenate([[0], turned]), depth_mm, positions_per_mm)

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


def turned(depth_mm, positions_per_mm):
    """Expected log odds that a registration is turned by 90 degrees about z, where the roll at the start is told: the
    two paths bend by the same curvature across each other."""
    grid = np.linspace(0, depth_mm, POINTS)
    weight = math.sqrt(positions_per_mm * depth_mm / POINTS) / SD_MM
    rows = np.vstack([weight * np.stack([np.ones(POINTS), grid], 1), [0, 1 / HEADING_SD]])
    base, _ = np.linalg.qr(rows)
    bend = np.append(weight * CURVATURE_PER_MM * grid**2 / 2, 0)
    # Of each of the two axes half the squared distance.
    return np.sum((bend - base @ (base.T @ bend)) ** 2)


def decided_mm(depth_mm, rotation_rad, positions_per_mm):
    """The first depth at which this course of rotation decides, or infinity."""
    for end_mm in np.arange(10, depth_mm[-1]):
        grid = np.linspace(0, end_mm, POINTS)
        if log_odds(np.interp(grid, depth_mm, rotation_rad), end_mm, positions_per_mm, HEADING_SD) >= DECIDES:
            return end_mm
    return math.inf


if len(sys.argv) > 1:
    with open(sys.argv[1], newline="", encoding="utf-8") as file:
        starts = itertools.groupby(csv.DictReader(file), lambda row: row["start"])
        courses = [np.array([(float(r["depth_mm"]), float(r["rotation_rad"])) for r in rows]) for _, rows in starts]
    for positions_per_mm in (20, 40):
        mm = np.sort([decided_mm(*course.T, positions_per_mm) for course in courses])
        part = [mm[round((len(mm) - 1) * p)] for p in (0, 0.5, 0.95)]
        print("{} a mm: {:.0f} mm at least, {:.0f} (median), {:.0f} (95%)".format(positions_per_mm, *part))
else:
    rng = np.random.default_rng(1)
    for positions_per_mm in (20, 40):
        for depth_mm in (15, 18, 19, 20, 22, 25):
            print(f"{positions_per_mm} a mm, {depth_mm} mm: {largest(depth_mm, positions_per_mm, rng):.1f}")
        decides = next(mm for mm in np.arange(5, 60, 0.5) if turned(mm, positions_per_mm) >= DECIDES)
        print(f"{positions_per_mm} a mm: a registration turned by 90 degrees is decided after {decides:.1f} mm")
