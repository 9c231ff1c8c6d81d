"""The lesson's programs and problems: each script's numbers, and the parts they are made of."""

import importlib
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmpc as jm
from jaxmpc.mpc.condense import condense

LESSON = Path(__file__).parents[2] / "experiments" / "lesson"
sys.path.append(str(LESSON))


def run(name, **settings):
    """The table of a script."""
    module = importlib.import_module(name)
    with jax.enable_x64(True):
        return module.run(module.Settings(**settings))


@pytest.mark.long
@pytest.mark.parametrize(("n", "m", "N", "seed"), [(2, 1, 20, None), (3, 2, 4, 0)])
def test_condensed_matrices_entry_by_entry(n, m, N, seed):
    """H, f, G and bounds against explicit powers of A; the lesson's joint and a random system."""
    independent, joint = (importlib.import_module(s) for s in ("independent", "lesson_joint"))
    draw = np.random.default_rng(seed or 0).standard_normal
    reference, x0 = draw(n), draw(n)
    if seed is None:
        A, B, Q, R, P = joint.A, joint.B, joint.Q, joint.R, joint.Q
        x_max, u_max = joint.X_MAX, joint.TAU_MAX
    else:
        A, B, x_max, u_max = draw((n, n)), draw((n, m)), np.exp(draw(n)), np.exp(draw(m))
        Q, R, P = (M @ M.T + np.eye(len(M)) for M in (draw((n, n)), draw((m, m)), draw((n, n))))
    limit = jm.Box(-x_max, x_max)
    mpc = jm.MPC(
        jm.LinearSystem(A, B), Q, R, N, states=limit, inputs=jm.Box(-u_max, u_max),
        terminal_cost=P, terminal_set=limit, prestabilise=False,
    )  # fmt: skip
    with jax.enable_x64(True):
        condensed = condense(mpc)
        qp = condensed.qp(jnp.asarray(x0), np.tile(reference, (N + 1, 1)))
        z = draw(N * m)
        states, inputs = condensed.trajectory(jnp.asarray(x0), z)
    own = independent.condense(A, B, Q, R, P, N, x0, x_max, u_max, reference, range(N + 1))
    for ours, theirs in zip((qp.P, qp.q, qp.A, qp.l, qp.u), own, strict=False):
        np.testing.assert_allclose(ours, theirs, atol=1e-13 * max(1, np.abs(theirs).max()))

    # The stacked form of the lesson's section 2: E z = b is the dynamics, and the costs agree.
    stack = independent.stack(A, B, Q, R, P, N, x0, x_max, u_max, range(N + 1))
    whole = np.concatenate([np.ravel(inputs), np.ravel(states)])
    size = np.abs(whole).max()
    np.testing.assert_allclose(stack.E @ whole, stack.b, atol=1e-13 * size)
    assert np.linalg.matrix_rank(stack.E) == (N + 1) * n
    shifted = whole - np.concatenate([np.zeros(N * m), np.tile(reference, N + 1)])
    np.testing.assert_allclose(0.5 * shifted @ stack.H @ shifted, own.cost(z), rtol=1e-12)
    slack = np.concatenate([own.u - own.G @ z, own.G @ z - own.l])
    np.testing.assert_allclose(
        np.sort(stack.h - stack.G @ whole), np.sort(slack), atol=1e-12 * size
    )


def test_independent_solver_solves():
    """The active-set solver on random programs: KKT conditions by the least multipliers, and OSQP;
    contradictions are reported."""
    independent = importlib.import_module("independent")
    random = np.random.default_rng(1)
    for _ in range(20):
        M, G = random.standard_normal((6, 6)), random.standard_normal((15, 6))
        H, f, h = M @ M.T + 0.1 * np.eye(6), 5 * random.standard_normal(6), random.random(15)
        z = independent.active_set(H, f, G, h)
        slack = h - G @ z
        assert slack.min() >= -1e-10
        active = G[slack < 1e-9]
        multipliers = np.linalg.lstsq(active.T, -(H @ z + f), rcond=None)[0]
        assert multipliers.min() >= -1e-8
        np.testing.assert_allclose(active.T @ multipliers, -(H @ z + f), atol=1e-8)
    two_sided = independent.Condensed(H, f, G, np.full(15, -np.inf), h, 0.0)
    np.testing.assert_allclose(independent.osqp(two_sided), z, atol=1e-7)
    row = np.eye(6)[:1]
    for contradiction in (np.vstack([row, -row]), np.zeros((2, 6))):
        with pytest.raises(ValueError, match="infeasible"):
            independent.active_set(H, f, contradiction, np.array([-1.0, -1.0]))


