#!/usr/bin/env python3
"""Plans the scenes of a file with OMPL, to stand beside `docs/planner_scenes.py`.

    python3 -m venv venv && venv/bin/pip install ompl==2.0.1
    venv/bin/python docs/planner_ompl.py tests/data/planner-scenes/scenes.json --seeds 5

Four planners get the same scenes, as `tests/data/planner-scenes/exhaustive.py` describes them:

- RRT and KPIECE1 with controls. The state is x, y and heading, the control is the curvature, and a motion is one
  arc of 1 to 40 mm. A path ends within 3 mm of the goal. (The Python package has SST, but cannot construct it.)
- RRT* and BIT* on Dubins paths (arcs of the needle's radius and straights) to the goal itself, in one of 36 headings.

RRT and KPIECE1 end with their first path. RRT* and BIT* shorten theirs until the time is over; BIT* ends sooner if
it knows that no path is shorter. Propagation, obstacles and the end of the time are Python callbacks. The time is
processor time, so another run or machine solves a few more or fewer. Each path is checked every 0.1 mm by formulas
that are not OMPL's. OMPL cannot answer that no path exists, so only scenes with one are planned.
"""

import argparse
import json
import math
import statistics
import time

from ompl import base, control, geometric, util

RADIUS_MM, MARGIN_MM, TOLERANCE_MM, SIDE_MM = 50.0, 2.0, 3.0, 150.0
PROPAGATION_MM, ARC_MAX_MM, HEADINGS = 0.5, 40.0, 36
CHECK_MM, CHECK_TOLERANCE_MM = 0.1, 0.05


def clearance_mm(obstacles, x, y):
    """Distance to the nearest obstacle, mm; negative inside one or outside the workspace."""
    least = math.inf if 0.0 <= x <= SIDE_MM and 0.0 <= y <= SIDE_MM else -math.inf
    for o in obstacles:
        if o["type"] == "circle":
            distance = math.hypot(x - o["x_mm"], y - o["y_mm"]) - o["radius_mm"]
        else:
            dx = max(o["x_min_mm"] - x, x - o["x_max_mm"])
            dy = max(o["y_min_mm"] - y, y - o["y_max_mm"])
            distance = max(dx, dy) if max(dx, dy) < 0.0 else math.hypot(max(dx, 0.0), max(dy, 0.0))
        least = min(least, distance)
    return least


def on_arc(pose, curvature, length):
    """Pose after an arc of this length, mm, from (x, y, heading)."""
    x, y, heading = pose
    half = 0.5 * curvature * length
    chord = length * (math.sin(half) / half if abs(half) > 1e-9 else 1.0)
    return x + chord * math.cos(heading + half), y + chord * math.sin(heading + half), heading + 2.0 * half


def pose_of(state):
    return state.getX(), state.getY(), state.getYaw()


def set_pose(state, pose):
    state.setX(pose[0])
    state.setY(pose[1])
    state.setYaw(math.remainder(pose[2], 2.0 * math.pi))


class NearGoal(base.GoalRegion):
    """The disc around the goal; the end heading is free."""

    def __init__(self, information, goal):
        super().__init__(information)
        self.goal_mm = (goal["x_mm"], goal["y_mm"])
        self.setThreshold(TOLERANCE_MM)

    def distanceGoal(self, state):
        return math.hypot(state.getX() - self.goal_mm[0], state.getY() - self.goal_mm[1])


def square(space):
    bounds = base.RealVectorBounds(2)
    bounds.setLow(0.0)
    bounds.setHigh(SIDE_MM)
    space.setBounds(bounds)
    return space


def until(seconds):
    end = time.process_time() + seconds
    return base.PlannerTerminationCondition(lambda: time.process_time() > end)


def start_of(scene, space):
    start = scene["start"]
    state = space.allocState()
    set_pose(state, (start["x_mm"], start["y_mm"], start["heading_rad"]))
    return state


def with_controls(planner, scene, seconds):
    """Arcs (curvature, length) of the path that a planner with controls finds, or None."""
    space = square(base.SE2StateSpace())
    controls = control.RealVectorControlSpace(space, 1)
    bounds = base.RealVectorBounds(1)
    bounds.setLow(-1.0 / RADIUS_MM)
    bounds.setHigh(1.0 / RADIUS_MM)
    controls.setBounds(bounds)
    setup = control.SimpleSetup(controls)
    information = setup.getSpaceInformation()
    is_free = lambda s: clearance_mm(scene["obstacles"], s.getX(), s.getY()) >= MARGIN_MM
    setup.setStateValidityChecker(is_free)
    propagate = lambda s, c, length, to: set_pose(to, on_arc(pose_of(s), c[0], length))
    setup.setStatePropagator(propagate)
    information.setPropagationStepSize(PROPAGATION_MM)
    information.setMinMaxControlDuration(round(1.0 / PROPAGATION_MM), round(ARC_MAX_MM / PROPAGATION_MM))
    setup.setStartState(start_of(scene, space))
    setup.setGoal(NearGoal(information, scene["goal"]))
    setup.setOptimizationObjective(base.PathLengthOptimizationObjective(information))
    planner = planner(information)
    if hasattr(planner, "setIntermediateStates"):
        planner.setIntermediateStates(True)
    setup.setPlanner(planner)
    setup.solve(until(seconds))
    if not setup.haveExactSolutionPath():
        return None
    path = setup.getSolutionPath()
    return [(path.getControl(i)[0], path.getControlDuration(i)) for i in range(path.getControlCount())]


