"""A linear model of a nonlinear robot and a set that holds everything it leaves out, by proof.

In deviations ζ = (q − q_s, v) and ν = u − u_s from a set-point, a physics step of length h is

    v⁺ = v + h a(ζ, ν),   q⁺ = q + h v⁺,   a = K ζ + L ν + δ(ζ, ν),

K, L a linear model of the accelerations and δ what it leaves out. So a control period of s steps is
ζ⁺ = A₁ˢ ζ + Σ_j A₁^j B₁ ν + Σ_j A₁^(s−1−j) E δ_j, E = (h² 1; h 1), exactly: bounds of δ where the
robot can be within the period bound what a linear model leaves out of the period.

Bounds of δ come from polynomials of Taylor whose second derivatives are enclosed over cells
(`acceleration_enclosures.py`), by branch and bound.
"""

from typing import Any

import numpy as np

from jaxmpc.arrays import host_array
from jaxmpc.checks import fail, require_kind, whole
from jaxmpc.pytrees import record
from jaxmpc.robots.acceleration_enclosures import Accelerations, powers
from jaxmpc.robots.branch_and_bound import Search
from jaxmpc.robots.description import host_coordinates
from jaxmpc.robots.intervals import Interval, add, dot, guarded, hull, point, subtract
from jaxmpc.robots.mujoco_access import single_joints
from jaxmpc.robots.physics import RK4
from jaxmpc.robots.robot import Robot
from jaxmpc.sets.convex_sets import Box
from jaxmpc.sets.lp import Program
from jaxmpc.systems.system import LinearSystem

MODELS = ("fitted", "tangent")


@record
class LinearEnclosure:
    """A linear model of a robot, and a set that holds what it leaves out.

    For all states in `states` and inputs in `inputs` from which x⁺ of the model lies in `states`,
    the robot's own next state is A x + B u + c + w with a w in `disturbance`.

    system: LinearSystem in coordinates ξ with the robot's names and period. disturbance: Box W
    (n,) that holds 0. states (n,), inputs (m,): Boxes. x (n,), u (m,): the set-point, where the
    model is exact. left_out: Box of the accelerations (nv,) that the linear model lacks. found:
    Box of those that samples lack, which no bound can be less than. cells: how many boxes the
    bounds are proved on.
    """

    system: LinearSystem
    disturbance: Box
    states: Box
    inputs: Box
    x: np.ndarray
    u: np.ndarray
    left_out: Box
    found: Box
    cells: int


def linear_enclosure(
    robot: Robot,
    states: Box | None = None,
    inputs: Box | None = None,
    *,
    target: Any = None,
    model: str = "fitted",
    tolerance: float = 0.02,
    cells: int = 20_000,
) -> LinearEnclosure:
    """Return a linear model of a robot and a box of disturbances that holds what it leaves out.

    A robust MPC of them makes claims about the nonlinear robot: `jaxmpc.closed_loop.enclosed_mpc`.

    Arguments:
        states: Box (n,) of the states to which the claim is limited, the limits of the MPC; None
            for `robot.state_limits`. Every coordinate bounded, positions inside joints' ranges: at
            their ends the plant has springs that no linear model knows.
        inputs: Box (m,), None for `robot.input_limits`.
        target: configuration (nq,) of the set-point, as for `robot.equilibrium`; None: home.
        model: "fitted", the model with the least error of each acceleration on samples of the
            boxes that is exact at the set-point; "tangent", the derivative at the set-point, as
            `robot.linearize` has it (disturbances are two to four times as large).
        tolerance: the bounds end within this fraction of the width of the accelerations found on
            samples, if there are cells enough.
        cells: boxes to compute bounds on, at most; with fewer the bounds hold too and are wider.

    The bounds hold in exact arithmetic for the numbers of the model: those of rounding within the
    plant's program (1e-16 of its numbers in float64, 1e-7 in float32) are not in them. Computed
    outside JAX in float64, rounded outward; not traceable.

    Raises ValueError for robots that are more than a tree of hinges and slides with motors, servos
    and dampers (contacts, couplings, dry friction, tendons, force limits, quaternions, activations,
    integrator RK4), for unbounded boxes or such without the set-point, and where the robot can
    reach the end of a joint's range within a period.
    """
    require_kind("robot", robot, Robot)
    _require_smooth(robot)
    if model not in MODELS:
        fail("model", f"{model!r}", f"Give one of {', '.join(MODELS)}")
    if not 0 < tolerance < 1:
        fail("tolerance", f"{tolerance}", "Give a fraction, as 0.02")
    whole("cells", cells, 1)
    state, u = robot.equilibrium() if target is None else robot.set_point(target)
    x = host_coordinates(robot, state)
    z = np.concatenate([x, u])
    lower, upper = _bounds(robot, states, inputs, z)
    dynamics = Accelerations(robot, z, lower, upper)
    dynamics.require_quadratic()
    slope = dynamics.tangent()
    samples, values = dynamics.samples(slope)
    if model == "fitted":
        slope = _fitted(samples - z, values, slope, dynamics.bent())
    search = Search(dynamics, slope, values - (samples - z) @ slope.T, tolerance)
    with guarded():
        left_out, count = search.run(cells)
    system, disturbance = _period(robot, x, u, slope, left_out, lower, upper)
    n = robot.n
    return LinearEnclosure(
        system=system,
        disturbance=disturbance,
        states=Box(lower[:n], upper[:n]),
        inputs=Box(lower[n:], upper[n:]),
        x=x,
        u=np.asarray(u),
        left_out=Box(left_out.lower, left_out.upper),
        found=Box(search.least, search.most),
        cells=count,
    )


