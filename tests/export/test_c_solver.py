"""The C code, compiled and called, beside the controller whose code it is."""

import ctypes
import shutil
import subprocess
from dataclasses import replace
from functools import partial

import jax
import numpy as np
import problems
import pytest

import jaxmpc as jm
from jaxmpc.closed_loop import Disturbance, KalmanFilter, OffsetFreeController, augmented
from jaxmpc.export import check_fixed_steps, choose_steps, export_c
from jaxmpc.export.c_solver import ClosedLoopCheck

CC, CXX = map(shutil.which, ("cc", "c++"))
AS_CPP = "-x c++ -std=c++11 -Wall -Wextra -Wpedantic -Werror -fsyntax-only".split()
compiled = pytest.mark.skipif(CC is None, reason="there is no C compiler")
STEPS = jm.ADMM(iterations=12, newton_steps=0)


def pendulum(**changes):
    """An unstable system with two inputs, small."""
    A, B = [[1.0, 0.2], [0.3, 1.05]], [[0.05, 0.1], [0.2, -0.1]]
    return replace(
        jm.MPC(
            system=jm.LinearSystem(A, B, c=[0.01, -0.02]), Q=np.eye(2), R=0.1 * np.eye(2),
            horizon=5, states=jm.Box([-1.0, -1.0], [1.0, 1.5]),
            inputs=jm.Box([-1.0, -2.0], [1.5, 1.0]), terminal_cost=3 * np.eye(2),
        ),
        **changes,
    )  # fmt: skip


def differing():
    """Dynamics, weights and limits are others at each step."""
    mpc, random = pendulum(), np.random.default_rng(0)
    each = lambda M, size: np.asarray(M) + size * random.uniform(-1, 1, (5, *np.shape(M)))
    system = jm.LinearSystem(each(mpc.system.A, 0.1), each(mpc.system.B, 0.05), mpc.system.c)
    Q = np.linspace(1, 3, 5)[:, None, None] * np.eye(2)
    inputs = jm.Box(mpc.inputs.lower, each(mpc.inputs.upper, 0.4))
    states = jm.Box(each(mpc.states.lower, 0.1), mpc.states.upper)
    same = {"prestabilise": False}  # as C code has it
    return replace(mpc, system=system, Q=Q, states=states, inputs=inputs, **same)


def robust(policy, **changes):
    """The pendulum, in deviations from where it stands, under disturbances of one state."""
    law = jm.LinearSystem(pendulum().system.A, pendulum().system.B)
    given = {"disturbance": jm.Box(-0.02, 0.03), "horizon": 3} | changes
    return pendulum(system=law, policy=policy, disturbance_matrix=[[1.0], [0.5]], **given)


CASES = {
    "hard": (lambda: problems.joint_o_inf(6), STEPS),
    "all": (
        lambda: replace(
            jm.mpc.soften(
                pendulum(input_rate_limit=0.4, input_rate_weight=0.3 * np.eye(2)), 5.0
            ),
            terminal_set=jm.Ellipsoid(np.array([[2.0, 0.3], [0.3, 1.0]]), 0.2),
        ),
        jm.ADMM(iterations=12, newton_steps=0, rho=[[0.3], [2.0]]),
    ),
    "prestabilised, drift": (pendulum, STEPS),
    "soft": (lambda: jm.mpc.soften(pendulum(), 5.0), STEPS),
    "ellipsoid": (
        lambda: pendulum(terminal_set=jm.Ellipsoid(np.array([[2.0, 0.3], [0.3, 1.0]]), 0.2)), STEPS,
    ),
    "rates": (
        lambda: pendulum(input_rate_limit=0.4, input_rate_weight=0.3 * np.eye(2)), STEPS,
    ),
    "moves": (lambda: pendulum(control_horizon=(1, 2, 2)), STEPS),
    "schedule": (pendulum, jm.ADMM(iterations=12, newton_steps=0, rho=[[0.3], [2.0]])),
    "steps that differ": (differing, STEPS),
    "no rows": (lambda: pendulum(states=None, inputs=None), STEPS),
}  # fmt: skip
# So few steps solve none of their plans.
POLICIES = {policy: (partial(robust, policy), STEPS) for policy in ("tube", "affine")}
POLICIES["affine, more"] = partial(
    robust, "affine", disturbance=jm.Box(-0.03, 0.03), input_rate_limit=0.4, control_horizon=(1, 2),
    soft=jm.Soft([[1.0, 0.5]], upper=[0.1], rho=2.0),
), STEPS  # fmt: skip


