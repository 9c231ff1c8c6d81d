"""The float64 proofs against exact arithmetic, where one rounding decides."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from jax import enable_x64

import jaxmpc as jm
from jaxmpc.feasible import proofs
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.verify.exact import beyond, roll_out_exactly, roll_out_in_floats
from jaxmpc.verify.stored_problem import Constraints

RANDOM = np.random.default_rng(3)
N, n, m = 4, 3, 2
SYSTEM = jm.LinearSystem(
    RANDOM.normal(size=(n, n)), RANDOM.normal(size=(n, m)), c=0.1 * RANDOM.normal(size=n)
)
# Rows with rounding, and one that only picks a state, which has none.
ROWS = jm.Polytope(
    np.concatenate([RANDOM.normal(size=(3, n)), [[0.0, -1.0, 0.0]]]), np.full(4, 9.0)
)
TERMINAL = {
    "polytope": jm.Polytope(RANDOM.normal(size=(2, n)), np.full(2, 9.0)),
    "ellipsoid": jm.Ellipsoid(np.cov(RANDOM.normal(size=(n, 9))), 9.0),
}


def problem(terminal: str) -> jm.MPC:
    return jm.MPC(
        SYSTEM, np.eye(n), np.eye(m), N, states=ROWS, inputs=jm.Box([-1.0, -0.7], [0.9, 1.0]),
        terminal_set=TERMINAL[terminal], terminal_cost=np.eye(n),
    )  # fmt: skip


def exact(problem: FeasibilityProblem) -> tuple:
    """Return the data of the proofs and of the exact check, without limits from elsewhere."""
    p = problem.exact(np.full((2, n), [[-9.0], [9.0]]), np.ones(n))
    p = replace(
        p, move_lower=p.u_lower, move_upper=p.u_upper,
        left=np.ones((N, n)), side=np.zeros((N, n)), reach=np.zeros((N, n)),
    )  # fmt: skip
    return p, Constraints(problem.plain())


@pytest.mark.parametrize("terminal", TERMINAL)
@pytest.mark.first(1)
def test_plans_that_are_proved_keep_limits_to_the_last_bit(terminal):
    """Limits are put where the plan's rows lie, up to ± some roundings: what is proved is true, and
    what holds by the bound on rounding, with what rounding it leaves, is proved."""
    view = FeasibilityProblem.of(problem(terminal))
    p, q = exact(view)
    count = 400
    x, u = RANDOM.normal(size=(count, n)), RANDOM.uniform(-0.7, 0.9, (count, N, m))
    places = [(k, i) for k in range(N) for i in range(4)] + [(N, i) for i in range(len(p.H_N))]
    if p.P is not None:
        places.append((N, -1))
    with enable_x64(True):
        run = jax.jit(lambda p, x, u: proofs.prove_feasible(p, x, x[:0], u)[0])
        proved, margins, bounds = [], [], []
        for j in range(count):
            k, i = places[j % len(places)]
            state = x[j]
            for step in range(k):
                state = SYSTEM.A @ state + SYSTEM.B @ u[j, step] + SYSTEM.c
            ulps = 1 + RANDOM.integers(-50, 400) * 2.0**-53
            wide = lambda v: np.full_like(v, 1e6)
            upper, upper_N, level = wide(p.upper), wide(p.upper_N), 1e6
            lower, lower_N, below = -upper, -upper_N, j % 3 == 0
            if i == -1:
                level = (state @ p.P @ state) * ulps
            elif k < N:
                ends, value = (lower, 2 - ulps) if below else (upper, ulps)
                ends[k, i] = (p.H[i] @ state) * value
            else:
                ends, value = (lower_N, 2 - ulps) if below else (upper_N, ulps)
                ends[i] = (p.H_N[i] @ state) * value
            here = replace(
                p, lower=lower, upper=upper, lower_N=lower_N, upper_N=upper_N,
                level=None if p.P is None else np.float64(level),
            )  # fmt: skip
            proved.append(bool(run(here, x[j], u[j])))
            same = Constraints(view.plain())
            for name, rows, last in (("upper", upper, upper_N), ("lower", lower, lower_N)):
                box = getattr(q, name)
                parts = [np.append(b[:m], row) for b, row in zip(box, rows, strict=False)]
                setattr(same, name, [*parts, last if len(last) else box[N]])
            if p.P is not None:
                same.level = level
            margins.append(roll_out_exactly(same, x[j : j + 1], u[j : j + 1])[0])
            bounds.append(margins[-1] - roll_out_in_floats(same, x[j : j + 1], u[j : j + 1])[0])
    proved, margins, bounds = (np.array(v) for v in (proved, margins, bounds))
    assert 0.1 < proved.mean() < 0.9
    assert np.all(margins[proved] >= 0)
    # The bound on rounding is derived and written twice; constants differ by less than ten.
    rounded = np.array([places[j % len(places)][1] != 3 for j in range(count)])
    assert not np.any(proved[rounded & (margins < 0.1 * bounds)])
    assert np.all(proved[margins > bounds])


@pytest.mark.parametrize("terminal", TERMINAL)
@pytest.mark.first(1)
def test_half_spaces_exclude_only_what_is_infeasible_to_the_last_bit(terminal):
    """States on the half-space that multipliers imply, up to ± some roundings."""
    p, q = exact(FeasibilityProblem.of(problem(terminal)))
    box = np.asarray(p.move_lower), np.asarray(p.move_upper), np.zeros(0), np.zeros(0)
    excluded, excesses, sizes = [], [], []
    with enable_x64(True):
        run, excludes = jax.jit(proofs.cut), jax.jit(proofs.excludes)
        for size in (1.0, 1e-6, 1e5) * 20:
            y = size * np.maximum(RANDOM.normal(size=(N, 4)), 0.0)
            y_N = size * np.maximum(RANDOM.normal(size=len(p.H_N)), 0.0)
            ball = size * RANDOM.normal(size=n)
            a, b, w = map(np.asarray, run(p, y, y_N, ball))
            # a'θ = b + s w'|θ|: excluded from s = 1 on.
            s, direction = RANDOM.uniform(-1, 3, (40, 1)), RANDOM.normal(size=n)
            theta = direction * (b / (a @ direction - s * (w @ np.abs(direction))))
            s = np.where(theta @ direction > 0, s, -s)[:, 0]
            clear = np.abs(s - 1) > 0.1
            out, theta = np.asarray(excludes(a, b, w, theta))[clear], theta[clear]
            np.testing.assert_array_equal(out, s[clear] > 1)
            excluded.append(out)
            weights = [np.append(np.zeros(m), row) for row in y] + [y_N]
            if p.P is not None:
                weights.append(np.asarray(p.back) @ ball)
            excesses.append(beyond(q, weights, theta, box))
            sizes.append((np.abs(theta) @ w + 1e-13 * abs(b)) / np.abs(a).max())
    excluded, excesses, sizes = map(np.concatenate, (excluded, excesses, sizes))
    assert 0.05 < excluded.mean() < 0.95
    assert np.all(excesses[excluded] > 0)
    # The bound is a few roundings of its terms, no more.
    assert np.all(np.abs(excesses) < 10 * sizes)
