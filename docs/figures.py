#!/usr/bin/env python3
"""The figure in docs/study.md, from the steps.csv of two runs:

    cargo run -- run bench-config/paper-fig3.toml
    cargo run -- run bench-config/paper-fig4.toml
    docs/figures.py runs/<UTC>-paper-fig3/steps.csv runs/<UTC>-paper-fig4/steps.csv docs/figures.png

It needs matplotlib.
"""
import csv
import math
import sys

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

# Left the reduced space, right the fibre, as in the paper; degrees for the eye.
PANELS = [("x", "mm"), ("y", "mm"), ("pitch", "rad"), ("z", "mm"), ("roll", "rad"), ("yaw", "rad")]
COLOURS = {"Figure 3: no noise": "#0072B2", "Figure 4: ±1 mm": "#D55E00"}


def error(row, name, unit):
    difference = float(row[f"{name}_est_{unit}"]) - float(row[f"{name}_true_{unit}"])
    if unit == "rad":
        return math.degrees(math.remainder(difference, math.tau))
    return difference


def main(fig3, fig4, picture):
    figure, axes = plt.subplots(3, 2, figsize=(9, 6.5), sharex=True, layout="constrained")
    for (label, colour), path in zip(COLOURS.items(), (fig3, fig4)):
        with open(path, newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
        depth = [float(row["insertion_mm"]) for row in rows]
        for panel, (name, unit) in zip(axes.flat, PANELS):
            panel.plot(depth, [error(row, name, unit) for row in rows], color=colour, label=label, lw=1.1)
            panel.set_ylabel(f"{name} error [{'deg' if unit == 'rad' else unit}]")
            panel.grid(alpha=0.3)
    for panel in axes[-1]:
        panel.set_xlabel("insertion [mm]")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncol=2, frameon=False)
    figure.savefig(picture, dpi=110)


if __name__ == "__main__":
    if len(sys.argv) != 4:
        sys.exit(__doc__)
    main(*sys.argv[1:])
