"""Exhaustive search of planar scenes, slow and plain: what the planner is compared with.

    python3 exhaustive.py --random 40 --seed 1 > random.json    # makes scenes and searches them
    python3 exhaustive.py scenes.json                           # searches scenes again

Breadth first over cells of 0.5 mm x 0.5 mm x 1 degree: arcs of 1 mm with curvature -1/50, 0 or +1/50 per mm.
Each point is in the workspace of 150 x 150 mm and 2 mm or more from every obstacle. A path ends within 3 mm
of the goal, and is no longer than LENGTH_MAX_MM.
"""

import argparse
import json
import math
import random

SIDE_MM, RADIUS_MM, MARGIN_MM, TOLERANCE_MM = 150.0, 50.0, 2.0, 3.0
CELL_MM, LENGTH_MAX_MM = 0.5, 300


def distance_mm(obstacle, x, y):
    if obstacle["type"] == "circle":
        return math.hypot(x - obstacle["x_mm"], y - obstacle["y_mm"]) - obstacle["radius_mm"]
    dx = max(obstacle["x_min_mm"] - x, x - obstacle["x_max_mm"], 0.0)
    dy = max(obstacle["y_min_mm"] - y, y - obstacle["y_max_mm"], 0.0)
    return math.hypot(dx, dy)


def search(scene):
    """Length of the shortest path, mm, or None."""
    start, goal, obstacles = scene["start"], scene["goal"], scene["obstacles"]

    def is_free(x, y):
        inside = 0.0 <= x < SIDE_MM and 0.0 <= y < SIDE_MM
        return inside and all(distance_mm(o, x, y) >= MARGIN_MM for o in obstacles)

    turn = 1.0 / RADIUS_MM
    ahead, aside = math.sin(turn) / turn, (1.0 - math.cos(turn)) / turn
    layer = [(start["x_mm"], start["y_mm"], start["heading_rad"])]
    if not is_free(*layer[0][:2]):
        return None
    visited = set()
    for length in range(LENGTH_MAX_MM + 1):
        following = []
        for x, y, heading in layer:
            if math.hypot(x - goal["x_mm"], y - goal["y_mm"]) <= TOLERANCE_MM:
                return float(length)
            cos, sin = math.cos(heading), math.sin(heading)
            for side in (-1, 0, 1):
                if side:
                    nx, ny = x + cos * ahead - side * sin * aside, y + sin * ahead + side * cos * aside
                else:
                    nx, ny = x + cos, y + sin
                to = heading + side * turn
                degrees = math.floor(math.degrees(to)) % 360
                cell = (math.floor(nx / CELL_MM), math.floor(ny / CELL_MM), degrees)
                if cell not in visited and is_free(nx, ny):
                    visited.add(cell)
                    following.append((nx, ny, to))
        layer = following
    return None


def made(number, rng):
    """A scene of 2 to 9 circles and rectangles; every third with another start and goal."""
    start, goal = (75.0, 20.0), (75.0, 130.0)
    if number % 3 == 2:
        start = (rng.uniform(20, 130), rng.uniform(5, 40))
        goal = (rng.uniform(10, 140), rng.uniform(90, 145))
    obstacles = []
    for _ in range(rng.randint(2, 9)):
        x, y = rng.uniform(0, 150), rng.uniform(0, 150)
        if rng.random() < 0.5:
            obstacles.append({"type": "circle", "x_mm": x, "y_mm": y, "radius_mm": rng.uniform(5, 23)})
        else:
            x1, y1 = x + rng.uniform(5, 36), y + rng.uniform(5, 36)
            corners = {"x_min_mm": x, "y_min_mm": y, "x_max_mm": x1, "y_max_mm": y1}
            obstacles.append({"type": "rectangle", **corners})
    return {
        "name": f"made_{number:02}",
        "start": {"x_mm": start[0], "y_mm": start[1], "heading_rad": math.pi / 2},
        "goal": {"x_mm": goal[0], "y_mm": goal[1]},
        "obstacles": obstacles,
    }


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("scenes", nargs="?")
    parser.add_argument("--random", type=int, default=0)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    rng = random.Random(arguments.seed)
    if arguments.scenes:
        with open(arguments.scenes, encoding="utf-8") as file:
            scenes = json.load(file)["scenes"]
    else:
        scenes = [made(number, rng) for number in range(arguments.random)]
    for scene in scenes:
        length = search(scene)
        scene["exhaustive_search"] = {"reachable": length is not None, "length_mm": length}
    print(json.dumps({"source": "made by exhaustive.py", "scenes": scenes}, indent=1))


if __name__ == "__main__":
    main()
