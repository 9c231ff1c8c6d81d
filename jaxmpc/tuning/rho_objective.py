"""PenaltyObjective: how far ADMM's answers are from solved, as a function of its penalties.

ADMM with a fixed number of steps is a function of rho and alpha that can be differentiated; what
is minimised is a smooth count of the sampled states that it leaves unsolved,

    mean over states of softplus(2 (e + margin)) / 2,    e = log10 |residuals / tolerances|,

with the residuals by which the status is decided. A solved state counts almost nothing, another one
the number of digits that are missing. (Learning to optimise by unrolling: Gregor,
LeCun 2010; penalties of ADMM for QPs: Ichnowski et al. 2021, by reinforcement; Stellato et al.
2020, §5.2, adapt one number while iterating.) For every rho the fixed points of the
iteration are the solutions: a bad rho costs steps but cannot make a solution wrong.
"""

import functools
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.batches import Compiled, Devices, divisible, each_part, over_devices
from jaxmpc.mpc.condense import Condensed
from jaxmpc.pytrees import pytree
from jaxmpc.qp.admm import ADMM, ScaledProgram, factorise, iterate, read, splittings
from jaxmpc.qp.problem import QP
from jaxmpc.qp.residuals import residual_terms, with_fault
from jaxmpc.qp.solve import solve_factored, warm
from jaxmpc.qp.status import Status
from jaxmpc.tuning.batch_mean import BatchMean

# Digits by which the loss wants residuals below their tolerance.
MARGIN = 0.3


@pytree
class Samples:
    """States to solve from: x (B, p), and warm starts (z (B, nz), y (B, rows)) or None."""

    x: Any
    start: Any = None

    def __len__(self) -> int:
        return len(self.x)

    def take(self, where: Any) -> "Samples":
        """Return the samples at these places."""
        return jax.tree.map(lambda v: v[where], self)


@pytree
class PenaltyObjective:
    """The problem, references and iteration for which penalties are tuned.

    W: from `interpolation`. solver: its iterations, eps and smoothing are used.
    """

    condensed: Condensed
    W: Any
    reference: Any
    input_reference: Any
    solver: ADMM

    def qp(self, x: Array) -> QP:
        """Return the quadratic program at a state."""
        return self.condensed.qp(x, self.reference, self.input_reference)

    def digits(self, theta: Any, samples: Samples) -> Array:
        """Return e (B,): log10 of the norm of all residuals over their tolerances."""
        rho, alpha = jnp.exp(theta["log_rho"] @ self.W.T), 2 * jax.nn.sigmoid(theta["alpha"])
        solver, c = replace(self.solver, rho=rho, alpha=alpha), self.condensed
        made = factorise(c.P, c.C, solver, c.balls)
        eps = solver.eps

        def one(sample: Samples) -> Array:
            qp = self.qp(sample.x)
            p = ScaledProgram.of(qp, made)
            t = jnp.zeros_like(qp.l)
            if sample.start is not None:
                t = warm(p, sample.start)
            t, _ = iterate(splittings(made, p.q), p.bounds, t, solver.admm_steps(), solver.alpha)
            w, y = read(made, t, p.q, p.bounds)
            typical = p.typical_sizes(w, y)
            z, y = p.unscaled(w, y)
            floor = 100 * jnp.finfo(z.dtype).eps
            # A quarter of the rounding stays, for the sake of the logarithm's slope at 0.
            parts = zip(*residual_terms(qp, z, y, typical), strict=True)
            values, sizes, terms = map(jnp.concatenate, parts)
            allowed = eps * sizes + floor * (sizes + terms)
            squares = jnp.sum((values / jnp.where(allowed > 0, allowed, 1.0)) ** 2)
            return 0.5 * jnp.log10((floor / 4) ** 2 + squares)

        return jax.vmap(one)(samples)


@functools.cache
def loss_and_gradient(devices: Devices = None) -> BatchMean:
    """Return the program (θ, objective, samples, weights (B,)) → ((loss, gradient), {}): the
    weighted mean of the module's docstring."""

    def loss(theta: Any, objective: PenaltyObjective, samples: Samples, weights: Array) -> Array:
        e = objective.digits(theta, samples)
        return jnp.sum(weights * jax.nn.softplus(2 * (e + MARGIN)) / 2) / jnp.sum(weights)

    value_and_slope = jax.value_and_grad(loss)
    return BatchMean(lambda *args: (value_and_slope(*args), {}), devices, (False, False, True))


def solve_samples(
    rho: np.ndarray,
    alpha: Any,
    objective: PenaltyObjective,
    samples: Samples,
    chunk: int,
    devices: Devices = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return status and largest residual (B,) of the samples by the solver itself.

    rho (stages, rows). chunk: samples at once; one size, so that it compiles once.
    """
    solve = _solve_batches(devices)
    given = jnp.asarray(rho), jnp.asarray(alpha, float), objective

    def program(part: Samples) -> tuple[np.ndarray, np.ndarray]:
        return solve(*given, part)

    found = [part.result for part in each_part(program, samples, divisible(chunk, devices))]
    status, worst = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return status, worst


@functools.cache
def _solve_batches(devices: Devices) -> Compiled:
    return over_devices(_solve_batch, devices, (False, False, False, True))


def _solve_batch(
    rho: Array, alpha: Array, objective: PenaltyObjective, samples: Samples
) -> tuple[Array, Array]:
    """Return status and largest residual (B,) of a batch, in JAX."""
    c, solver = objective.condensed, replace(objective.solver, rho=rho, alpha=alpha)
    made = factorise(c.P, c.C, solver, c.balls)

    def one(sample: Samples) -> tuple[Array, Array]:
        s = with_fault(*solve_factored(objective.qp(sample.x), made, solver, sample.start))
        worst = jnp.maximum(jnp.maximum(s.primal_residual, s.dual_residual), jnp.abs(s.gap))
        return s.status, worst

    return jax.vmap(one)(samples)


def score(status: np.ndarray, worst: np.ndarray) -> dict[str, float]:
    """Return how well samples were solved, as `tune_solver` documents it.

    loss: the states that are not solved, plus a fraction of one that grows with the median
    residual from 1e-16 to 1e16: less is better. solved: fraction SOLVED. residual: median of the
    largest residuals; NaN counts as infinite.
    """
    median = float(np.median(np.nan_to_num(worst, nan=np.inf)))
    digits = float(np.log10(np.clip(median, 1e-16, 1e16)))
    return {
        "loss": float(np.sum(status != Status.SOLVED)) + (digits + 17) / 34,
        "solved": float(np.mean(status == Status.SOLVED)),
        "residual": median,
    }
