"""Tasks of robots: functions of mjx.Data against MuJoCo's C engine, and closed loops with them."""

from dataclasses import replace
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import jaxmpc as jm
from jaxmpc.mpc import NonlinearMPC, Task, solve_nonlinear
from jaxmpc.robots import RobotModel, tasks

TWO_ARMS = """
<mujoco model="two">
  <option timestep="0.005"/>
  <worldbody>
    <geom name="wall" type="box" size=".1 .1 .1" contype="0" conaffinity="0"/>
    <geom name="ball" type="sphere" size=".07" pos=".5 .1 .3" contype="0" conaffinity="0"/>
    <body name="left" pos="0 0 .3">
      <joint name="a" type="hinge" axis="0 .2 1" range="-2 2" armature=".02"/>
      <joint name="b" type="hinge" axis="0 1 0" range="-2 2"/>
      <geom name="left" type="capsule" fromto="0 0 0 .3 0 .1" size=".03" mass="1"
            contype="0" conaffinity="0"/>
      <body name="hand" pos=".3 0 .1" euler="20 30 40">
        <joint name="c" type="slide" axis="1 0 0" range="-1 1"/>
        <geom name="hand" type="capsule" size=".02 .08" pos=".1 0 0" mass=".4" contype="0"
              conaffinity="0"/>
        <site name="tip" pos=".15 .02 .01" quat=".9 .1 .3 -.2"/>
      </body>
    </body>
    <body name="right" pos=".6 .3 .2">
      <joint name="d" type="hinge" axis="1 0 0" range="-2 2"/>
      <geom name="right" type="capsule" fromto="0 0 0 -.2 .1 .2" size=".04" mass=".7"
            contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <actuator>
    <motor joint="a"/> <motor joint="b"/> <motor joint="c"/> <motor joint="d"/>
  </actuator>
</mujoco>
"""


@pytest.fixture(scope="module")
def two():
    model = mujoco.MjModel.from_xml_string(TWO_ARMS)
    return jm.load_robot(model, torque=20.0, velocity=3.0)


def states(robot, count):
    rng = np.random.default_rng(0)
    return rng.uniform(-1, 1, (count, robot.n)), rng.uniform(-1, 1, (count, robot.m))


def engine(robot, xi):
    model = robot.predictor.model
    model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_ENERGY)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = np.split(np.asarray(xi), 2)
    mujoco.mj_forward(model, data)
    return model, data


def nearest(first, second):
    """The least distance of two segments in extended precision: of their lines where the nearest
    points of these lie within, else of an end of one from the other."""
    (a, u, p, _), (b, v, q, _) = (
        (*(np.longdouble(part) for part in one[:2]), *one[2:]) for one in (first, second)
    )
    found = []
    for c, d, w, length in ((a + p * u, b, v, q), (a - p * u, b, v, q)):
        found.append(c - d - np.clip(w @ (c - d), -length, length) * w)
    for c, d, w, length in ((b + q * v, a, u, p), (b - q * v, a, u, p)):
        found.append(c - d - np.clip(w @ (c - d), -length, length) * w)
    n = np.cross(u, v)
    if n @ n > 0:
        s, t = (n @ np.cross(w, a - b) / (n @ n) for w in (v, u))
        if abs(s) <= p and abs(t) <= q:
            found.append(a + s * u - b - t * v)
    return min(np.sqrt(gap @ gap) for gap in found)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_distances_of_segments(dtype):
    """Nearly parallel ones too, and spheres, whose length is zero; derivatives of length one."""
    rng, eps = np.random.default_rng(0), np.finfo(dtype).eps
    with jax.enable_x64(dtype == np.float64):
        for lengths in ((0.0, 0.0), (0.5, 0.0), (0.0, 2.0), (1.0, 0.4)):
            value = jax.jit(
                jax.value_and_grad(
                    lambda a, u, b, v, lengths=lengths: jnp.linalg.norm(
                        tasks._between_segments((a, u, lengths[0], 0), (b, v, lengths[1], 0))
                    )
                )
            )
            for _ in range(100):
                a, b, u, other = rng.normal(size=(4, 3))
                v = u + 10 ** rng.uniform(-12, 1) * other
                u, v = u / np.linalg.norm(u), v / np.linalg.norm(v)
                a, b, u, v = (np.asarray(part, dtype) for part in (a, b, u, v))
                found, slope = value(a, u, b, v)
                wanted = nearest((a, u, lengths[0], 0), (b, v, lengths[1], 0))
                np.testing.assert_allclose(found, float(wanted), rtol=0, atol=300 * eps)
                np.testing.assert_allclose(np.linalg.norm(slope), 1, atol=1e-2)


