"""The two provers on their own, fed with what no solver would give."""

import itertools
from dataclasses import replace
from fractions import Fraction

import exact
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
from jax import enable_x64

import jaxmpc as jm
from jaxmpc.feasible import proofs
from jaxmpc.feasible.hard_constraints import exact_data, hard_blocks, make_view

EMPTY = replace(problems.lecture(), terminal_set=jm.Box(np.array([5.0, 5.0]), np.array([6.0, 6.0])))


def exact_form(mpc, extent):
    """The exact data of a problem whose states are no larger than `extent`."""
    return exact_data(mpc, make_view(mpc), hard_blocks(mpc), extent)


def prover(problem):
    """The prover of feasible states, compiled once: (x, inputs) → (proved, inputs)."""
    return jax.jit(lambda x, u: proofs.prove_feasible(problem, x, x[:0], u))


class TestProofs:
    """The two provers on their own, fed with what no solver would give."""

    def setup_method(self):
        self.mpc = problems.drifting()
        self.problem = exact_form(self.mpc, np.array([3.0, 3.0]))
        self.polygon = exact.feasible_polygon(self.mpc)

    def test_any_multipliers_give_a_valid_cut(self):
        rng = np.random.default_rng(0)
        scales = 10.0 ** rng.uniform(-12, 12, 300)
        with enable_x64(True):
            y = rng.standard_normal((300, 4, 5)) * scales[:, None, None]
            y_N = rng.standard_normal((300, 2)) * scales[:, None]
            y[:100] = np.maximum(y[:100], 0)
            cut = lambda a, b: proofs.cut(self.problem, a, b, jnp.zeros(0))
            everywhere = lambda a, b: proofs.everywhere(self.problem, *cut(a, b))
            normals, offsets = jax.jit(jax.vmap(everywhere))(y, y_N)
        finite = np.flatnonzero(np.isfinite(offsets))
        assert len(finite) > 100
        for i in finite:
            assert self.polygon.support(normals[i]) <= Fraction(float(offsets[i]))

    def test_zero_and_nan_multipliers_say_nothing(self):
        with enable_x64(True):
            cut = jax.jit(lambda y, y_N: proofs.cut(self.problem, y, y_N, jnp.zeros(0)))
            for fill in (0.0, np.nan, np.inf):
                y, y_N = np.full((4, 5), fill), np.full(2, fill)
                _, b, *_ = cut(y, y_N)
                assert b == np.inf

    @pytest.mark.slow
    def test_inputs_that_are_proved_keep_all_rows(self):
        """Random inputs, beyond their limits too, from random states."""
        rng = np.random.default_rng(1)
        x0s, plans = rng.uniform(-1.2, 1.2, (4000, 2)), rng.uniform(-0.6, 0.6, (4000, 4, 2))
        prove = jax.vmap(prover(self.problem))
        with enable_x64(True):
            proved, clipped = map(np.asarray, prove(x0s, plans))
        assert proved.sum() > 50
        for i in np.flatnonzero(proved):
            assert exact.keeps_all_rows(self.mpc, x0s[i], clipped[i])
        for i in np.flatnonzero(~proved)[:300]:
            assert not exact.keeps_all_rows(self.mpc, x0s[i], clipped[i])

    def test_nan_inputs_prove_nothing(self):
        with enable_x64(True):
            prove = prover(self.problem)
            for plan in (np.full((4, 2), np.nan), np.where(np.eye(4, 2), np.nan, 0.0)):
                proved, _ = prove(np.zeros(2), plan)
                assert not proved

    def test_margin_of_one_rounding(self):
        """Ties: x_N exactly on its limit in rationals must not be proved wrongly."""
        mpc = problems.scalar(a=1.0, horizon=3, x_max=None, u_max=0.1, terminal=0.3)
        prove = prover(exact_form(mpc, np.ones(1)))
        with enable_x64(True):
            for ulps in range(-40, 41, 4):
                x0 = np.array([0.6 + ulps * 2.0**-53])
                plan = np.full((3, 1), -0.1)
                proved, clipped = prove(x0, plan)
                if proved:
                    assert exact.keeps_all_rows(mpc, x0, clipped)

    @pytest.mark.long
    def test_sums_of_one_term_are_not_rounded(self):
        """A chain of integrators at rest on a limit stays there, exactly; what is proved is so in
        rationals, whichever states and inputs are zero."""
        n, N, rng = 3, 5, np.random.default_rng(0)
        chain, some = np.eye(n) + 0.1 * np.eye(n, k=1), 0
        for trial in range(12):
            A = chain if trial == 0 else rng.choice([0, 1, -1, 0.3, 1 + 2.0**-52], (n, n))
            B = np.eye(n)[:, -1:] * 0.1 if trial == 0 else rng.choice([0, 1, 0.7], (n, 1))
            sides = jm.Box(-np.ones(n), np.ones(n))
            mpc = jm.MPC(jm.LinearSystem(A, B), np.eye(n), 1, N, sides, jm.Box(-1, 1))
            states = rng.choice([0, 0, 1, -1, 0.3, 1 - 2.0**-53], (60, n))
            plans = rng.choice([0, 0, 0, -0.1, 0.3], (60, N, 1))
            with enable_x64(True):
                prove = jax.jit(jax.vmap(prover(exact_form(mpc, np.ones(n)))))
                proved, clipped = prove(states, plans)
            for x, u in zip(states[proved], np.asarray(clipped)[proved], strict=True):
                assert exact.keeps_all_rows(mpc, x, u)
            some += np.count_nonzero(np.abs(states[proved]).max(axis=1) == 1)
        assert some > 20

    def test_a_limit_that_is_exceeded_by_less_than_its_rounding(self):
        """s⁺ = a + d + b is 0.0 in floats where a = −b and d = 1e-22, and then r⁺ = r + s is 1 and
        1e-22 where r is at its limit of 1: no plan keeps that, and small errors are not lost."""
        A = np.diag([1.0, 1, 1, 0, 1, 0])
        A[3, :3] = A[4, 3] = 1.0
        sides = jm.Box(-np.ones(6), np.ones(6))
        system = jm.LinearSystem(A, np.eye(6)[:, -1:])
        mpc = jm.MPC(system, np.eye(6), 1, 3, sides, jm.Box(-1, 1))
        parts = np.array(list(itertools.permutations((1e-2, 1e-22, -1e-2))))
        states = np.hstack([parts, np.tile([0.0, 1.0, 0.0], (6, 1))])
        assert not any(exact.keeps_all_rows(mpc, x, np.zeros((3, 1))) for x in states)
        with enable_x64(True):
            prove = jax.vmap(prover(exact_form(mpc, np.ones(6))))
            proved, _ = prove(states, np.zeros((6, 3, 1)))
        assert not proved.any()

    def test_empty_set_cut(self):
        """0'θ ≤ b < 0 excludes every point, and only then may a normal be zero."""
        got = jm.map_feasible_set(EMPTY, np.zeros((1, 2)))
        assert got.label[0] == -1
