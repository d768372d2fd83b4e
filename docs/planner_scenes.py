#!/usr/bin/env python3
"""Plans every scene of a file with `needle-bench plan` and compares it with the exhaustive search.

    cargo build --release
    docs/planner_scenes.py target/release/needle-bench tests/data/planner-scenes/scenes.json

The scene's x and y are y and z of the plane, and its start heading is along z.
"""

import json
import math
import subprocess
import sys
import tempfile

RADIUS_MM, MARGIN_MM, TOLERANCE_MM, SIDE_MM, FAR_MM = 50.0, 2.0, 3.0, 150.0, 1000.0
# As the exhaustive search.
LENGTH_MAX_MM = 300.0


def obstacle(o):
    if o["type"] == "circle":
        y, z, r = o["x_mm"], o["y_mm"], o["radius_mm"]
        return f'shape = "cylinder"\nfrom_mm = [{-FAR_MM}, {y}, {z}]\nto_mm = [{FAR_MM}, {y}, {z}]\nradius_mm = {r}'
    low, high = (o["x_min_mm"], o["y_min_mm"]), (o["x_max_mm"], o["y_max_mm"])
    return (
        f'shape = "box"\nmin_mm = [{-FAR_MM}, {low[0]}, {low[1]}]\n'
        f"max_mm = [{FAR_MM}, {high[0]}, {high[1]}]"
    )


def configuration(scene):
    start, goal = scene["start"], scene["goal"]
    yaw_deg = math.degrees(math.pi / 2 - start["heading_rad"])
    obstacles = "".join(f"[[goal.obstacle]]\n{obstacle(o)}\n" for o in scene["obstacles"])
    return f"""
[goal]
kind = "target"
position_mm = [0.0, {goal["x_mm"]}, {goal["y_mm"]}]
tolerance_mm = {TOLERANCE_MM}
clearance_mm = {MARGIN_MM}
curvature_margin = 0.0
reserve_mm = 0.0
workspace_mm = {{ min = [-1.0, 0.0, 0.0], max = [1.0, {SIDE_MM}, {SIDE_MM}] }}
{obstacles}
[insertion]
depth_mm = {LENGTH_MAX_MM}
[needle]
radius_mm = {RADIUS_MM}
[observer]
start = {{ yaw_deg = {-yaw_deg}, pitch_deg = 0.0, roll_deg = 0.0 }}
[emulator.start]
x_mm = 0.0
y_mm = {start["x_mm"]}
z_mm = {start["y_mm"]}
"""


def main():
    program, scenes = sys.argv[1:]
    with open(scenes, encoding="utf-8") as file:
        scenes = json.load(file)["scenes"]
    worst, agree = {"plan": 0.0, "none": 0.0}, 0
    for scene in scenes:
        with tempfile.NamedTemporaryFile("w", suffix=".toml") as config:
            config.write(configuration(scene))
            config.flush()
            command = [program, "plan", config.name, "--json"]
            said = subprocess.run(command, capture_output=True, text=True, check=False)
        plan = json.loads(said.stdout)
        if "status" not in plan:
            print(f'{scene["name"]:20} refused: {plan["error"]}')
            continue
        exhaustive = scene["exhaustive_search"]["length_mm"]
        status, length = plan["status"], plan["length_mm"]
        worst[status] = max(worst.get(status, 0.0), plan["seconds"])
        agree += status == ("none" if exhaustive is None else "plan")
        ratio = f"{length / exhaustive:.3f}" if length and exhaustive else "-"
        text = f'{scene["name"]:20} {status:6} {length or 0:6.1f} mm, ratio {ratio:5}'
        print(f'{text}, {plan["expansions"]:7} expansions, {1e3 * plan["seconds"]:6.1f} ms')
    print(f"{agree} of {len(scenes)} agree; slowest: " + ", ".join(f"{k} {1e3 * v:.1f} ms" for k, v in worst.items()))


if __name__ == "__main__":
    main()