class TestFunctions:
    """Values are the C engine's, derivatives finite differences of them."""

    def functions(self, two):
        model = two.predictor.model
        geom = lambda name: mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, name)
        between = lambda a, b: lambda m, d: mujoco.mj_geomDistance(m, d, geom(a), geom(b), 9, None)
        quaternion = np.array([0.5, -0.5, 0.5, 0.5])

        def turned(R):
            found, vector = np.zeros(4), np.zeros(3)
            mujoco.mju_mat2Quat(found, np.ravel(R))
            mujoco.mju_mulQuat(found, found.copy(), quaternion * [1, -1, -1, -1])
            mujoco.mju_quat2Vel(vector, found, 1)
            return vector

        turn = lambda name, kind: tasks.orientation(two, name, quaternion, kind)

        return {
            "tip": (tasks.position(two, "tip"), lambda m, d: d.site_xpos[0]),
            "hand": (tasks.position(two, "hand", "body"), lambda m, d: d.body("hand").xpos),
            "geom": (tasks.position(two, "left", "geom"), lambda m, d: d.geom("left").xpos),
            "turn": (turn("tip", "site"), lambda m, d: turned(d.site("tip").xmat)),
            "turn of a body": (turn("hand", "body"), lambda m, d: turned(d.body("hand").xmat)),
            "turn of a geom": (turn("left", "geom"), lambda m, d: turned(d.geom("left").xmat)),
            "arms": (tasks.distance(two, "hand", "right"), between("hand", "right")),
            "own ball": (tasks.distance(two, "left", "ball"), between("left", "ball")),
            "ball": (tasks.distance(two, "hand", ([0.5, 0.1, 0.3], 0.07)), between("hand", "ball")),
            "energy": (tasks.energy(two), lambda m, d: d.energy.sum()),
        }

    def test_are_the_engines(self, two, x64):
        model, (points, inputs) = RobotModel(two), states(two, 12)
        functions = self.functions(two)

        @jax.jit
        def values(xi, u):
            data = model.view(xi, u)
            return {name: function(data) for name, (function, _) in functions.items()}

        found = {name: [] for name in functions}
        for xi, u in zip(points, inputs, strict=True):
            m, d = engine(two, xi)
            for name, value in values(xi, u).items():
                found[name].append((value, functions[name][1](m, d)))
        for name, pairs in found.items():
            ours, theirs = (np.array(v) for v in zip(*pairs, strict=True))
            # The engine's distances are iterative.
            np.testing.assert_allclose(ours, theirs, atol=1e-6, err_msg=name)
        assert min(float(ours) for ours, _ in found["arms"]) < 0.15

    @pytest.mark.slow
    def test_have_derivatives(self, two, x64):
        model, (points, inputs) = RobotModel(two), states(two, 3)
        every = [function for function, _ in self.functions(two).values()]
        values = jax.jit(
            lambda xi, u: jnp.concatenate([jnp.atleast_1d(f(model.view(xi, u))) for f in every])
        )
        slopes = jax.jit(jax.jacfwd(values))
        for xi, u in zip(points, inputs, strict=True):
            J, h = slopes(xi, u), 1e-6
            for i in range(two.n):
                step = h * np.eye(two.n)[i]
                difference = (values(xi + step, u) - values(xi - step, u)) / (2 * h)
                np.testing.assert_allclose(J[:, i], difference, atol=2e-6)

    @pytest.mark.slow
    def test_of_no_turn_has_a_derivative(self, two, x64):
        model, xi = RobotModel(two), np.zeros(two.n)
        data = jax.jit(model.view)(xi, np.zeros(two.m))
        quaternion = np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, np.ravel(data.site_xmat[0]))
        function = tasks.orientation(two, "tip", quaternion)
        turn = lambda xi: function(model.view(xi, jnp.zeros(two.m)))
        np.testing.assert_allclose(jax.jit(turn)(xi), 0, atol=1e-12)
        J = jax.jit(jax.jacfwd(turn))(jnp.asarray(xi))
        np.testing.assert_allclose(J[:, 0], np.array([0, 0.2, 1]) / np.hypot(0.2, 1), atol=1e-9)

    @pytest.mark.slow
    def test_torques_are_of_the_inputs(self, two, x64):
        data = RobotModel(two).view(np.zeros(two.n), np.array([1.0, 2.0, 3.0, 4.0]))
        np.testing.assert_allclose(data.qfrc_actuator, [1, 2, 3, 4])

    @pytest.mark.parametrize(
        ("make", "text"),
        [
            (lambda r: tasks.position(r, "top"), "no site 'top' in robot. It has: tip"),
            (lambda r: tasks.position(r, "tip", "joint"), "kind: 'joint'"),
            (lambda r: tasks.distance(r, "wall", "ball"), "neither a sphere nor a capsule"),
            (lambda r: tasks.distance(r, "left", ([0, 0], 1)), r"second\[0\]: shape \(2,\)"),
            (lambda r: tasks.orientation(r, "tip", [1, 0, 0]), r"target: shape \(3,\)"),
            (lambda r: tasks.orientation(r, "tip", np.zeros(4)), r"target: is \(0, 0, 0, 0\)"),
            (lambda r: tasks.distance(r, "left", 5), "second: 5. Give the name of a geom, or"),
            (lambda r: tasks.distance(r, "left", ([0, 0, 0],)), "second: .*Give the name"),
            (lambda r: tasks.distance(r, "left", ([0, np.nan, 0], 1)), r"second\[0\]: holds NaN"),
            (lambda r: tasks.distance(r, "left", ([0, 0, 0], -1)), r"second\[1\]: -1. Give a"),
            (lambda r: tasks.energy(5), "robot: is an int. Give a jm.robots.Robot"),
        ],
    )
    def test_errors(self, two, make, text):
        with pytest.raises(ValueError, match=text):
            make(two)