@pytest.mark.slow
def test_section_7_and_9_closed_loops():
    """50 steps to 1 rad: jaxmpc, CVXPY + OSQP and an active-set solver press the same torques."""
    table = run("java_ejml_ojalgo")
    np.testing.assert_allclose(table["ours"], table["inputs"], atol=1e-9)
    # 2 N m for five steps reach 2 rad/s; then that speed is kept.
    np.testing.assert_allclose(table["inputs"][:5], 2.0, atol=1e-9)
    np.testing.assert_allclose(table["states"][5:30, 1], 2.0, atol=1e-9)
    pytest.importorskip("cvxpy")
    table = run("python_cvxpy_osqp")
    np.testing.assert_allclose(table["inputs"], table["cvxpy"], atol=1e-6)


@pytest.mark.slow
def test_section_11_open_loop():
    table = run("mathematica")
    np.testing.assert_allclose(table["inputs"], table["stated"], atol=1e-7)
    np.testing.assert_allclose(table["cost"], table["stated_cost"], rtol=1e-9)


def test_problem_5_rows():
    limits = importlib.import_module("problem_5_joint_limits").run()
    G, g = np.asarray(limits.states.H), np.asarray(limits.states.h)
    # The lesson's [I; −I] S_q x ≤ (q_max, −q_min), for the two joints that have limits.
    S_q = np.eye(3, 6)[:2]
    np.testing.assert_array_equal(G[:4], np.vstack([S_q, -S_q]))
    np.testing.assert_array_equal(g[:4], [2.9, 1.2, 2.9, 1.8])
    assert limits.states.labels[3] == "elbow >= -1.8 rad"


