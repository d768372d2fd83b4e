#!/usr/bin/env python3
"""No method reaches more targets than this in space while the roll at the start is not known: a proof.

    python3 docs/start_roll_bound.py

Noise is Gaussian with the variance of +-1 mm, 20 positions a mm. Grant a method the exact start, heading, curvature
and control of the base, and let it know the roll after KNOWN_MM. For every KNOWN_MM this bounds all methods:

- A needle that starts at another roll makes the same path, turned about the z axis. So a position is
  `exp(i roll) b(s)` plus noise aside, where the method knows b, and |b(s)| is at most that of one arc. Gaussian noise is
  the same in every direction. What a smaller |b| shows, a larger one shows too: scale the position down and add
  noise. So no way to turn the base shows more of the roll than one arc.
- Grant all positions of that arc at the start. The posterior of the roll is then a von Mises distribution. Its
  concentration is |k|, `k = S + sqrt(S) n`, with S the sum of |b|^2 over the variance of a coordinate, and n a
  complex number whose parts are standard normal.
- Until the roll is known, the method makes some path. Of its heading h aside, the rolls of the posterior are the only
  unknown. h is at most KNOWN_MM / R, and the tip is KNOWN_MM / 2 h aside, give or take KNOWN_MM^2 / 4R, because
  h changes by 1 / R per mm; the tip falls back by at most KNOWN_MM^3 / 2R^2.
- From there a curve of this curvature that is shorter than half a circle (383 mm, no insertion here is) stays outside the ball that touches it
  (Schur), and so outside the torus of all those balls. A target is missed if it is deeper in the torus than the
  tolerance. That depends on the angle between h and the target alone, and grows with it. So the method can do
  no better than to bend toward the mean of the posterior, by the best |h|.

Prints the bound for each KNOWN_MM, and for the best one of each target. Targets are drawn as
`bench-config/target-study.toml` does with `goal.in_plane=false`. Needs numpy. docs/targets.md has what follows from it.
"""

import math

import numpy as np

from rotate_to_target import RADIUS_MM, draw_targets
from start_roll_references import POSITIONS_PER_MM, SHARE_MAX, TARGETS, Gaussian

DRAWS, HEADINGS = 1_000, 41
ANGLES = np.radians(np.arange(0.0, 180.5, 0.5))


def widest_angle(target, known_mm, tolerance_mm):
    """How far the heading may be off the direction of each target that can then still be reached; best of all |h|."""
    slack_mm = tolerance_mm + known_mm**2 / (4 * RADIUS_MM) + known_mm**3 / (2 * RADIUS_MM**2)
    widest = np.full(len(target), -1.0)
    for length in np.linspace(0.0, known_mm / RADIUS_MM, HEADINGS):
        heading = np.stack([length * np.sin(ANGLES), length * np.cos(ANGLES)])
        heading = np.vstack([heading, np.full(len(ANGLES), math.sqrt(1 - length**2))])
        tip = np.vstack([known_mm / 2 * heading[:2], np.full(len(ANGLES), known_mm)])
        apart = target[:, :, None] - tip
        ahead = np.sum(apart * heading, axis=1)
        aside = np.linalg.norm(apart - ahead[:, None, :] * heading, axis=1)
        is_reached = np.hypot(RADIUS_MM - aside, ahead) >= RADIUS_MM - slack_mm
        last = np.where(is_reached.all(axis=1), len(ANGLES), is_reached.argmin(axis=1)) - 1
        widest = np.maximum(widest, np.where(last < 0, -1.0, ANGLES[last]))
    return widest


def within(angles, concentration):
    """The share of a von Mises distribution within these angles of its mean."""
    middle = (ANGLES[1:] + ANGLES[:-1]) / 2
    density = np.exp(concentration * (np.cos(middle) - 1))
    share = np.concatenate([[0.0], np.cumsum(density) / density.sum()])
    # The angles are rounded down to the grid: the next one is an upper bound.
    return np.interp(np.minimum(angles + ANGLES[1], math.pi), ANGLES, share) * (angles >= 0.0)


if __name__ == "__main__":
    target = draw_targets(TARGETS, SHARE_MAX, np.random.default_rng(1))
    aside = np.linalg.norm(target[:, :2], axis=1)
    target = np.column_stack([np.zeros(TARGETS), aside, target[:, 2]])
    random = np.random.default_rng(2)
    bounds = {1.0: np.ones(TARGETS), 0.4: np.ones(TARGETS)}
    for known_mm in np.arange(3.0, 10.5, 0.5):
        s = np.arange(1, int(known_mm * POSITIONS_PER_MM) + 1) / POSITIONS_PER_MM
        shown = np.sum((RADIUS_MM * (1 - np.cos(s / RADIUS_MM)) / Gaussian.sd_mm) ** 2)
        normal = random.normal(size=DRAWS) + 1j * random.normal(size=DRAWS)
        concentrations = np.abs(shown + math.sqrt(shown) * normal)
        for tolerance_mm, bound in bounds.items():
            angles = widest_angle(target, known_mm, tolerance_mm)
            shares = np.mean([within(angles, concentration) for concentration in concentrations], axis=0)
            np.minimum(bound, shares, out=bound)
            print(f"roll known after {known_mm} mm: at most {shares.mean():.2%} within {tolerance_mm} mm", flush=True)
    for tolerance_mm, bound in bounds.items():
        print(f"no method reaches more than {bound.mean():.2%} within {tolerance_mm} mm")