def test_orientations_of_every_angle(two, x64):
    """Against SciPy, also next to half a turn, where the sine is as small as next to none; and the
    derivative of the angle along the axis is one."""
    function = tasks.orientation(two, "tip")
    site = mujoco.mj_name2id(two.mujoco, mujoco.mjtObj.mjOBJ_SITE, "tip")
    rng = np.random.default_rng(0)

    def turned(vector):
        half, norm = jnp.asarray(vector), jnp.sqrt(jnp.sum(vector**2))
        x, y, z = half / norm
        K = jnp.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        R = jnp.eye(3) + jnp.sin(norm) * K + (1 - jnp.cos(norm)) * K @ K
        every = jnp.zeros((two.mujoco.nsite, 3, 3)).at[site].set(R)
        return function(SimpleNamespace(site_xmat=every))

    for away in (0.0, 1e-9, 1e-5, 5e-5, 2e-4, 1e-2, 1.0, 1.7, 3.0):
        for axis in (*np.eye(3), *rng.normal(size=(5, 3))):
            n = axis / np.linalg.norm(axis)
            vector = (np.pi - away) * n
            found = turned(vector)
            if away == 0 and found @ n < 0:
                found = -found
            np.testing.assert_allclose(found, vector, atol=1e-7 if away < 1e-8 else 1e-9)
            if away > 1e-8:
                _, slope = jax.jvp(turned, (vector,), (n,))
                np.testing.assert_allclose(slope, n, atol=1e-6)


@pytest.fixture(scope="module")
def arm():
    """arm2 with a task: its tool to a point, its elbow not below a height."""
    robot = jm.load_robot("arm2")
    x0, u0 = robot.equilibrium()
    mpc = jm.robot_mpc(robot, [0.1, 0.1, 0.05, 0.05], horizon=12, terminal_cost=None)
    tool = tasks.position(robot, "tool")
    place = lambda data: tool(data)[jnp.array([0, 2])]
    aim = Task(place, weight=2e3, name="tool", unit="m")
    return robot, mpc, np.asarray(x0), np.asarray(u0), aim


