"""Maps of robots: predictions against the C engine, closed loops of known ends, and the files."""

import json
from dataclasses import replace

import jax
import mujoco
import numpy as np
import problems
import pytest
from command_line import run
from scipy.optimize import linprog

import jaxmpc as jm
from jaxmpc.app.plots import plot_robot_map
from jaxmpc.feasible.pipeline import Labels
from jaxmpc.robot_maps import OUTCOMES, map_robot, mapping
from jaxmpc.robot_maps.mapping import RobotSetting, deviations, with_initial_limits
from jaxmpc.robot_maps.robot_map import RobotLoops

SECONDS = 0.8
SERVO = """<mujoco><option timestep=".01" gravity="0 0 0"/><worldbody><body>
<joint name="slide" type="slide" axis="1 0 0" range="-1 1" damping=".1"/><geom size=".1" mass="1"/>
</body></worldbody><actuator><position joint="slide" kp="100" kv="10" ctrlrange="-1 1"
forcerange="-5 5"/></actuator></mujoco>"""


def test_terminal_sets_of_robots_keep_the_forces_of_servos():
    """On the set the law asks for as much force as the servo has, and no more."""
    robot = jm.load_robot(mujoco.MjModel.from_xml_string(SERVO))
    mpc = mapping.mpc_with_terminal(robot, 4, "invariant")
    K = np.asarray(jm.lqr(replace(mpc.system, c=None), mpc.Q, mpc.R).K)
    force = np.array([[-100.0, -10.0]]) + 100 * K  # at rest in 0
    np.testing.assert_allclose(mpc.terminal_set.support(force), 5.0, rtol=1e-6)


@pytest.fixture(scope="module")
def hanging():
    """A pendulum that hangs: the tangent of the sine predicts more braking than there is."""
    model = jm.load_robot("pendulum").mujoco
    model.opt.gravity[2] *= -1
    robot = jm.load_robot(model, torque=3.0, position=1.5, control_period=0.05)
    limit = np.asarray(robot.state_limits.upper)
    mpc = jm.robot_mpc(robot, 1 / limit**2, [0.1 / 9], 20)
    near = jm.grid([-1.4, 4.4], [0.6, 5.6], (5, 4))  # the rim of the feasible set
    beyond = [[-1.51, 2.0]]  # comes in at once
    points = np.concatenate([jm.grid(-1.1 * limit, 1.1 * limit, (7, 7)), near, beyond])
    with jax.enable_x64(True):  # few Newton steps, for a quick compile
        controller = jm.RobotController(robot, mpc, jm.ADMM(100, newton_steps=3), "set-point")
    rmap = map_robot(robot, mpc, points, SECONDS, controller=controller)
    return robot, mpc, points, controller, rmap


def has_plan(mpc, x):
    """Whether the linear model has inputs that keep the state limits at k = 1 … N (one LP)."""
    A, B, c = (np.asarray(v) for v in (mpc.system.A, mpc.system.B, mpc.system.c))
    N, (n, m) = mpc.horizon, B.shape
    lower, upper = np.asarray(mpc.states.lower), np.asarray(mpc.states.upper)
    free, G, rows, sides = x, np.zeros((n, N * m)), [], []
    for k in range(N):
        free, G = A @ free + c, A @ G
        G[:, k * m : (k + 1) * m] += B
        rows += [G, -G]
        sides += [upper - free, free - lower]
    u = np.stack([np.tile(mpc.inputs.lower, N), np.tile(mpc.inputs.upper, N)], axis=1)
    result = linprog(np.zeros(N * m), np.vstack(rows), np.concatenate(sides), bounds=u)
    return result.status == 0