class Compiled:
    """The exported law as a shared library. `step` like a Controller's call."""

    def __init__(self, mpc, solver, folder, dtype="float64", name="law"):
        export_c(mpc, folder, solver, name=name, dtype=dtype)
        sizes = dict(
            line.split()[1:3] for line in (folder / f"{name}_sizes.h").read_text().splitlines()
            if line.startswith("#define")
        )  # fmt: skip
        self.m, self.dtype = int(sizes[f"{name}_INPUTS"]), np.dtype(dtype)
        held = [int(sizes[f"{name}_{what}"]) for what in ("VARIABLES", "ROWS", "PARAMETERS")]
        self.last = sum(held) + 1  # where memory.u begins
        strict = "-std=c99 -O2 -Wall -Wextra -Wpedantic -Werror -shared -fPIC".split()
        library = folder / f"{name}.so"
        subprocess.run([CC, *strict, folder / f"{name}.c", "-lm", "-o", library], check=True)
        if CXX is not None:
            subprocess.run([CXX, *AS_CPP, folder / f"{name}.c"], check=True)
        self.call = getattr(ctypes.CDLL(str(library)), f"{name}_step")
        self.memory = np.zeros(10_000)  # as NAME_reset leaves it

    def step(self, x, reference=None, input_reference=None):
        given = [
            None if v is None else np.ascontiguousarray(v, self.dtype)
            for v in (x, reference, input_reference)
        ]
        u = np.zeros(self.m, self.dtype)
        at = lambda v: None if v is None else v.ctypes.data_as(ctypes.c_void_p)
        status = self.call(at(self.memory), *map(at, given), at(u), None)
        return u, status


def test_few_programs_are_compiled(tmp_path, request):
    """A factorization and two of tables; they were a hundred small ones."""
    programs = request.getfixturevalue("compiled")
    programs.clear()
    export_c(problems.joint_o_inf(6), tmp_path, STEPS)
    assert 0 < len(programs) <= 6


@pytest.mark.long
@compiled
@pytest.mark.parametrize(
    "case",
    [c if c == "all" else pytest.param(c, marks=pytest.mark.slow) for c in (*CASES, *POLICIES)],
)
def test_closed_loop_is_the_controllers(case, tmp_path):
    """Loops whose inputs are seldom at their limits, with references and without, and one that
    begins beyond the limits."""
    make, solver = (CASES | POLICIES)[case]
    mpc = make()
    with jax.enable_x64(True):
        code, law = Compiled(mpc, solver, tmp_path), jm.Controller(mpc, solver)
        system = law.mpc.system
        A, B = (np.asarray(v)[0] if v.ndim == 3 else np.asarray(v) for v in (system.A, system.B))
        loops = (0.1, None, None), (0.2, 0.1, 0.05), (-0.1, -0.2, -0.1), (1.2, 0.3, 0.1)
        for start, reference, effort in loops:
            x = np.full(system.n, start)
            control = None  # cold, as the code after a reset: not from a plan of zeros
            code.memory[:] = 0
            target = None if reference is None else np.full(system.n, reference)
            input_target = None if effort is None else np.full(system.m, effort)
            # The controller's None is zero, and then one program serves both loops.
            aim = [np.zeros(k) if v is None else v
                   for v, k in ((target, system.n), (input_target, system.m))]  # fmt: skip
            for _ in range(6):
                control = law(x, control, aim[0], input_reference=aim[1])
                mine, _ = code.step(x, target, input_target)
                np.testing.assert_allclose(mine, control.u, rtol=0, atol=1e-9)
                x = A @ x + B @ mine
                x = x if system.c is None else x + np.asarray(system.c)


@compiled
def test_status_is_true_and_bad_states_are_answered(tmp_path):
    mpc = problems.joint_o_inf(6)
    code = Compiled(mpc, jm.ADMM(iterations=300, newton_steps=0), tmp_path)
    best = problems.least_distance(mpc, np.array([0.2, -0.1]))  # by non-negative least squares
    u, status = code.step([0.2, -0.1])
    np.testing.assert_allclose(u, best[0], atol=1e-5)
    assert status == 1
    assert code.step([1.5, 2.0])[1] == 2  # beyond the limits of x_0
    for bad in (np.nan, np.inf):
        u, status = code.step([bad, 0.0])
        assert status == 3 and u == 0
    assert code.step([0.2, -0.1])[1] == 1  # from a cold start again


