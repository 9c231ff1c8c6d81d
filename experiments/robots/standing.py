"""Quadrupeds that are pushed at the trunk and have to keep standing on four feet.

    python experiments/robots/standing.py [--count 16] [--seconds 3] [--most 1.2] [--film FILE]

Each robot is pushed for 0.1 s in a horizontal direction of its own, by an impulse drawn between
nothing and `--most` times what a standing robot can survive in that direction. That bound is the
linear inverted pendulum's: mass m at the height z over a point of pressure that the feet choose
inside their polygon, at the distance d of its edge from the centre of mass,

    P ≤ m ω d · ωt / (1 − exp(−ωt)),        ω = √(g/z),  t = 0.1 s,

with the point of pressure at the edge from the first moment: beyond it the capture point leaves the
polygon. (A trunk that turns, or sinks, can do a little more.)

Compared: MPC with contact forces in friction cones (100 Hz), and joint PD with the same torques at
rest (500 Hz). A robot stands if its trunk stays above 0.15 m and within 45° and ends slower than
0.1 m/s. Friction and normal forces of the feet are those of MuJoCo's C engine at each sample
(mj_contactForce), and steps of the plant are compared with its.
"""

import argparse
import copy
import time
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np

import jaxmpc as jm
from jaxmpc.closed_loop import LinearFeedback, Run
from jaxmpc.robots import render, save_video
from jaxmpc.robots.description import host_coordinates

FILE = Path(__file__).parent / "quadruped.xml"
FEET = ("FL", "FR", "RL", "RR")
# Seconds of the push, and before it.
PUSH, BEFORE = 0.1, 0.1
# Samples that each move of the plan lasts, of 10 ms.
MOVES = (1, 1, 2, 2, 3, 4, 7, 10)
# Weights of position, orientation, joints, and their velocities.
Q = np.repeat([200.0, 400, 200, 100, 1, 1, 0.5, 0.01], [2, 1, 2, 1, 12, 3, 3, 12])
R = np.full(12, 1e-4)


def quadruped(control_period: float) -> Any:
    """Return the robot, on its feet in the model."""
    return jm.load_robot(FILE, control_period=control_period).standing(FEET, friction=0.9)


def standing_mpc(robot: Any) -> jm.RobotController:
    """Return the controller that stands."""
    blocked = {"horizon": sum(MOVES), "control_horizon": MOVES}
    mpc = jm.robot_mpc(robot, Q, R, **blocked)
    # From a warm start too as many steps of ADMM: pushes change many active rows.
    solver = jm.ADMM(iterations=50)
    return jm.RobotController(robot, mpc, solver, linearize="set-point", rho=100.0)


