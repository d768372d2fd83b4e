#!/usr/bin/env python3
"""How many targets does the exact Bayes filter reach in space while the roll at the start is not known?

    python3 docs/start_roll_exact.py
    python3 docs/start_roll_exact.py --wait 0.5      # the base stands until the resultant length is 0.5
    python3 docs/start_roll_exact.py --slow 0.5      # it turns the slower, the more the length is under 0.5

`start_roll_references.py` gives a method what no real one can have. This one has what the bench has: 20 positions a mm
with noise of +-1 mm, yaw known to 12 degrees and pitch to 8 at the start, the start position, the curvature, and each
turn of the base. It keeps the whole posterior of yaw, pitch and roll on a grid, given how the needle was turned, and
each mm turns the base toward the target by the posterior's mean, by 60 degrees a mm at most. With `--wait` and
`--slow` it turns less while the resultant length of the posterior of the roll is small. After TOLD_MM the roll is
told to it, and one arc of the full curvature leads to the target. Angles are small in the likelihood, not in the path.

Prints the RMS error of the roll and the share of the targets that are then reached within 1 mm and within 0.4 mm, for
Gaussian noise (as the bench takes it) and for the uniform noise that it is. Targets and true headings are those of
`bench-config/target-study.toml` with `goal.in_plane=false`. Needs numpy. docs/targets.md has what follows from it.
"""

import argparse
import math

import numpy as np

from rotate_to_target import RADIUS_MM, draw_targets
from start_roll_references import (
    HEADING_SDS, POSITIONS_PER_MM, ROLLS, SHARE_MAX, SLOPES, SLOPE_PRIOR, TARGETS, Gaussian, Uniform, reached,
)

DRAWS, TOLD_MM, TURN_MAX = 400, 24, math.pi / 3


def insert(noise, random, wait, slow):
    """Tip and heading after TOLD_MM, and the error of the roll's mean after each mm. The target is in direction 0."""
    step = 1.0 / POSITIONS_PER_MM
    true_roll = random.choice(ROLLS)
    logs = np.zeros((2, len(ROLLS), len(SLOPES)))
    # Of a needle with roll 0 at the start: turn of the base, slope and place aside (complex), depth.
    turn, slope, aside, depth = 0.0, 0j, 0j, 0.0
    tip, heading = np.zeros(3), np.array([0.0, 0.0, 1.0])
    command, errors = 0.0, []
    for _ in range(TOLD_MM):
        depths, asides = [], []
        for _ in range(POSITIONS_PER_MM):
            turn += command * step
            bend = np.exp(1j * turn) / RADIUS_MM
            aside += slope * step + bend * step**2 / 2
            slope += bend * step
            depth += step
            depths.append(depth)
            asides.append(aside)
            tip, heading = bent(tip, heading, true_roll + turn, step)
        depths, asides = np.array(depths), np.array(asides)
        weights = np.ones(len(ROLLS))
        for log, sd, part in zip(logs, HEADING_SDS, (np.real, np.imag)):
            positions = part(np.exp(1j * true_roll) * asides) + noise.draw(random, len(depths))
            of_roll = part(np.exp(1j * ROLLS)[None, :] * asides[:, None])[:, :, None]
            off = positions[:, None, None] - of_roll - (sd * SLOPES)[None, None, :] * depths[:, None, None]
            log += noise.log_likelihood(off)
            weights *= np.exp(log - log.max()) @ SLOPE_PRIOR
        resultant = np.sum(weights * np.exp(1j * ROLLS)) / weights.sum()
        mean = np.angle(resultant)
        errors.append(wrapped(mean - true_roll))
        command = float(np.clip(-wrapped(mean + turn), -TURN_MAX, TURN_MAX))
        if abs(resultant) < wait:
            command = 0.0
        elif abs(resultant) < slow:
            command *= abs(resultant) / slow
    return tip, heading, errors


def bent(tip, heading, direction, length):
    """Tip and heading after an arc of `length` mm that bends toward `direction`."""
    bend = np.array([math.sin(direction), math.cos(direction), 0.0])
    bend -= heading * (bend @ heading)
    turned = heading + bend / np.linalg.norm(bend) * length / RADIUS_MM
    turned /= np.linalg.norm(turned)
    return tip + (heading + turned) / 2 * length, turned


def wrapped(angle):
    return (angle + math.pi) % (2 * math.pi) - math.pi


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--wait", type=float, default=0.0)
    parser.add_argument("--slow", type=float, default=0.0)
    given = parser.parse_args()
    target = draw_targets(TARGETS, SHARE_MAX, np.random.default_rng(1))
    aside = np.linalg.norm(target[:, :2], axis=1)
    target = np.column_stack([np.zeros(TARGETS), aside, target[:, 2]])
    for noise in (Gaussian(), Uniform()):
        random, name = np.random.default_rng(2), type(noise).__name__
        ends = [insert(noise, random, given.wait, given.slow) for _ in range(DRAWS)]
        rms = np.degrees(np.sqrt(np.mean(np.array([errors for _, _, errors in ends]) ** 2, axis=0)))
        for mm in range(4, TOLD_MM + 1, 4):
            print(f"{name}: after {mm} mm the roll is known to {rms[mm - 1]:.0f} degrees")
        for tolerance_mm in (1.0, 0.4):
            shares = np.array([reached(target, tip, heading, tolerance_mm).mean() for tip, heading, _ in ends])
            error = shares.std() / math.sqrt(DRAWS)
            print(f"{name}: {shares.mean():.1%} (standard error {error:.1%}) within {tolerance_mm} mm", flush=True)
