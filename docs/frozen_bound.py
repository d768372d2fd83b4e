#!/usr/bin/env python3
"""How early can positions show that the stream is frozen?

Prints the mm inserted after which a likelihood ratio holds half, and 95 of 100, of the streams that
freeze. It knows when the stream froze, the model to 0.2 mm and the noise: Gaussian, of 0.6 mm, 40
positions a second. The position that froze has an error of its own. Its threshold is sufficient for one
stop in 10,000 correct insertions, so it is a reference more than a bound. Needs numpy.
decisions/0010-believing-the-tracker.md has what follows from it.
"""
import math

import numpy as np

SD_MM = 0.6
MODEL_SD_MM = 0.2
RATE_HZ = 40
# One correct insertion of 300 mm in 10,000 may be stopped; it is tested anew at each mm.
LOG_ODDS = math.log(1e4 * 300)
DEPTH_MAX_MM = 6
TRIES = 1000


def held_after_mm(speed_mm_per_s, correlated_share, correlation_s, rng):
    """Depths, sorted, at which the log odds of frozen over moving reach the limit."""
    step_mm = speed_mm_per_s / RATE_HZ
    k = np.arange(1, int(DEPTH_MAX_MM / step_mm) + 1)
    apart_s = np.abs(np.subtract.outer(k, k)) / RATE_HZ
    correlated = correlated_share * np.exp(-apart_s / correlation_s)
    noise = SD_MM**2 * ((1 - correlated_share) * np.eye(len(k)) + correlated)
    moving = noise + MODEL_SD_MM**2
    frozen = moving + SD_MM**2
    # What frozen streams show, along the needle and across it.
    shown = np.einsum("ij,njk->nik", np.linalg.cholesky(frozen), rng.standard_normal((TRIES, len(k), 3)))
    # The same as a moving needle would have to explain it.
    missing = shown - step_mm * k[:, None] * np.array([0, 0, 1])
    after_mm = np.full(TRIES, np.inf)
    for m in range(2, len(k) + 1):

        def twice_log_likelihood(y, covariance):
            covariance = covariance[:m, :m]
            square = np.einsum("nak,ab,nbk->n", y[:, :m], np.linalg.inv(covariance), y[:, :m], optimize=True)
            return -square - 3 * np.linalg.slogdet(covariance)[1]

        odds = (twice_log_likelihood(shown, frozen) - twice_log_likelihood(missing, moving)) / 2
        after_mm[(odds > LOG_ODDS) & np.isinf(after_mm)] = step_mm * k[m - 1]
        if np.isfinite(after_mm).all():
            break
    return np.sort(after_mm)


rng = np.random.default_rng(1)
for name, share in (("white", 0.0), ("half of the variance correlated over 0.2 s", 0.5)):
    for speed_mm_per_s in (1, 2):
        after_mm = held_after_mm(speed_mm_per_s, share, 0.2, rng)
        half, most = after_mm[TRIES // 2], after_mm[TRIES * 95 // 100]
        print(f"{name}, {speed_mm_per_s} mm/s: {half:.1f} mm (median), {most:.1f} (95%)")