@compiled
@pytest.mark.long
def test_rates_count_from_a_last_input_beyond_the_limits(tmp_path):
    """With inputs of at most 1 and rates of 0.3 the next is 0.9 after 1.2, and none after 1.6."""
    system = jm.LinearSystem([[1, 0.1], [0, 1]], [[0.005], [0.1]])
    mpc = jm.MPC(system, [10.0, 1], [0.1], 5, inputs=jm.Box([-1.0], [1.0]), input_rate_limit=[0.3])
    code, law = Compiled(mpc, jm.ADMM(500, newton_steps=0), tmp_path), jm.Controller(mpc)
    for last, expected in ((1.0, 0.7), (1.2, 0.9), (1.6, None)):
        code.memory[:] = 0
        code.memory[code.last] = last
        u, status = code.step([0.5, 0.0])
        plan = law(np.array([0.5, 0.0]), previous_input=np.array([last])).plan
        assert (status == 1) == bool(plan.solved) == (expected is not None)
        assert expected is None or u == pytest.approx([expected], abs=1e-6)


@compiled
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_soft_rows_that_inputs_move_by_rounding(dtype, tmp_path):
    """0.1 + 0.2 − 0.3 in B is 5.6e-17 and moves x₁ by nothing, so that the plan is that without."""
    inputs = []
    for k, moved in enumerate((0.0, 0.1 + 0.2 - 0.3)):
        mpc = jm.MPC(
            jm.LinearSystem(np.diag([0.9, 1.0]), [[moved], [1.0]]), [1.0, 1.0], 0.1, 3,
            inputs=jm.Box(-0.5, 0.5), terminal_cost=[1.0, 1.0],
            soft=jm.Soft([[1.0, 0.0]], upper=[0.6], rho=3.0),
        )  # fmt: skip
        solver = jm.ADMM(iterations=300, newton_steps=0)
        u, status = Compiled(mpc, solver, tmp_path / str(k), dtype).step([1.0, 0.3])
        assert status == 1
        inputs.append(u)
    np.testing.assert_allclose(*inputs, rtol=1e-6)


def in_units(x, u, cost):
    """The pendulum in other units of its states (2,) and inputs (2,), and of its cost."""
    mpc = pendulum(horizon=3)
    system = jm.LinearSystem(
        x[:, None] * mpc.system.A / x, x[:, None] * mpc.system.B / u, x * mpc.system.c
    )
    return replace(
        mpc, system=system, Q=cost * mpc.Q / x / x[:, None], R=cost * 0.1 * np.diag(1 / u**2),
        states=jm.Box(x * mpc.states.lower, x * mpc.states.upper),
        inputs=jm.Box(u * mpc.inputs.lower, u * mpc.inputs.upper),
        terminal_cost=cost * mpc.terminal_cost / x / x[:, None],
    )  # fmt: skip


@pytest.mark.long
@compiled
@pytest.mark.parametrize("iterations", [12, 200])
def test_a_status_in_other_units(iterations, tmp_path):
    """Of micrometres, millions of newtons and small costs: the same, and what is SOLVED is, also
    at rest."""
    one = np.ones(2)
    random = np.random.default_rng(0)
    states = [np.zeros(2), *random.uniform(-0.6, 0.6, (30, 2)), [0.9, 1.4]]
    units = [
        (one, one, 1.0),
        (2.0**-20 * one, 2.0**20 * one, 1.0),
        (2.0 ** np.array([-30, 30]), one, 1.0),
        (2.0**20 * one, 2.0**-20 * one, 2.0**-40),
    ]
    found = []
    for i, (x, u, cost) in enumerate(units):
        mpc, solver = in_units(x, u, cost), jm.ADMM(iterations=iterations, newton_steps=0)
        code = Compiled(mpc, solver, tmp_path, name=f"law{i}")
        answers = []
        for x0 in states:
            code.memory[:] = 0
            answer, status = code.step(x * x0)
            answers.append([*(answer / u), status])
        found.append(answers)
    best = [jm.solve(in_units(one, one, 1.0), x0) for x0 in states]
    solved = np.array(found)[:, :, 2] == 1
    assert np.all(solved == solved[0]) and not np.any(solved[:, -1])
    assert 0 < solved[0].sum() < 10 if iterations == 12 else solved[0].sum() > 25
    for answers in found:
        for (*u, status), plan in zip(answers, best, strict=True):
            if status == 1:
                assert plan.status == jm.Status.SOLVED
                np.testing.assert_allclose(u, plan.inputs[0], atol=1e-4)


