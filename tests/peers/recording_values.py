"""Checks that run.rrd and steps.csv of a run folder agree, read by rerun's own reader and by pandas.

usage: recording_values.py RUN_DIR MISSING_MAX

`rerun rrd verify` must succeed. The recording must hold all rows of steps.csv but the last MISSING_MAX, with the same
values. Prints the number of rows and of values that were compared.
"""

import math
import pathlib
import subprocess
import sys

import pandas
from rerun.experimental import RrdReader

run_dir = pathlib.Path(sys.argv[1])
missing_max = int(sys.argv[2])

rerun = pathlib.Path(sys.executable).parent / "rerun"
subprocess.run([rerun, "rrd", "verify", run_dir / "run.rrd"], check=True, capture_output=True)

steps = pandas.read_csv(run_dir / "steps.csv").set_index("step")
assert steps.index.is_unique and list(steps.index) == list(range(len(steps)))

# The column of the recording, which has angles in degrees, for each column of steps.csv.
columns = {}
for name in steps.columns:
    quantity, unit = name.rsplit("_", 1)
    if quantity.endswith(("_meas", "_est", "_sd", "_true")):
        columns[name] = f"{quantity}_deg" if unit == "rad" else name
columns["rotation_cmd_rad_per_mm"] = "rotation_cmd_deg_per_mm"

rows = {}
for chunk in RrdReader(run_dir / "run.rrd").stream().to_chunks():
    if str(chunk.entity_path) == "/steps":
        batch = chunk.to_record_batch().to_pydict()
        for n, step in enumerate(batch["step"]):
            assert step not in rows, f"step {step} occurs twice"
            # A quantity that is never known has no column, such as the truth on a real stage.
            unknown = {name: math.nan for name in columns.values() if name not in batch}
            known = {name: batch[name][n][0] for name in columns.values() if name in batch}
            rows[step] = unknown | known
            seconds = batch["run_time"][n].total_seconds()
            assert abs(seconds - steps.time_s[step]) < 1e-6, f"step {step} at {seconds} s"

compared = 0
for step, row in rows.items():
    for name, recorded_name in columns.items():
        expected, recorded = steps.loc[step, name], row[recorded_name]
        if "_rad" in name:
            expected = math.degrees(expected)
        if math.isnan(expected):
            assert math.isnan(recorded), f"step {step}: {recorded_name} is {recorded}, not unknown"
            continue
        difference = recorded - expected
        if name.startswith("roll_") and not name.startswith("roll_sd"):
            difference = math.remainder(difference, 360.0)
        # steps.csv has all significant digits; the conversion to degrees rounds.
        assert abs(difference) <= 1e-9 * max(1.0, abs(expected)), (
            f"step {step}: {recorded_name} is {recorded}, {name} says {expected}"
        )
        compared += 1

assert len(steps) - len(rows) <= missing_max, f"{len(rows)} of {len(steps)} steps"
print(f"{len(rows)} rows, {compared} values")