def _require_smooth(robot: Robot) -> None:
    """Raise ValueError for a robot whose plant is more than smooth rigid bodies with ends of the
    joints' ranges."""
    model = robot.plant.model
    cure = "Take a tree of hinges and slides with motors and dampers, without contacts"
    refused = {
        "ball or free joints": not np.all(single_joints(model)),
        "activation states": model.na,
        "the integrator RK4": model.opt.integrator == RK4,
        "dry friction": np.any(model.dof_frictionloss),
        "couplings": robot.predictor.rows,
        "tendons": model.ntendon,
        "limits of forces": np.any(model.actuator_forcelimited) or np.any(model.jnt_actfrclimited),
        "forces of a fluid": model.opt.density or model.opt.viscosity,
        "numbers that vary": robot.numbers,
    }
    for what, there in refused.items():
        if there:
            fail("robot", f"has {what}, whose bounds are not known", cure)
    if robot.plant.rows and robot.plant.constraints != np.count_nonzero(model.jnt_limited):
        fail("robot", "has contacts, whose bounds are not known", cure)


def _bounds(
    robot: Robot, states: Box | None, inputs: Box | None, z: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower and upper bounds (n + m,) of states and inputs."""
    ends = []
    given = {"states": (states, robot.state_limits, robot.state_names, robot.n)}
    given["inputs"] = (inputs, robot.input_limits, robot.input_names, robot.m)
    start = 0
    for argument, (box, own, names, size) in given.items():
        box = own if box is None else box
        require_kind(argument, box, Box)
        box.validate(argument, size)
        low, high = (host_array(argument, v) for v in box.spread(size).bounds(argument))
        at = z[start : start + size]
        for i, name in enumerate(names):
            if not np.isfinite(low[i]) or not np.isfinite(high[i]):
                cure = f"Give {argument} that are bounded in every coordinate"
                fail(argument, f"{name} has no bounds", cure)
            if low[i] == high[i] and argument == "states":
                fail(argument, f"{name} has no width", "Give it some: what moves leaves a point")
            if not low[i] <= at[i] <= high[i]:
                problem = f"{name} in [{low[i]:g}, {high[i]:g}] leaves out the set-point {at[i]:g}"
                fail(argument, problem, "Give a box around the set-point")
        ends.append((low, high))
        start += size
    return tuple(np.concatenate(parts) for parts in zip(*ends, strict=True))  # type: ignore[return-value]


def _fitted(
    points: np.ndarray, values: np.ndarray, tangent: np.ndarray, bent: np.ndarray
) -> np.ndarray:
    """Return the slopes (nv, d) with the least largest error |value − slope · point| for each
    acceleration, by linear programs; those of the tangent in coordinates (nv, d) that are not
    bent."""
    slopes = tangent.copy()
    for row, column, free in zip(slopes, values.T, bent, strict=True):
        if not free.any():
            continue
        rest = column - points @ row
        P, scale = points[:, free], np.abs(rest).max() or 1.0
        size = np.abs(P).max(axis=0)
        ones = np.ones((len(P), 1))
        rows = np.block([[P / size, -ones], [-P / size, -ones]])
        goal = np.append(np.zeros(P.shape[1]), -1.0)
        best = Program(rows, np.concatenate([rest, -rest]) / scale).maximise(goal)
        row[free] += best.x[:-1] * scale / size  # type: ignore[index]
    return slopes


def _period(
    robot: Robot,
    x: np.ndarray,
    u: np.ndarray,
    slope: np.ndarray,
    left_out: Interval,
    lower: np.ndarray,
    upper: np.ndarray,
) -> tuple[LinearSystem, Box]:
    """Return the model of a control period, and the box of what it leaves out, rounding of its
    own numbers included."""
    n = robot.n
    with guarded():
        A, B, ways, _ = powers(robot, slope)
        A_n, B_n = (A.lower + A.upper) / 2, (B.lower + B.upper) / 2
        c = x - A_n @ x - B_n @ u
        zeta = subtract(Interval(lower, upper), point(np.concatenate([x, u])))
        total_error = add(
            dot(subtract(A, point(A_n)), zeta[:n]), dot(subtract(B, point(B_n)), zeta[n:])
        )
        at_rest = add(dot(point(A_n), point(x)), dot(point(B_n), point(np.asarray(u))))
        shift = subtract(point(x), add(at_rest, point(c)))
        total_error = add(total_error, shift)
        for way in ways:
            total_error = add(total_error, dot(way, left_out))
    zero = np.zeros(n)
    box = hull(total_error, Interval(zero, zero))
    names: dict[str, Any] = {"state_names": robot.state_names, "state_units": robot.state_units}
    names |= {"input_names": robot.input_names, "input_units": robot.input_units}
    return LinearSystem(A_n, B_n, c, robot.dt, **names), Box(box.lower, box.upper)