@pytest.mark.slow
def test_prediction_is_that_of_the_linear_map(hanging):
    robot, mpc, points, _, rmap = hanging
    feasible = np.array([has_plan(mpc, x) for x in points])
    beyond = np.any(np.abs(points) > np.asarray(robot.state_limits.upper), axis=1)
    assert np.any(beyond & feasible), "robot_mpc leaves x_0 free"
    np.testing.assert_array_equal(rmap.predicted, np.where(feasible & ~beyond, 1, -1))
    counts = rmap.counts()
    assert sum(sum(row.values()) for row in counts.values()) == len(points)
    assert counts["predicted"]["failed"] == rmap.broken.sum() > 0, "the sine matters"
    assert rmap.broken[rmap.worst()] and 0 < rmap.depth[rmap.worst()] < 1
    np.testing.assert_array_equal(rmap.outcome == 1, rmap.broken)


@pytest.mark.slow
def test_loops_equal_the_c_engine(hanging):
    """The recorded inputs through mujoco.mj_step give the same labels."""
    robot, mpc, points, controller, rmap = hanging
    setting = RobotSetting.of(robot, mpc, points, SECONDS, controller=controller)
    with jax.enable_x64(True):
        run = jm.simulate_many(
            controller, robot, points, 16, reference=np.zeros(2), input_reference=np.zeros(1)
        )
        again = setting.run(points, len(points))
    assert run.states.dtype == np.float64 and setting.dtype == "float64"
    np.testing.assert_array_equal(again.broken_at, rmap.loops.broken_at)
    data, limit = mujoco.MjData(robot.mujoco), np.asarray(robot.state_limits.upper)
    for i in range(len(points)):
        mujoco.mj_resetData(robot.mujoco, data)
        data.qpos[:], data.qvel[:] = points[i]
        excess = [np.max(np.abs(points[i]) - limit)]
        for u in run.inputs[i]:
            data.ctrl[:] = u
            mujoco.mj_step(robot.mujoco, data, robot.substeps)
            excess.append(np.max(np.abs([*data.qpos, *data.qvel]) - limit))
        beyond = np.array(excess) > 1e-6
        assert rmap.within_limits[i] == ~beyond.any()
        assert rmap.loops.broken_at[i] == (np.argmax(beyond) if beyond.any() else -1)
        if rmap.within_limits[i]:
            assert rmap.loops.worst[i] == pytest.approx(max(*excess, 0), abs=1e-9)


@pytest.mark.slow
def test_picture(hanging):
    rmap = hanging[-1]
    ax = plot_robot_map(rmap)
    texts = [text.get_text() for text in ax.get_legend().get_texts()]
    count = np.sum(rmap.broken & ~rmap.unsure)
    broken = f"predicted, failed: a plan exists,\nthe robot leaves its limits ({count})"
    assert broken in texts and "set-point" in texts
    assert ax.get_xlabel() == "theta [rad]" and "0.8 s" in ax.get_title(loc="left")
    assert "predicted, failed" in str(rmap)
    line = replace(rmap, linear=replace(rmap.linear, x0s=rmap.x0s[:, :1]))
    with pytest.raises(ValueError, match="needs 2"):
        plot_robot_map(line)


def linear(mpc, dt=1.0, **changes):
    """The plant of an MPC problem, and the problem."""
    mpc = replace(mpc, system=replace(mpc.system, dt=dt), **changes)
    return jm.LinearPlant(mpc.system, mpc.states, mpc.inputs), mpc


def lecture_with_end(size):
    """The lecture's problem with `size` times the maximal invariant set of its LQR at the end."""
    _, mpc = linear(problems.lecture())
    K = jm.lqr(mpc.system, mpc.Q, mpc.R).K
    end = jm.maximal_invariant_set(mpc.system, K, mpc.states, mpc.inputs)
    return linear(mpc, terminal_set=jm.Polytope(end.H, size * end.h))


@pytest.mark.slow
def test_linear_robot_keeps_every_prediction_with_an_invariant_end():
    plant, mpc = lecture_with_end(1.0)
    points = jm.grid([-1.0, -1.0], [1.0, 1.0], (12, 12))
    with jax.enable_x64(True):
        controller = jm.RobotController(plant, mpc, jm.ADMM(100, newton_steps=6), "set-point")
    rmap = map_robot(plant, mpc, points, 8.0, controller=controller, chunk=100)
    assert not rmap.broken.any() and rmap.worst() is None
    assert np.sum(rmap.predicted == 1) > 40 and np.all(rmap.recursive[rmap.predicted == 1] == 1)