def joint_pd(robot: Any, mpc: jm.MPC, kp: float, kd: float) -> LinearFeedback:
    """Return joint PD about the torques of rest."""
    K = np.zeros((robot.m, robot.n))
    joints = np.arange(robot.m)
    K[joints, 6 + joints], K[joints, robot.n // 2 + 6 + joints] = -kp, -kd
    return LinearFeedback(mpc, K, robot)


class Rest:
    """The robot at rest in MuJoCo's C engine: mass, centre of mass, feet, and what an impulse
    (N s) at the trunk adds to the velocities, (nv, 3)."""

    def __init__(self, robot: Any, x: np.ndarray) -> None:
        model = robot.mujoco
        data = mujoco.MjData(model)
        data.qpos[:] = x[: model.nq]
        mujoco.mj_forward(model, data)
        self.mass, self.centre = model.body_mass.sum(), data.subtree_com[1].copy()
        self.feet = np.array([data.geom(name).xpos for name in FEET])
        J, M = np.zeros((3, model.nv)), np.zeros((model.nv, model.nv))
        mujoco.mj_jacBodyCom(model, data, J, None, 1)
        for i, unit in enumerate(np.eye(model.nv)):
            mujoco.mj_mulM(model, data, M[i], unit)
        self.by_impulse = np.linalg.solve(M, J.T)

    def survivable(self, directions: np.ndarray) -> np.ndarray:
        """Return the largest impulses (count,) in these directions (count, 2); see the top."""
        corners = self.feet[[0, 1, 3, 2], :2] - self.centre[:2]
        edges = np.roll(corners, -1, axis=0) - corners
        outward = np.stack([edges[:, 1], -edges[:, 0]], axis=1)
        outward *= np.sign(np.sum(outward * corners, axis=1, keepdims=True))
        along = directions @ outward.T
        far = np.sum(outward * corners, axis=1) / np.where(along > 0, along, np.nan)
        rate = np.sqrt(9.81 / self.centre[2])
        longer = rate * PUSH / (1 - np.exp(-rate * PUSH))
        return self.mass * rate * longer * np.nanmin(far, axis=1)


def pushes(
    robot: Any, rest: Rest, impulses: np.ndarray, steps: int, before: float = BEFORE
) -> np.ndarray:
    """Return the disturbances (count, steps, n) that pushes of these impulses (count, 2) are, after
    so many seconds."""
    first, last = round(before / robot.dt), round((before + PUSH) / robot.dt)
    added = np.zeros((len(impulses), steps, robot.state_size))
    change = impulses @ rest.by_impulse[:, :2].T / (last - first)
    added[:, first:last, robot.mujoco.nq :] = change[:, None]
    return added


def upright(states: np.ndarray) -> np.ndarray:
    """Return which robots (count,) stay on their feet, from their states (count, T+1, nq + nv)."""
    up = 1 - 2 * (states[:, :, 4] ** 2 + states[:, :, 5] ** 2)
    return np.all((states[:, :, 2] > 0.15) & (up > np.cos(np.pi / 4)), axis=1)


def stood(states: np.ndarray) -> np.ndarray:
    """Return which robots (count,) stand in the end."""
    return upright(states) & (np.linalg.norm(states[:, -1, 19:22], axis=1) < 0.1)


def of_feet(robot: Any, run: Run) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return normal forces and sideways forces over friction times normal ones (count, T, 4) of the
    feet, and how far (m) each next state is from that of MuJoCo's C engine (count, T).

    The engine's search for contact forces ends at a relative improvement of 1e-12 here: with the
    1e-8 of the file it has been 1e-8 m away after one sample, with 1e-12 it is 1e-15.
    """
    model, force = copy.deepcopy(robot.mujoco), np.zeros(6)
    model.opt.tolerance, model.opt.iterations = 1e-12, 200
    data = mujoco.MjData(model)
    count, steps = run.status.shape
    geoms = {model.geom(name).id: i for i, name in enumerate(FEET)}
    normal, share = np.zeros((2, count, steps, len(FEET)))
    error = np.zeros((count, steps))
    for i in range(count):
        for t in range(steps):
            data.qpos, data.qvel = np.split(run.states[i, t].astype(float), [model.nq])
            data.ctrl = run.inputs[i, t]
            data.qacc_warmstart = 0
            mujoco.mj_forward(model, data)
            for j, contact in enumerate(data.contact):
                mujoco.mj_contactForce(model, data, j, force)
                foot = geoms[int(contact.geom[1])]
                normal[i, t, foot] = force[0]
                sideways = np.abs(force[1:3]).sum()
                share[i, t, foot] = sideways / (contact.friction[0] * max(force[0], 1e-9))
            for _ in range(robot.substeps):
                mujoco.mj_step(model, data)
            after = np.concatenate([data.qpos, data.qvel])
            error[i, t] = np.abs(after - run.states[i, t + 1])[: model.nq].max()
    return normal, share, error


def feet_moved(robot: Any, states: np.ndarray) -> np.ndarray:
    """Return how far (m) each robot's feet are at the end from where they began, (count, 4)."""
    model, data = robot.mujoco, mujoco.MjData(robot.mujoco)

    def places(x: np.ndarray) -> np.ndarray:
        data.qpos[:] = x[: model.nq]
        mujoco.mj_kinematics(model, data)
        return np.array([data.geom(name).xpos for name in FEET])

    moved = [places(run[-1]) - places(run[0]) for run in states]
    return np.linalg.norm(np.array(moved)[:, :, :2], axis=2)


def film(file: Path, robot: Any, run: Run, ratio: np.ndarray, stands: np.ndarray) -> None:
    """Save a film of nine robots, from the least to the most pushed."""
    shown = np.argsort(ratio)[:: max(1, len(ratio) // 9)][:9]
    labels = [f"{ratio[i]:.2f} {'stands' if stands[i] else 'falls'}" for i in shown]
    frames = render(robot, run.states[shown], labels=False, every=4)
    print(f"film {file}: pushed by {', '.join(labels)} of what can be survived")
    save_video(file, frames, 1 / (4 * robot.dt))


def report(name: str, ratio: np.ndarray, stands: np.ndarray) -> None:
    """Print how many stand, by the share of what can be survived."""
    ends = np.array([0, 0.5, 0.7, 0.8, 0.9, 1.0, 1.1, 1.2, np.inf])
    groups = np.digitize(ratio, ends) - 1
    parts = [
        f"{ends[g]:.1f}- {stands[groups == g].mean():4.0%} of {np.sum(groups == g)}"
        for g in np.unique(groups)
    ]
    possible = ratio <= 1
    print(
        f"{name}: stand {stands[possible].mean():.1%} of {possible.sum()} that can; of all ", end=""
    )
    print(f"{stands.mean():.1%}; by share of the bound: {'; '.join(parts)}", flush=True)


def main() -> None:
    """Print how many robots stand under each controller."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--count", type=int, default=16)
    parser.add_argument("--seconds", type=float, default=3.0)
    parser.add_argument("--most", type=float, default=1.2)
    parser.add_argument("--film", type=Path)
    parser.add_argument("--save", type=Path, help="states and inputs, as npz")
    given = parser.parse_args()
    began = time.perf_counter()
    robot, quick = quadruped(0.01), quadruped(0.002)
    x, u = robot.equilibrium()
    rest, rng = Rest(robot, x), np.random.default_rng(0)
    angle = rng.uniform(-np.pi, np.pi, given.count)
    directions = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    ratio = rng.uniform(0, given.most, given.count)
    bound = rest.survivable(directions)
    impulses = (ratio * bound)[:, None] * directions
    print(f"{given.count} robots of {rest.mass:.3g} kg; survivable {bound.min():.3g} to ", end="")
    print(f"{bound.max():.3g} N s, pushed by up to {(ratio * bound).max():.3g} N s")
    controller = standing_mpc(robot)
    goal = {"reference": host_coordinates(robot, x), "input_reference": u}
    x0s, steps = np.tile(x, (given.count, 1)), round(given.seconds / robot.dt)
    print(f"prepared in {time.perf_counter() - began:.0f} s", flush=True)
    began = time.perf_counter()
    added = pushes(robot, rest, impulses, steps)
    run = jm.simulate_many(controller, robot, x0s, steps, disturbances=added, **goal)
    print(f"MPC simulated in {time.perf_counter() - began:.0f} s, compiling included", flush=True)
    stands, solved = stood(run.states), run.status == jm.Status.SOLVED
    report("MPC", ratio, stands)
    print(f"plans solved {solved.mean():.3%}, of robots that stood {solved[stands].mean():.3%}; ")
    print(f"violating a cone or limit {run.fallback.mean():.3%}, ", end="")
    print(f"of those of robots that stood {run.fallback[stands].mean():.3%}")
    chosen = np.flatnonzero(stands)[:64]
    normal, share, error = of_feet(robot, jax.tree.map(lambda v: v[chosen], run))
    down = normal > 1
    print(f"feet of {len(chosen)} robots that stood: on the ground {down.mean():.3%} of samples, ")
    sliding = np.mean(share[down] > 0.999)
    print(f"of these samples {sliding:.3%} slide and {np.mean(share[down] > 0.9):.3%} are ", end="")
    print(
        f"beyond the plan's friction; median of sideways over μ·normal {np.median(share[down]):.3f}"
    )
    print(f"plant against the C engine, a control period: {error.max():.2g} m, rad")
    slid = feet_moved(robot, run.states[chosen])
    print(f"feet moved by {np.median(slid):.3g} m (median), {slid.max():.3g} m (most)", flush=True)
    if given.save:
        np.savez_compressed(given.save, states=run.states, inputs=run.inputs, ratio=ratio)
    if given.film:
        film(given.film, robot, run, ratio, stands)
    for kp, kd in ((40, 1), (80, 2), (160, 4)):
        law = joint_pd(quick, controller.mpc, kp, kd)
        many = steps * round(robot.dt / quick.dt)
        added = pushes(quick, rest, impulses, many)
        pd = jm.simulate_many(law, quick, x0s, many, disturbances=added, **goal)
        report(f"PD {kp} N m/rad, {kd} N m s/rad", ratio, stood(pd.states))


if __name__ == "__main__":
    with jax.enable_x64(True):
        main()