class TestClosedLoops:
    """RobotController with tasks drives the plant."""

    def goals(self, arm):
        robot, *_ = arm
        found = []
        for q in ([0.4, -0.5], [-0.3, 0.6]):
            data = mujoco.MjData(robot.mujoco)
            data.qpos[:] = robot.home[:2] + np.array(q)
            mujoco.mj_forward(robot.mujoco, data)
            found.append(data.site_xpos[0][[0, 2]].copy())
        return np.array(found)

    @pytest.mark.slow
    def test_each_robot_reaches_a_target_of_its_own(self, arm, x64):
        robot, mpc, x0, u0, aim = arm
        law = jm.RobotController(robot, mpc, linearize="trajectory", tasks=(aim,))
        assert law.reference_sizes == (4, 6)
        goals = self.goals(arm)
        references = np.hstack([np.tile(x0, (2, 1)), goals])
        run = jm.simulate_many(
            law, robot, np.tile(x0, (2, 1)), 120, references=references, input_reference=u0
        )
        assert (run.status == jm.Status.SOLVED).all() and run.violation.max() == 0
        for i in range(2):
            data = mujoco.MjData(robot.mujoco)
            data.qpos[:] = run.states[i, -1, :2]
            mujoco.mj_forward(robot.mujoco, data)
            assert np.linalg.norm(data.site_xpos[0][[0, 2]] - goals[i]) < 0.01

    @pytest.mark.slow
    def test_a_limit_of_a_task_is_kept_or_counted(self, arm, x64):
        robot, mpc, x0, u0, aim = arm
        height = lambda data: data.site_xpos[0, 2]
        goal = self.goals(arm)[0]
        start = self.height(robot, x0)
        low = min(start, goal[1]) + 0.6 * abs(start - goal[1])
        limit = Task(height, lower=low if goal[1] < start else None,
                     upper=None if goal[1] < start else low, name="height", unit="m")  # fmt: skip
        law = jm.RobotController(robot, mpc, linearize="trajectory", tasks=(aim, limit))
        reference = np.concatenate([x0, goal, [0.0]])
        run = jm.simulate(law, robot, x0, 120, reference=reference, input_reference=u0)
        heights = np.array([self.height(robot, x) for x in run.states])
        beyond = low - heights if goal[1] < start else heights - low
        assert beyond.max() < 2e-3, beyond.max()
        assert not run.fallback.any()

    def height(self, robot, x):
        data = mujoco.MjData(robot.mujoco)
        data.qpos[:] = x[:2]
        mujoco.mj_forward(robot.mujoco, data)
        return data.site_xpos[0, 2]

    @pytest.mark.long
    def test_bad_arguments(self, arm, x64):
        robot, mpc, x0, u0, aim = arm
        with pytest.raises(ValueError, match="tasks: given with linearize='state'"):
            jm.RobotController(robot, mpc, tasks=(aim,))
        with pytest.raises(ValueError, match="sqp_steps: given with linearize='set-point'"):
            jm.RobotController(robot, mpc, linearize="set-point", sqp_steps=3)
        with pytest.raises(ValueError, match="sqp_steps: 0"):
            jm.RobotController(robot, mpc, linearize="trajectory", sqp_steps=0)
        law = jm.RobotController(robot, mpc, linearize="trajectory", tasks=(aim,))
        with pytest.raises(ValueError, match=r"reference: shape \(5,\)"):
            jm.simulate(law, robot, x0, 3, reference=np.zeros(5))


@pytest.mark.slow
def test_a_plan_has_derivatives_with_respect_to_masses(arm, x64):
    robot, mpc, x0, u0, _ = arm
    mpc = replace(mpc, Q=np.diag([10.0, 10.0, 0.1, 0.1]), terminal_cost=np.eye(4))
    masses = jnp.asarray(robot.mujoco.body_mass)

    def solution(factor):
        problem = NonlinearMPC(mpc, RobotModel(robot, {"body_mass": factor * masses}))
        plan = solve_nonlinear(
            problem, x0 + 0.1, x0, input_reference=u0, hessian="gauss-newton",
            solver=jm.ADMM(eps=1e-8),
        )  # fmt: skip
        return plan.inputs.ravel(), plan.status

    J, status = jax.jacfwd(solution, has_aux=True)(1.0)
    assert status == jm.Status.SOLVED
    h = 1e-3
    difference = (solution(1 + h)[0] - solution(1 - h)[0]) / (2 * h)
    np.testing.assert_allclose(J, difference, atol=1e-3 * np.abs(J).max())