@pytest.mark.slow
def test_linear_robot_loses_what_the_linear_recursion_loses():
    """With an end five times as large plans run out, on both in the same sample."""
    plant, mpc = lecture_with_end(5.0)
    points = jm.grid([-1.0, -1.0], [1.0, 1.0], (12, 12))
    rmap = map_robot(plant, mpc, points, 8.0, claim="recursion", chunk=100)
    report = jm.recursive_feasibility(mpc, points, steps=7, search=False, max_regions=0)
    lost = report.loops.lost_at
    np.testing.assert_array_equal(rmap.predicted, np.select([lost == 0, lost > 0], [1, -1], -1))
    np.testing.assert_array_equal(rmap.held, rmap.predicted)
    later = lost > 0
    assert later.sum() > 4 and np.any(lost == 0)
    np.testing.assert_array_equal(rmap.first_loss[later], lost[later])
    assert np.all(rmap.linear.label[later] == 1), "feasible at first"
    # Feasible for three steps, and beyond the limits later: the other claim is broken there.
    limits = replace(rmap, claim="limits", recursion=None)
    assert limits.broken.any() and limits.outcome.max() < len(OUTCOMES)


def test_labels_of_loops_by_hand():
    """Violations, inputs beyond limits, numbers that are not finite, plans that are not solved."""
    plant = jm.LinearPlant(
        jm.LinearSystem(np.eye(1), np.eye(1), dt=0.1), problems.symmetric(1.0),
        problems.symmetric(0.5),
    )  # fmt: skip
    states = np.array([[0, 0.5, 1], [0, 2, 0], [0, 0, 1.25], [0, np.inf, 0], [0, 0, 0], [0, 0, 0]])
    inputs = np.array([[0.5, 0.5], [0, 0], [0, 0], [0, 0], [0, 0.75], [0, 0]])
    status = np.ones((6, 2), int)
    status[5] = [7, 1]
    fallback = np.zeros((6, 2), bool)
    fallback[5, 1] = True
    none = np.zeros((6, 2))
    run = jm.closed_loop.Run(
        states[..., None], inputs[..., None], none, status, none, none, none, fallback
    )  # fmt: skip
    loops = RobotLoops.of(run, plant, "float64")
    np.testing.assert_allclose(loops.worst, [0, 1, 0.25, np.nan, 0.25, 0])
    np.testing.assert_array_equal(loops.broken_at, [-1, 1, 2, 1, 1, -1])
    np.testing.assert_array_equal(loops.lost_at, [-1, 1, -1, 1, 1, 1])
    np.testing.assert_array_equal(loops.unsolved_at, [-1] * 5 + [0])
    mpc = problems.scalar(horizon=2)
    points = np.zeros((6, 1))
    setting = RobotSetting.of(plant, mpc, points, 0.2)
    rmap = setting.map(Labels.empty(6, setting.problem), loops, None, 60.0)
    np.testing.assert_array_equal(rmap.within_limits, [True, False, False, False, False, True])
    np.testing.assert_array_equal(rmap.recursive, [1, -1, 1, -1, -1, 0])
    assert rmap.plan_counts() == {"SOLVED": 11, "ITERATION_LIMIT": 1}


