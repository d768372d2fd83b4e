#!/usr/bin/env python3
"""How many targets can be reached in space while the roll at the start is not known?

A method knows where the needle starts, its curvature, its yaw to 12 degrees and its pitch to 8 (as
`bench-config/target-study.toml` tells the bench), and sees 20 positions a mm. It is given more than it can have:

- It learns of the roll what a needle shows that bends one way all the time, which shows most, and yet it may bend as
  it likes; its turns cost nothing and show nothing.
- It knows the exact posterior of the roll, 1 mm ahead of the positions. It bends by the full curvature to where the
  posterior's mean has the target, and goes straight while the posterior's resultant length is under a limit; for each
  target the best of several limits counts.
- After REVEALED_MM the roll is told to it, and one arc of the full curvature leads to the target.

This is the best of a family of methods; `start_roll_bound.py` has a bound for all of them.

Prints how well the positions tell the roll (RMS error of the posterior's mean), and the share of the targets that
are then reached within 1 mm and within 0.4 mm, for uniform noise of +-1 mm and for Gaussian noise of the same
variance. Targets are drawn as `bench-config/target-study.toml` does with `goal.in_plane=false`. Needs numpy.
docs/targets.md has what follows from it.
"""

import math

import numpy as np

from rotate_to_target import RADIUS_MM, draw_targets

HALF_WIDTH_MM, POSITIONS_PER_MM, HEADING_SDS = 1.0, 20, np.radians([12.0, 8.0])
SHARE_MAX, TARGETS = 0.9, 2_000
DRAWS, REVEALED_MM, SUBSTEPS = 400, 16, 4
ROLLS = np.radians(np.arange(-180, 180, 3))
SLOPES = np.linspace(-4, 4, 401)
SLOPE_PRIOR = np.exp(-(SLOPES**2) / 2)


class Uniform:
    """Likelihood of uniform noise: 1 where every error is within the limit, else 0."""

    def draw(self, random, count):
        return random.uniform(-HALF_WIDTH_MM, HALF_WIDTH_MM, count)

    def log_likelihood(self, errors_mm):
        return np.where(np.abs(errors_mm).max(axis=0) <= HALF_WIDTH_MM, 0.0, -np.inf)


class Gaussian:
    """Likelihood of Gaussian noise with the variance of the uniform one."""

    sd_mm = HALF_WIDTH_MM / math.sqrt(3)

    def draw(self, random, count):
        return random.normal(0.0, self.sd_mm, count)

    def log_likelihood(self, errors_mm):
        return -np.sum((errors_mm / self.sd_mm) ** 2, axis=0) / 2


def posterior_means(noise, random):
    """The posterior's mean direction (complex; its length is the resultant length) after each mm, roll at 0."""
    # Roll and slopes are drawn from the grid: the edge of the uniform noise would exclude what lies beside it.
    true_roll = random.choice(ROLLS)
    s = np.arange(1, REVEALED_MM * POSITIONS_PER_MM + 1) / POSITIONS_PER_MM
    logs = np.zeros((2, len(ROLLS), len(SLOPES)))
    parts, positions = [], []
    for sd, component in zip(HEADING_SDS, (np.cos, np.sin)):
        slope = sd * random.choice(SLOPES, p=SLOPE_PRIOR / SLOPE_PRIOR.sum())
        path = slope * s + component(true_roll) * s**2 / 2 / RADIUS_MM
        positions.append(path + noise.draw(random, len(s)))
        parts.append((sd * SLOPES, component(ROLLS)))
    means = []
    for mm in range(REVEALED_MM):
        now = slice(mm * POSITIONS_PER_MM, (mm + 1) * POSITIONS_PER_MM)
        at = s[now, None, None]
        weights = np.ones(len(ROLLS))
        for log, (slopes, bends), seen in zip(logs, parts, positions):
            errors = seen[now, None, None] - bends[:, None] * at**2 / 2 / RADIUS_MM - slopes * at
            log += noise.log_likelihood(errors)
            likelihood = np.exp(log - log.max()) @ SLOPE_PRIOR
            weights *= likelihood
        means.append(np.sum(weights * np.exp(1j * (ROLLS - true_roll))) / weights.sum())
    return np.array(means)


def path_end(means, resultant_min):
    """Tip and heading where the roll is told, for a target in the direction of y."""
    tip, heading, ds = np.zeros(3), np.array([0.0, 0.0, 1.0]), 1.0 / SUBSTEPS
    # What the nth mm tells is used over the whole of it.
    for mean in means:
        for _ in range(SUBSTEPS if abs(mean) > resultant_min else 0):
            bend = np.array([mean.imag, mean.real, 0.0]) / abs(mean)
            bend -= heading * (bend @ heading)
            turned = heading + bend / np.linalg.norm(bend) * ds / RADIUS_MM
            turned /= np.linalg.norm(turned)
            tip, heading = tip + (heading + turned) / 2 * ds, turned
        if abs(mean) <= resultant_min:
            tip = tip + heading
    return tip, heading


def reached(target, tip, heading, tolerance_mm):
    """Which targets one arc and a straight from there reach."""
    apart = target - tip
    ahead = apart @ heading
    aside = np.linalg.norm(apart - ahead[:, None] * heading, axis=1)
    return np.hypot(RADIUS_MM - aside, ahead) >= RADIUS_MM - tolerance_mm


if __name__ == "__main__":
    target = draw_targets(TARGETS, SHARE_MAX, np.random.default_rng(1))
    aside = np.linalg.norm(target[:, :2], axis=1)
    target = np.column_stack([np.zeros(TARGETS), aside, target[:, 2]])
    for noise in (Uniform(), Gaussian()):
        random = np.random.default_rng(2)
        draws = [posterior_means(noise, random) for _ in range(DRAWS)]
        rms = np.sqrt(np.mean(np.angle(np.array(draws)) ** 2, axis=0))
        for mm in range(4, REVEALED_MM + 1, 2):
            print(f"{type(noise).__name__}: after {mm} mm the roll is known to {math.degrees(rms[mm - 1]):.0f} degrees")
        limits = (0.0, 0.1, 0.2, 0.3, 0.5, 0.7, 0.9)
        ends = [[path_end(means, limit) for means in draws] for limit in limits]
        for tolerance_mm in (1.0, 0.4):
            # By limit, draw and target.
            are_reached = np.array([[reached(target, *end, tolerance_mm) for end in of_limit] for of_limit in ends])
            best = are_reached.mean(axis=1).argmax(axis=0)
            shares = are_reached[best, :, np.arange(TARGETS)].mean(axis=0)
            print(
                f"{type(noise).__name__}: {shares.mean():.1%} (standard error {shares.std() / math.sqrt(DRAWS):.1%}) "
                f"within {tolerance_mm} mm",
                flush=True,
            )
