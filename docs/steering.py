#!/usr/bin/env python3
"""The figure in steering.md, from the steps.csv of a run and the rows of studies:

    docs/steering.py runs/<UTC>-virtual/steps.csv docs/steering.png LABEL=STUDY.csv...

It needs matplotlib.
"""
import csv
import math
import sys

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

ESTIMATE, TRUTH = "#0072B2", "#000000"
STUDIES = ["#0072B2", "#D55E00", "#009E73", "#CC79A7"]


def rows_of(path):
    with open(path, newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def band(axis, rows, name, unit, scale):
    depth = [float(row["insertion_mm"]) for row in rows]
    error = []
    for row in rows:
        difference = float(row[f"{name}_est_{unit}"]) - float(row[f"{name}_true_{unit}"])
        error.append(scale * (math.remainder(difference, math.tau) if unit == "rad" else difference))
    twice = [2 * scale * float(row[f"{name}_sd_{unit}"]) for row in rows]
    axis.fill_between(depth, [-t for t in twice], twice, color=ESTIMATE, alpha=0.2, lw=0, label="± 2 sd, as estimated")
    axis.plot(depth, error, color=ESTIMATE, lw=1.1, label="estimate − truth")
    axis.grid(alpha=0.3)
    axis.set_xlabel("insertion [mm]")


def main(steps, picture, studies):
    figure, (x, roll, plane) = plt.subplots(1, 3, figsize=(12, 3.6), layout="constrained")
    rows = rows_of(steps)
    band(x, rows, "x", "mm", 1.0)
    x.set_ylabel("x error [mm]")
    band(roll, rows, "roll", "rad", math.degrees(1.0))
    roll.set_ylabel("roll error [deg]")
    roll.set_yscale("symlog", linthresh=1.0)
    roll.legend(loc="upper right")
    for colour, study in zip(STUDIES, studies):
        label, path = study.split("=", 1)
        values = sorted(float(row["off_plane_rms_mm"]) for row in rows_of(path))
        plane.plot(values, [(n + 1) / len(values) for n in range(len(values))], color=colour, label=label)
    plane.set_xlabel("off-plane RMS over the last third [mm]")
    plane.set_ylabel("share of trials")
    plane.grid(alpha=0.3)
    plane.legend(loc="lower right")
    figure.savefig(picture, dpi=110)


main(sys.argv[1], sys.argv[2], sys.argv[3:])