def test_deviations_are_the_same_problem():
    """Rest is at the origin, steps agree, and a point keeps a row here where it does there."""
    bounds = jm.Outputs(np.ones((1, 2)), [-0.2], [0.3], np.ones((1, 2)))
    mpc = replace(problems.drifting(), outputs=bounds)
    assert with_initial_limits(mpc, problems.symmetric(50.0, 50.0)) is mpc, "states imply them"
    x, random = np.array([0.2, -0.1]), np.random.default_rng(0)
    A, B, c = (np.asarray(v) for v in (mpc.system.A, mpc.system.B, mpc.system.c))
    u = np.linalg.solve(B, x - A @ x - c)
    about = deviations(mpc, x, u)
    np.testing.assert_allclose(about.system.c, 0, atol=1e-15)
    for name, at in (("states", x), ("inputs", u), ("terminal_set", x)):
        points = random.uniform(-2, 2, (200, 2))
        found = []
        for problem, moved in ((mpc, points), (about, points - at)):
            C, lower, upper = (np.asarray(v) for v in getattr(problem, name).rows())
            found.append(np.all((lower <= moved @ C.T) & (moved @ C.T <= upper), axis=1))
        np.testing.assert_array_equal(*found)
        assert 0 < found[0].sum() < 200
    (rows,) = about.outputs
    by = np.sum(x) + np.sum(u)
    np.testing.assert_allclose([rows.lower[0], rows.upper[0]], [-0.2 - by, 0.3 - by])
    assert deviations(mpc, np.zeros(2), np.zeros(2)) is mpc
    ball = replace(mpc, terminal_set=jm.Ellipsoid(np.eye(2), 1.0))
    with pytest.raises(ValueError, match="terminal_set: is an Ellipsoid"):
        deviations(ball, x, u)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"robot": object()}, "robot: is an object"),
        ({"mpc": "joint"}, "mpc: is a str. Give a jm.MPC"),
        ({"target": [np.nan]}, "target: "),
        ({"target": [1.0, 2.0]}, r"target: shape \(2,\)"),
        ({"chunk": 1.5}, "chunk: 1.5"),
        ({"mpc": problems.joint()}, r"mpc: has \(2, 1\) states and inputs"),
        ({"mpc": problems.scalar(input_rate_limit=0.1)}, "input rates"),
        ({"x0s": np.zeros((4, 2))}, r"x0s: shape \(4, 2\)"),
        ({"x0s": np.zeros((0, 1))}, "x0s"),
        ({"seconds": 0.0}, "seconds: 0.0"),
        ({"seconds": np.nan}, "seconds: nan"),
        ({"seconds": np.inf}, "seconds: inf. Give a finite number"),
        ({"seconds": True}, "seconds: True"),
        ({"seconds": "1"}, "seconds: '1' where real numbers"),
        ({"search_seconds": np.nan}, "search_seconds: nan"),
        ({"axes": 0}, "axes: 0 is not a list. Give state indices"),
        ({"controller": "x"}, "controller: is a str. Give a jm.RobotController"),
        ({"claim": "both"}, "claim: 'both'"),
        ({"axes": (1,)}, "axes"),
        ({"fixed": np.zeros(3)}, "fixed"),
        ({"chunk": 0}, "chunk: 0"),
    ],
)
def test_wrong_arguments_are_named(change, message):
    plant, mpc = linear(problems.scalar())
    given = {"robot": plant, "mpc": mpc, "x0s": np.zeros((3, 1)), "seconds": 2.0} | change
    with pytest.raises(ValueError, match=message):
        map_robot(**given)


