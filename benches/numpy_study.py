#!/usr/bin/env python3
"""The study's insertion in numpy, vectorised over trials: the baseline for `needle-bench study`.

    usage: numpy_study.py [TRIALS] [DEPTH_MM]

The same filter: left-invariant extended Kalman filters on SE(3) from 8 initial rolls, weighted by
likelihood and dropped where they are no longer likely, so that most trials carry one or two; one
increment, one measured position and one command a millimetre; nested saturation steers. Everything
is an array over (trial, hypothesis) pairs. One thread; prints inserted millimetres a second of processor time.
"""

import os

os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", MKL_NUM_THREADS="1")

import sys
import time

import numpy as np

KAPPA = 1 / 122
NOISE_MM = 1.0
WEIGHT_MIN = 1e-4


def hat(w):
    out = np.zeros(w.shape[:-1] + (3, 3))
    out[..., 0, 1], out[..., 0, 2] = -w[..., 2], w[..., 1]
    out[..., 1, 0], out[..., 1, 2] = w[..., 2], -w[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -w[..., 1], w[..., 0]
    return out


def exp(v, w):
    """Exp of SE(3): rotation and translation."""
    t2 = np.einsum("...i,...i", w, w)
    t = np.sqrt(t2) + 1e-12
    a, b, c = np.sin(t) / t, (1 - np.cos(t)) / (t * t), (t - np.sin(t)) / (t * t * t)
    k = hat(w)
    k2 = k @ k
    eye = np.eye(3)
    r = eye + a[..., None, None] * k + b[..., None, None] * k2
    j = eye + b[..., None, None] * k + c[..., None, None] * k2
    return r, np.einsum("...ij,...j", j, v)


def adjoint(r, p):
    ad = np.zeros(r.shape[:-2] + (6, 6))
    ad[..., :3, :3] = ad[..., 3:, 3:] = r
    ad[..., :3, 3:] = hat(p) @ r
    return ad


def rotation(yaw, pitch, roll):
    (sa, ca), (sb, cb), (sg, cg) = [(np.sin(x), np.cos(x)) for x in (yaw, pitch, roll)]
    rows = [
        [cb * cg, -cb * sg, sb],
        [ca * sg + sa * sb * cg, ca * cg - sa * sb * sg, -sa * cb],
        [sa * sg - ca * sb * cg, sa * cg + ca * sb * sg, ca * cb],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def command(r, p):
    """Nested saturation: rad/mm from the estimated pose."""
    x, beta, gamma = p[:, 0], np.arcsin(r[:, 0, 2]), np.arctan2(-r[:, 0, 1], r[:, 0, 0])
    wanted = np.clip(-0.05 * x, -0.2, 0.2)
    near = np.arcsin(np.clip(0.1 * (wanted - beta) / KAPPA, -0.95, 0.95))
    wrap = lambda angle: (angle + np.pi) % (2 * np.pi) - np.pi
    to_near, to_far = wrap(near - gamma), wrap(np.pi - near - gamma)
    turn = np.where(np.abs(to_near) < np.abs(to_far), to_near, to_far)
    return np.clip(0.5 * turn + KAPPA * np.cos(gamma) * np.tan(beta), -0.35, 0.35)


def study(trials, depth_mm, rng):
    uniform = lambda most: rng.uniform(-most, most, trials)
    r = rotation(uniform(np.radians(17)), uniform(np.radians(11.5)), uniform(np.pi))
    p = np.stack([uniform(8.0), np.zeros(trials), np.zeros(trials)], -1)
    variance = NOISE_MM**2 / 3

    # The bank, flat: the pairs of a trial stand together.
    y = p + rng.uniform(-NOISE_MM, NOISE_MM, (trials, 3))
    of = np.repeat(np.arange(trials), 8)
    zero = np.zeros(8 * trials)
    br, bp = rotation(zero, zero, np.tile(np.arange(8) * np.pi / 4, trials)), y[of]
    prior = [variance] * 3 + [np.radians(9.8) ** 2, np.radians(9.8) ** 2, np.radians(22.5) ** 2]
    cov = np.broadcast_to(np.diag(prior), (8 * trials, 6, 6)).copy()
    log_weight = zero.copy()

    off_plane = []
    omega = np.zeros(trials)
    for depth in range(1, depth_mm + 1):
        v = np.broadcast_to([0.0, 0.0, 1.0], (trials, 3))
        w = np.stack([np.full(trials, KAPPA), np.zeros(trials), omega], -1)
        dr, dp = exp(v, w)
        p = p + np.einsum("tij,tj->ti", r, dp)
        r = r @ dr
        inverse = np.swapaxes(dr, -1, -2)
        f = adjoint(inverse, -np.einsum("tij,tj->ti", inverse, dp))[of]
        bp = bp + np.einsum("nij,nj->ni", br, dp[of])
        br = br @ dr[of]
        cov = f @ cov @ np.swapaxes(f, -1, -2)

        y = p + rng.uniform(-NOISE_MM, NOISE_MM, (trials, 3))
        z = np.einsum("nji,nj->ni", br, y[of] - bp)
        s = cov[:, :3, :3] + variance * np.eye(3)
        s_inverse = np.linalg.inv(s)
        gain = cov[:, :, :3] @ s_inverse
        step = np.einsum("nij,nj->ni", gain, z)
        er, ep = exp(step[:, :3], step[:, 3:])
        bp = bp + np.einsum("nij,nj->ni", br, ep)
        br = br @ er
        cov = cov - gain @ cov[:, :3, :]
        log_weight = log_weight - 0.5 * (
            np.einsum("ni,nij,nj->n", z, s_inverse, z) + np.log(np.linalg.det(s))
        )

        first = np.flatnonzero(np.r_[True, of[1:] != of[:-1]])
        best = np.maximum.reduceat(log_weight, first)
        log_weight = log_weight - best[of]
        keep = log_weight > np.log(WEIGHT_MIN)
        if not keep.all():
            of, br, bp, cov, log_weight = of[keep], br[keep], bp[keep], cov[keep], log_weight[keep]
        heaviest = np.flatnonzero(log_weight == 0.0)
        heaviest = heaviest[np.r_[True, of[heaviest][1:] != of[heaviest][:-1]]]
        omega = command(br[heaviest], bp[heaviest])
        if depth > depth_mm * 2 / 3:
            off_plane.append(p[:, 0])
    return np.sqrt(np.mean(np.square(off_plane), 0)), len(of) / trials


def main():
    trials, depth_mm = (int(a) for a in (sys.argv[1:] + ["2000", "300"][len(sys.argv) - 1 :])[:2])
    begun = time.process_time()
    rms, left = study(trials, depth_mm, np.random.default_rng(1))
    elapsed = time.process_time() - begun
    print(
        f"{trials} insertions of {depth_mm} mm: off plane {np.median(rms):.3f} mm median, "
        f"{np.quantile(rms, 0.95):.3f} 95%, {np.mean(rms < 1):.2%} settled; "
        f"{left:.1f} hypotheses a trial at the end; "
        f"{trials * depth_mm / elapsed:.0f} mm inserted a second of processor time"
    )


if __name__ == "__main__":
    main()