@pytest.mark.long
def test_arm_dynamics_against_mujoco():
    """M, C dq + g of the two-link arm, and its linearisation by automatic differentiation."""
    mujoco = pytest.importorskip("mujoco")
    script = importlib.import_module("roboticstoolbox_arm")
    arm = script.Arm()
    body = """<body pos="{at} 0 0"><joint axis="0 0 1" damping="{D}"/>
        <inertial pos="{r} 0 0" mass="{m}" diaginertia="{I} {I} {I}"/>{inner}</body>"""
    links = [
        dict(zip("mrID", v, strict=True)) for v in zip(arm.m, arm.r, arm.I, arm.D, strict=True)
    ]
    inner = body.format(at=arm.l, inner="", **links[1])
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><compiler autolimits="true" boundmass="0" boundinertia="0"/>
        <option gravity="0 -{arm.gravity} 0"/>
        <worldbody>{body.format(at=0, inner=inner, **links[0])}</worldbody></mujoco>"""
    )
    data = mujoco.MjData(model)
    with jax.enable_x64(True):
        for q, dq, tau in np.random.default_rng(0).standard_normal((5, 3, 2)):
            data.qpos[:], data.qvel[:], data.qfrc_applied[:] = q, dq, tau
            mujoco.mj_forward(model, data)
            bias = arm.coriolis(q, dq) @ dq + arm.gravload(q)
            np.testing.assert_allclose(bias, data.qfrc_bias, atol=1e-12)
            np.testing.assert_allclose(arm.acceleration(q, dq, tau), data.qacc, rtol=1e-9)
        q = jnp.array([0.6, 0.9])
        np.testing.assert_allclose(arm.gravity_gradient(q), jax.jacfwd(arm.gravload)(q), atol=1e-12)
        # What one sampling period of the true arm does near rest, to first order.
        system = arm.linearised(q, 0.02, script.deviations(arm, q))
        plant = script.Plant(arm, q, 0.02, substeps=8)
        at_rest = jnp.zeros(4), jnp.zeros(2)
        np.testing.assert_allclose(plant.step(*at_rest), 0.0, atol=1e-15)
        A, B = jax.jit(jax.jacfwd(plant.step, argnums=(0, 1)))(*at_rest)
    np.testing.assert_allclose(system.A, A, atol=1e-9)
    np.testing.assert_allclose(system.B, B, atol=1e-9)
    assert system.state_labels == ("q1 [rad]", "q2 [rad]", "dq1 [rad/s]", "dq2 [rad/s]")


@pytest.mark.slow
def test_section_8_matrices_and_torques():
    table = run("cpp_eigen_osqp")
    assert max(table["matrices"]) <= 1e-12
    assert table["solve_qp"] <= 1e-8 and table["solve"] <= 1e-8


@pytest.mark.slow
def test_section_10_control_horizon():
    for row in run("matlab_mpc_toolbox", soft=True).values():
        assert row["objective"] <= 1e-8 and row["u"] <= 1e-6
        assert row["feasible_steps"] == 50
        assert np.abs(row["states"][:, 1]).max() <= 2 + 1e-9 < row["fastest"]


@pytest.mark.slow
def test_manipulator():
    table = run("roboticstoolbox_arm")
    linear, hard, soft = (
        table[name]
        for name in ("linear model, hard limits", "the arm, hard limits", "the arm, soft limits")
    )
    assert linear["feasible_steps"] == soft["feasible_steps"] == 80 > hard["feasible_steps"]
    assert linear["excess"] <= 1e-9 < 0.1 < soft["excess"] < 0.4
    for row in table.values():
        assert np.all(row["tau"] <= np.array([40.0, 12.0]) + 1e-9)
    assert soft["error"] <= 1e-3


@pytest.mark.slow
def test_problem_1_sensitivities():
    table = run("problem_1_multipliers")
    assert max(table.residuals.values()) <= 1e-9
    np.testing.assert_allclose(np.abs(table.multipliers), table.differences, rtol=1e-6)
    assert table.labels[0] == "tau upper at k = 0, per N m"
    assert table.labels[-1] == "dq upper at k = 20, per rad/s"


@pytest.mark.slow
def test_problem_2_index_sets(tmp_path):
    table = run("problem_2_feasible_set", picture=tmp_path / "sets.png")
    for rows in table.values():
        np.testing.assert_allclose(rows[:, 2], rows[:, 1], atol=1e-9)
        np.testing.assert_allclose(rows[:, 3], rows[:, 1], atol=1e-9)
        assert list(rows[-1, 4:]) == [0, 0], "wrong or undecided states"
    book = 1.0 + 0.15 * table["k = 0..N"][:, 0]
    np.testing.assert_allclose(table["k = N alone"][:, 1], book)
    assert np.all(table["k = 0..N"][:, 3] < book - 0.1)
    assert (tmp_path / "sets.png").stat().st_size > 10_000


@pytest.mark.slow
def test_problem_3_penalties():
    table = run("problem_3_soft")
    assert np.all(table["free"][:, 1] == 0) and np.all(table["free"][:, 2] <= 1e-9)
    rho, slack, change, _ = table["priced"].T
    below = rho < table["rho_bar"]
    assert np.all(slack[below] > 1e-4) and np.all(slack[~below] <= 1e-9)
    assert np.all(change[~below] <= 1e-9)
    assert table["square"][1] > 1e-4, "a quadratic penalty is never exact"


@pytest.mark.slow
def test_problem_4_decrease():
    table = run("problem_4_lyapunov")
    assert table["DARE identity"] <= 1e-13 and table["LQR loop"] <= 1e-13
    assert table["P of the DARE, O_inf, N = 20"] <= 1e-9
    assert table["terminal cost Q, N = 20 (section 7)"] > 1
    assert table["no terminal cost, N = 2"] > 1