@pytest.mark.slow
def test_command_goes_on_where_it_was_stopped(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(mapping, "default_chunk", lambda: 32 * 8)
    real, calls = RobotSetting.run, []

    def stopped(self, points, size, devices=None):
        calls.append(points)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return real(self, points, size, devices)

    monkeypatch.setattr(RobotSetting, "run", stopped)
    line = "sweep --robot joint --grid 5 4 --horizon 3 --seconds 0.05 --output out"
    assert run(line) == 130
    assert "--output out --resume" in capsys.readouterr().out
    assert run(line) == 2 and "--resume" in capsys.readouterr().err
    assert run(f"{line} --resume --fixed 1") == 2
    assert run(f"{line} --resume --lower -1 -1") == 2
    assert "lower" in capsys.readouterr().err
    assert run(f"{line} --resume") == 0
    assert [len(points) for points in calls] == [8, 8, 8, 4], "the first chunk is kept"
    assert run("verify out") == 0
    out = capsys.readouterr().out
    assert "predicted, failed" in out and "robot_map.png" in out
    summary = json.loads((tmp_path / "out/summary.json").read_text())
    assert summary["precision"] == "float64" and summary["config"]["steps"] == 5
    robot = jm.load_robot("joint")
    with np.load(tmp_path / "out/robot_map.npz") as data:
        found = dict(data)
    limit = np.asarray(robot.state_limits.upper)
    np.testing.assert_allclose(found["x0s"], jm.grid(-1.06 * limit, 1.06 * limit, (5, 4)))
    assert summary["counts"]["predicted"]["kept"] == np.sum(
        (found["predicted"] == 1) & found["within_limits"]
    )
    assert run("recursion --robot joint --grid 5 4 --horizon 3 --steps 5 --output rec") == 0
    summary = json.loads((tmp_path / "rec/summary.json").read_text())
    assert summary["claim"] == "recursion" and "law" in summary["linear"]["recursion"]


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("sweep --robot joint --config a.toml", "--config"),
        ("sweep --robot joint --projection", "--projection"),
        ("sweep --seconds 2", "--seconds: given without --robot"),
        ("sweep --robot jont", "is no file"),
        ("sweep --robot joint --axes elbow --grid 4", "no coordinate 'elbow'"),
        ("sweep --robot joint --axes 0 0", "repeats"),
        ("sweep --robot joint --grid 4", "grid: has 1 entries"),
        ("sweep --robot joint --fixed 1", "fixed: has 1 entries"),
        ("sweep --robot joint --lower 2 2 --upper 1 1", "lower: [2.0, 2.0] not below"),
        ("sweep --robot joint --seconds -1", "seconds"),
        ("sweep --robot joint --terminal ellipsoid", "ellipsoid"),
        ("sweep --robot joint --resume --overwrite", "--overwrite"),
        ("recursion --robot joint --smallest 4", "--smallest"),
        ("recursion --robot joint --steps 0", "--steps"),
        ("recursion --axes 0 1", "--axes: given without --robot"),
    ],
)
def test_wrong_options_are_named(line, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(RobotSetting, "run", lambda *a: pytest.fail("loops started"))
    assert run(line) == 2
    err = capsys.readouterr().err
    assert message in err and err.count("\n") == 1


@pytest.mark.parametrize(
    ("states", "added"),
    [
        (None, 2),
        (jm.Box([-1.0, -1.0], [1.0, 1.0]), 0),
        (jm.Box([-1.0, -2.0], [1.0, 2.0]), 2),
        (jm.Box([-1.0, -np.inf], [1.0, np.inf]), 2),
        (jm.Polytope([[1.0, 0.0]], [0.5]), 2),
    ],
)
def test_limits_of_the_robot_hold_at_first(states, added):
    """Whatever those of the problem are: a state beyond them has no plan."""
    system = jm.LinearSystem([[1.0, 0.1], [0.0, 1.0]], [0.0, 0.1], dt=0.1)
    mpc = jm.MPC(system, np.eye(2), 1.0, 3, states=states, inputs=jm.Box(-1.0, 1.0))
    limited = with_initial_limits(mpc, jm.Box([-1.0, -1.0], [1.0, 1.0]))
    assert sum(len(rows.lower) for rows in limited.outputs) == added
    points = np.array([[0.4, 0.4], [0.4, 1.5], [-1.2, 0.0], [-1.0, 0.0]])
    labels = jm.map_feasible_set(limited, points).label
    np.testing.assert_array_equal(labels, [1, -1, -1, 1])


def test_what_is_no_map_is_named():
    robot = jm.load_robot("pendulum")
    mpc = jm.robot_mpc(robot, horizon=3)
    soft = replace(mpc, soft=jm.Soft([1.0, 0.0], upper=0.2))
    with pytest.raises(ValueError, match="mpc.soft: has rows.*claim=.limits"):
        map_robot(robot, soft, np.zeros((1, 2)), claim="recursion")
    assert run("sweep --robot pendulum --grid 0 2 --seconds 0.1") == 2


def test_controllers_of_other_plants_are_named():
    (plant, mpc), other = linear(problems.scalar()), linear(problems.joint())
    with pytest.raises(ValueError, match=r"controller: plans with \(2, 1\) states and inputs"):
        map_robot(plant, mpc, np.zeros((3, 1)), controller=jm.RobotController(*other))