@pytest.mark.long
@pytest.mark.parametrize("policy", ["affine", "tube"])
def test_some_hundred_steps_solve_plans_under_policies(policy, tmp_path):
    """From cold, at random states; the section of the tube has 124 generators, of 0.1 to 4e-13."""
    mpc = robust(policy)
    code = Compiled(mpc, jm.ADMM(iterations=480, alpha=1.6, newton_steps=0), tmp_path)
    x0s = np.random.default_rng(0).uniform([-1.0, -1.0], [1.0, 1.5], (100, 2))
    with jax.enable_x64(True):
        controller = jm.Controller(mpc)
        best = jax.jit(jax.vmap(controller.plan))(x0s)
    found = [code.step(x0) for x0 in x0s]
    possible, solved = np.array(best.solved), np.array([status == 1 for _, status in found])
    assert possible.sum() > 90 and not np.any(solved & ~possible)
    assert np.sum(possible & ~solved) <= 5
    errors = np.array([u for u, _ in found]) - np.asarray(best.inputs[:, 0])
    np.testing.assert_allclose(errors[solved], 0, atol=1e-5)
    assert code.step([2.0, 0.0])[1] == 2  # beyond the limits of x_0


@compiled
def test_float(tmp_path):
    mpc, solver = problems.joint_o_inf(6), jm.ADMM(iterations=300, newton_steps=0)
    code = Compiled(mpc, solver, tmp_path, dtype="float32")
    best = problems.least_distance(mpc, np.array([0.2, -0.1]))  # by non-negative least squares
    np.testing.assert_allclose(code.step([0.2, -0.1])[0], best[0], atol=1e-3)


def test_bad_arguments(tmp_path):
    mpc = pendulum()
    for changes, message in (
        (dict(name="1st"), "name: '1st'"),
        (dict(dtype="float16"), "dtype: 'float16'"),
        (dict(tolerance=-1.0), "tolerance: "),
        (dict(tolerance=0), "tolerance: "),
        (dict(solver="fast"), "solver: "),
    ):
        with pytest.raises(ValueError, match=message):
            export_c(mpc, tmp_path, **changes)
    assert not list(tmp_path.iterdir())
    (tmp_path / "mpc.c").touch()
    with pytest.raises(ValueError, match="mpc.c: exists"):
        export_c(mpc, tmp_path)


CHECKED = jm.MPC(
    system=jm.LinearSystem([[1, 0.1], [0, 1]], [[0.005], [0.1]]), Q=np.eye(2), R=[[0.1]],
    horizon=3, states=jm.Box([-1, -2], [1, 2]), inputs=jm.Box([-2], [2]),
)  # fmt: skip


@pytest.mark.slow
def test_closed_loop_check():
    """Lists as numbers; enough steps solve every plan, one step few."""
    check = lambda steps: check_fixed_steps(
        CHECKED, jm.ADMM(iterations=steps), [-0.5, -0.5], [0.5, 0.5], plans=40, tolerance=1e-4
    )
    many, one = check(200), check(1)
    assert many.plans == many.solvable == many.reached == 40 and many.input_error < 1e-3
    assert one.reached < 40


@pytest.mark.slow
def test_closed_loops_to_a_set_point_are_those_of_deviations():
    """A rest position p = 3: limits and starts about it, and the same about the origin."""
    about = np.array([3.0, 0.0])
    there = replace(CHECKED, states=jm.Box([2, -2], [4, 2]))
    lower, upper, solver = np.array([-0.9, -0.9]), np.array([0.9, 0.9]), jm.ADMM(iterations=30)
    own = check_fixed_steps(CHECKED, solver, lower, upper, 100)
    found = check_fixed_steps(
        there, solver, lower + about, upper + about, 100, reference=about, input_reference=[0.0]
    )
    assert 0 < own.reached <= own.solvable <= 100
    assert (found.solvable, found.reached) == (own.solvable, own.reached)
    np.testing.assert_allclose(found.input_error, own.input_error, rtol=1e-4)
    chosen = [
        choose_steps(mpc, lower + x, upper + x, iterations=30, plans=100, reference=x)
        for mpc, x in ((CHECKED, 0 * about), (there, about))
    ]
    np.testing.assert_array_equal(chosen[0].rho, chosen[1].rho)