def with_dubins(planner, scene, seconds):
    """Arcs of the path that a planner on Dubins paths finds, or None."""
    space = square(base.DubinsStateSpace(RADIUS_MM))
    setup = geometric.SimpleSetup(space)
    information = setup.getSpaceInformation()
    is_free = lambda s: clearance_mm(scene["obstacles"], s.getX(), s.getY()) >= MARGIN_MM
    setup.setStateValidityChecker(is_free)
    information.setStateValidityCheckingResolution(PROPAGATION_MM / space.getMaximumExtent())
    setup.setStartState(start_of(scene, space))
    goals = base.GoalStates(information)
    for number in range(HEADINGS):
        state = space.allocState()
        set_pose(state, (scene["goal"]["x_mm"], scene["goal"]["y_mm"], 2.0 * math.pi * number / HEADINGS))
        goals.addState(state)
    setup.setGoal(goals)
    setup.setOptimizationObjective(base.PathLengthOptimizationObjective(information))
    setup.setPlanner(planner(information))
    setup.solve(until(seconds))
    if not setup.haveExactSolutionPath():
        return None
    path = setup.getSolutionPath()
    path.interpolate(max(2, round(path.length() / PROPAGATION_MM)))
    poses = [pose_of(path.getState(i)) for i in range(path.getStateCount())]
    arcs = []
    for a, b in zip(poses, poses[1:]):
        turn = math.remainder(b[2] - a[2], 2.0 * math.pi)
        chord = math.hypot(b[0] - a[0], b[1] - a[1])
        length = chord * (0.5 * turn / math.sin(0.5 * turn) if abs(turn) > 1e-9 else 1.0)
        if length > 0.0:
            arcs.append((turn / length, length))
    return arcs


def check(scene, arcs):
    """Length and least clearance of a path, mm; says why it does not hold."""
    start = scene["start"]
    pose = (start["x_mm"], start["y_mm"], start["heading_rad"])
    least = clearance_mm(scene["obstacles"], *pose[:2])
    for curvature, length in arcs:
        if abs(curvature) > 1.001 / RADIUS_MM:
            return None, f"a radius of {1.0 / abs(curvature):.2f} mm"
        steps = math.ceil(length / CHECK_MM)
        for step in range(1, steps + 1):
            x, y, _ = on_arc(pose, curvature, length * step / steps)
            least = min(least, clearance_mm(scene["obstacles"], x, y))
        pose = on_arc(pose, curvature, length)
    miss = math.hypot(pose[0] - scene["goal"]["x_mm"], pose[1] - scene["goal"]["y_mm"])
    if miss > TOLERANCE_MM + 1e-6:
        return None, f"{miss:.3f} mm from the goal"
    if least < MARGIN_MM - CHECK_TOLERANCE_MM:
        return None, f"clearance {least:.3f} mm"
    return sum(length for _, length in arcs), least


PLANNERS = {
    "RRT": lambda scene, seconds: with_controls(control.RRT, scene, seconds),
    "KPIECE1": lambda scene, seconds: with_controls(control.KPIECE1, scene, seconds),
    "RRT*": lambda scene, seconds: with_dubins(geometric.RRTstar, scene, seconds),
    "BIT*": lambda scene, seconds: with_dubins(geometric.BITstar, scene, seconds),
}


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("scenes")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=2.0, help="processor time of one planning")
    parser.add_argument("--planners", nargs="+", choices=PLANNERS, default=list(PLANNERS))
    arguments = parser.parse_args()
    with open(arguments.scenes, encoding="utf-8") as file:
        scenes = json.load(file)["scenes"]
    scenes = [s for s in scenes if s["exhaustive_search"]["length_mm"] is not None]
    util.setLogLevel(util.LOG_NONE)
    util.RNG.setSeed(1)  # every planning takes its seeds from this one, in order
    for name in arguments.planners:
        ratios, times, always, clearances, refused = [], [], 0, [], 0
        for scene in scenes:
            of_scene = []
            for _ in range(arguments.seeds):
                begin = time.process_time()
                arcs = PLANNERS[name](scene, arguments.seconds)
                times.append(time.process_time() - begin)
                if arcs is None:
                    continue
                length, said = check(scene, arcs)
                if length is None:
                    refused += 1
                    print(f'  {scene["name"]}: path does not hold: {said}')
                    continue
                of_scene.append(length / scene["exhaustive_search"]["length_mm"])
                clearances.append(said)
            always += len(of_scene) == arguments.seeds
            ratios += of_scene
            shown = f"{min(of_scene):.3f} to {max(of_scene):.3f}" if of_scene else "-"
            print(f'{name:7} {scene["name"]:20} {len(of_scene)} of {arguments.seeds}, ratio {shown}', flush=True)
        runs = len(scenes) * arguments.seeds
        print(f"{name}: solved {len(ratios)} of {runs} ({100 * len(ratios) / runs:.0f}%), {always} of {len(scenes)} "
              f"scenes every time, {refused} paths do not hold")
        if ratios:
            print(f"{name}: ratio min {min(ratios):.3f}, median {statistics.median(ratios):.3f}, max {max(ratios):.3f};"
                  f" within 1.05: {sum(r <= 1.05 for r in ratios)}; least clearance {min(clearances):.3f} mm")
        print(f"{name}: processor time median {statistics.median(times):.3f} s, max {max(times):.3f} s", flush=True)


if __name__ == "__main__":
    main()
