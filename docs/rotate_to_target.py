#!/usr/bin/env python3
"""Rotate-to-target, to stand beside the studies of targets: each mm the bevel is turned at the target.

    python3 docs/rotate_to_target.py
    python3 docs/rotate_to_target.py --curvature-error 0.15 --share 0.75

The needle is a unicycle of radius 122 mm without torsion, which always bends by its full curvature. Targets are
drawn as `bench-config/target-study.toml` does with `goal.in_plane=false`. The insertion ends where the target
is beside the estimated tip. The rule knows the pose of the tip in one of three ways:

- true: position and attitude are exact.
- dead reckoning: the position is the mean of 20 samples of ±1 mm on each coordinate, taken at the tip at rest.
  The attitude is known to 5 degrees (standard deviation about each axis) at the start; after that it is that of
  the model, whose curvature and turns are exact.
- fit: the same start and samples. The model's path from the known start position is rotated to fit all means so
  far (Wahba's problem, with the 5 degrees as prior). It gives the attitude and the position.

The base turns at once, or by 60 degrees a mm at most, as in the study. With `--curvature-error` the curvature of
each needle is wrong by up to this part, and the model does not know it.
"""

import argparse
import math

import numpy as np

RADIUS_MM, WALL_MM = 122.0, 75.0
DEPTH_MM = (80.0, 150.0)
NOISE_MM, SAMPLES, START_SD = 1.0, 20, math.radians(5.0)
STEP_MM, SUBSTEPS, INSERTION_MAX_MM = 1.0, 10, 250
MEAN_SD_MM = NOISE_MM / math.sqrt(3.0 * SAMPLES)


def draw_targets(count, share_max, rng):
    """Targets, mm: a depth, and a share of what one arc reaches there within the workspace."""
    depth, share = rng.uniform(*DEPTH_MM, count), rng.uniform(0.0, share_max, count)
    turn = rng.uniform(0.0, 2.0 * math.pi, count)
    aside = np.stack([np.sin(turn), np.cos(turn)], axis=1)
    arc = RADIUS_MM - np.sqrt(np.maximum(RADIUS_MM**2 - depth**2, 0.0))
    reach = np.minimum(arc, WALL_MM / np.abs(aside).max(axis=1))
    return np.column_stack([aside * (share * reach)[:, None], depth])


def rotations(vectors):
    """exp of rotation vectors (n, 3), by Rodrigues' formula."""
    angle = np.linalg.norm(vectors, axis=1)
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
    first, second = np.sinc(angle / math.pi), 0.5 * np.sinc(angle / (2.0 * math.pi)) ** 2
    return np.eye(3) + first[:, None, None] * cross + second[:, None, None] * (cross @ cross)


class Needle:
    """Tips of many needles: position, and attitude with z ahead and y where the needle bends."""

    def __init__(self, attitude, curvature_per_mm):
        self.attitude, self.curvature_per_mm = attitude.copy(), curvature_per_mm
        self.position_mm = np.zeros((len(attitude), 3))

    def insert(self, turn, length_mm, turn_max):
        """Turns by `turn` (at once if `turn_max` is None, radians a mm) while it is inserted by `length_mm`."""
        left, ds = turn.copy(), length_mm / SUBSTEPS
        zero = np.zeros_like(left)
        for _ in range(SUBSTEPS):
            now = left if turn_max is None else np.clip(left, -turn_max * ds, turn_max * ds)
            left = left - now
            self.attitude = self.attitude @ rotations(np.column_stack([zero, zero, now]))
            bend = ds * self.curvature_per_mm
            chord = np.column_stack([zero, np.sin(bend / 2.0), np.cos(bend / 2.0)])
            chord *= (ds * np.sinc(bend / (2.0 * math.pi)))[:, None]
            self.position_mm += np.einsum("nij,nj->ni", self.attitude, chord)
            self.attitude = self.attitude @ rotations(np.column_stack([-bend, zero, zero]))


def best_rotations(profile):
    """The rotations that solve Wahba's problem for these profile matrices, by SVD."""
    u, _, vt = np.linalg.svd(profile)
    u[:, :, 2] *= np.linalg.det(u @ vt)[:, None]
    return u @ vt


def insert_all(knowledge, turn_max, count, share_max, curvature_error, seed):
    """Distance of each true tip from its target at the end, mm, and how far its base turned, radians."""
    rng = np.random.default_rng(seed)
    target = draw_targets(count, share_max, rng)
    curvature = np.full(count, 1.0 / RADIUS_MM)
    true_curvature = curvature * (1.0 + rng.uniform(-curvature_error, curvature_error, count))
    needle = Needle(np.broadcast_to(np.eye(3), (count, 3, 3)), true_curvature)
    model = Needle(rotations(rng.normal(0.0, START_SD, (count, 3))), curvature)
    profile = np.broadcast_to(np.eye(3) / (2.0 * START_SD**2), (count, 3, 3)).copy()
    is_done, turned = np.zeros(count, dtype=bool), np.zeros(count)
    for _ in range(int(INSERTION_MAX_MM / STEP_MM)):
        mean = needle.position_mm + rng.uniform(-NOISE_MM, NOISE_MM, (SAMPLES, count, 3)).mean(axis=0)
        if knowledge == "true":
            position, attitude = needle.position_mm, needle.attitude
        elif knowledge == "dead reckoning":
            position, attitude = mean, model.attitude
        else:
            profile += mean[:, :, None] * model.position_mm[:, None, :] / MEAN_SD_MM**2
            correction = best_rotations(profile)
            position = np.einsum("nij,nj->ni", correction, model.position_mm)
            attitude = correction @ model.attitude
        to_target = np.einsum("nji,nj->ni", attitude, target - position)
        length = np.where(is_done, 0.0, np.clip(to_target[:, 2], 0.0, STEP_MM))
        is_done |= to_target[:, 2] <= STEP_MM
        turn = np.where(length > 0.0, np.arctan2(-to_target[:, 0], to_target[:, 1]), 0.0)
        needle.insert(turn, length, turn_max)
        model.insert(turn, length, turn_max)
        turned += np.abs(turn) if turn_max is None else np.minimum(np.abs(turn), turn_max * length)
        if is_done.all():
            break
    error = np.linalg.norm(target - needle.position_mm, axis=1)
    return np.where(is_done, error, math.inf), turned


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--trials", type=int, default=2000)
    parser.add_argument("--share", type=float, default=0.9, help="targets lie up to this part of the reach aside")
    parser.add_argument("--curvature-error", type=float, default=0.0)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    print("pose known by    turn         median      95%   max mm  within 1 mm  base turns, median")
    for knowledge in ("true", "dead reckoning", "fit"):
        for name, turn_max in (("at once", None), ("60 deg/mm", math.radians(60.0))):
            drawn = (arguments.trials, arguments.share, arguments.curvature_error, arguments.seed)
            error, turned = insert_all(knowledge, turn_max, *drawn)
            shown = " ".join(f"{np.quantile(error, q):8.3f}" for q in (0.5, 0.95, 1.0))
            reached, turns = 100.0 * np.mean(error <= 1.0), np.median(turned) / (2.0 * math.pi)
            print(f"{knowledge:15}  {name:9} {shown} {reached:11.2f}% {turns:8.1f}", flush=True)


if __name__ == "__main__":
    main()