@pytest.mark.parametrize(
    "changes, message",
    [
        (dict(lower=[0.0]), "lower: "),
        (dict(upper=[np.inf, 1.0]), "upper: "),
        (dict(plans=0), "plans: "),
        (dict(reference=[1.0]), "reference: shape"),
        (dict(input_reference=[np.nan]), "input_reference: "),
        (dict(mpc=3), "mpc: "),
    ],
)
def test_closed_loop_check_names_bad_arguments(changes, message):
    given = dict(mpc=CHECKED, solver=jm.ADMM(), lower=[-1.0, -1.0], upper=[1.0, 1.0]) | changes
    with pytest.raises(ValueError, match=message):
        check_fixed_steps(**given)


@compiled
@pytest.mark.slow
def test_an_offset_free_loop(tmp_path):
    """The code of the augmented problem, the filter's two lines in NumPy, another plant: no error;
    one limit is active on the way."""
    A, B, C = np.array([[0.9, 0.1], [0.0, 0.8]]), np.array([[0.0], [0.5]]), np.array([[1.0, 0.0]])
    mpc = jm.MPC(jm.LinearSystem(A, B), np.diag([5.0, 0.1]), [[0.1]], 10, inputs=jm.Box([-1], [1]))
    load = Disturbance("input", 0.1)
    filter_ = KalmanFilter(mpc.system, 0.1, 0.1, C=C, disturbance=load)
    with jax.enable_x64(True):
        free = OffsetFreeController(jm.Controller(mpc), filter_)
        more = augmented(mpc, filter_)
        code = Compiled(more, jm.ADMM(iterations=200, newton_steps=0), tmp_path)
        L, A_d, B_d = np.asarray(free.observer.gain), more.system.A, more.system.B
        x, z, inputs = np.zeros(2), np.zeros(3), []
        for _ in range(120):
            z = z + L @ (C @ x - z[:1])
            target = free.target(np.array([1.0, 0.0]), z[2:])
            u, status = code.step(z, np.append(target.x, 0.0), target.u)
            inputs.append(u)
            assert status == 1
            x = np.array([[0.85, 0.12], [0.02, 0.83]]) @ x + np.array([0.01, 0.4]) * u + 0.02
            z = A_d @ z + B_d @ u
    assert np.max(inputs) == 1 and abs(x[0] - 1) < 1e-6


@pytest.mark.slow
def test_chosen_steps_solve_most_plans(capsys):
    """On closed loops other than those of the search; a penalty for each kind of row."""
    mpc = CHECKED
    box = [-1.0, -1.0], [1.0, 1.0]
    solver = choose_steps(mpc, *box, plans=400)
    found = check_fixed_steps(mpc, solver, *box, 400, seed=7)
    assert found.solvable > 300 and found.reached >= 0.985 * found.solvable
    assert len(set(np.asarray(solver.rho).tolist())) <= len(jm.Controller(mpc).condensed.layout)
    assert capsys.readouterr().err == ""
    few = choose_steps(mpc, *box, iterations=25, plans=400, progress=True)
    assert few.iterations == 25
    begun, solved = capsys.readouterr().err.splitlines()
    assert begun.endswith(" s  25 iterations") and "25 iterations solve " in solved
    given = check_fixed_steps(mpc, jm.ADMM(iterations=25), *box, 400, seed=7)
    assert check_fixed_steps(mpc, few, *box, 400, seed=7).reached >= given.reached


def test_a_search_that_does_not_reach_its_share_says_so(monkeypatch):
    """With steps that solve 74 of 100 plans, whatever their number and penalties."""
    place = "jaxmpc.export.step_search"
    found = ClosedLoopCheck(100, 100, 74, 0.1, 0.1)
    monkeypatch.setattr(f"{place}.starting_states", lambda *_: np.zeros((1, 2)))
    monkeypatch.setattr(f"{place}._improved", lambda *given: (given[-2], 0.74))
    monkeypatch.setattr(f"{place}.check_fixed_steps", lambda *_, **__: found)
    with pytest.warns(UserWarning, match="choose_steps: 1,920 iterations solve 74 of 100 plans"):
        solver = choose_steps(CHECKED, [-0.9, -0.9], [0.9, 0.9])
    assert solver.iterations == 1920


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"share": -1.0}, "share: -1.0"),
        ({"iterations": 0}, "iterations: 0"),
        ({"lower": [0.0]}, "lower: shape"),
        ({"plans": 0}, "plans: 0"),
    ],
)
def test_bad_arguments_of_the_search(given, message):
    arguments = {"lower": [-1.0, -1], "upper": [1.0, 1]} | given
    with pytest.raises(ValueError, match=message):
        choose_steps(CHECKED, **arguments)
