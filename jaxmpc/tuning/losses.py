"""ClosedLoopLoss: the cost of a closed loop, as a differentiable number; several losses at once."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.arrays import as_array
from jaxmpc.checks import (
    concrete,
    fail,
    number,
    positive,
    require_finite,
    require_kind,
    require_real,
    require_shape,
    require_symmetric_psd,
)
from jaxmpc.closed_loop.orientations import error_of
from jaxmpc.closed_loop.simulation import Run
from jaxmpc.pytrees import record
from jaxmpc.qp.linalg import matmul
from jaxmpc.sets.convex_sets import Box, Polytope
from jaxmpc.sets.limits import row_violations, rows_kept

# Names of the terms, in the order in which they are told.
TERMS = ("tracking", "effort", "violation", "settling")
# Before the name of each of several losses, among the numbers of a run.
TERM = "loss "


def _counts(weight: Any) -> bool:
    """Return whether a weight is not known to be 0."""
    return not concrete(weight) or bool(weight)


@record
class ClosedLoopLoss:
    """Loss of one closed loop: tracking, effort, violations and time to settle,

        (1/T) Σ_{t<T} [ e_t'Q e_t + v_t'R v_t ] + violation·(1/T) Σ_{t≤T} Σ_i excess_i(x_t)
        + settling·(time to settle),    e_t = x_t − r_t,  v_t = u_t − s_t.

    Q (n, n), R (m, m): or their diagonals, or a number for one state or input. Weights of the loss,
    not the controller's own, which `Run.stage_cost` uses: tuning would drive those to zero.
    reference: r (n,), or at least T rows; None for zero.
    input_reference: s (m,), or at least T rows; None for zero.
    limits: Box or Polytope of x; excess_i is by how much row i is violated, in its unit, of a Box
    as a fraction of its half-width (1 where that is 0 or infinite).
    violation: weight ≥ 0 of the excess, an exact penalty: with a large enough weight limits are
    kept wherever they can be. settling: weight ≥ 0 of the time to settle.
    band (n,): the size of what counts as settled, needed where settling > 0.
    softness: of the count of samples, > 0.
    plant: a robot whose `coordinates` turn its states into x; None: x is the state itself.

    Time to settle, in samples: the number of t after which the loop is still once outside the band
    |e_i| ≤ band_i. With d_t = max_i |e_i|/band_i it counts Σ_t (1 − Π_{s≥t} σ((1 − d_s)/softness)),
    which tends to that number as softness → 0 (σ the logistic function).
    """

    Q: Any
    R: Any
    reference: Any = None
    input_reference: Any = None
    limits: Box | Polytope | None = None
    violation: float = 10.0
    settling: float = 0.0
    band: Any = None
    softness: float = 0.1
    plant: Any = None

    def __post_init__(self) -> None:
        for name in ("Q", "R"):
            W = as_array(getattr(self, name))
            W = W if isinstance(W, jax.core.Tracer) else np.asarray(W, np.float64)
            W = (np if isinstance(W, np.ndarray) else jnp).diag(W.reshape(-1)) if W.ndim < 2 else W
            if W.ndim != 2 or W.shape[0] != W.shape[1]:
                fail(name, f"shape {W.shape}", "Give a square matrix, its diagonal or a number")
            require_symmetric_psd(name, W)
            object.__setattr__(self, name, W)
        for name in ("violation", "settling"):
            number(name, getattr(self, name), 0, "Give a weight ≥ 0")
            require_finite(name, getattr(self, name))
        if self.limits is not None:
            require_kind("limits", self.limits, Box, Polytope)
        if _counts(self.settling) and self.band is None:
            fail("band", "is None", "Give the size (n,) of what counts as settled")
        if self.band is not None:
            require_real("band", self.band)
            if concrete(self.band) and not np.all(np.asarray(self.band) > 0):
                fail("band", f"{self.band}", "Give positive numbers")
            if np.ndim(self.band) > 1:
                fail("band", f"shape {np.shape(self.band)}", "Give (n,), one number for each state")
        positive("softness", self.softness)

    def __call__(self, run: Run) -> Array:
        """Return the loss of one run."""
        terms = self.terms(run)
        return sum(terms.values(), jnp.zeros((), run.inputs.dtype))

    def terms(self, run: Run) -> dict[str, Array]:
        """Return what the loss of one run is the sum of: tracking, effort, and violation and
        settling where these have a weight."""
        if run.inputs.ndim != 2:
            what = f"has inputs of shape {run.inputs.shape}"
            fail("run", what, "Give one loop; jax.vmap(loss)(runs) is that of many")
        (T, m), dtype = run.inputs.shape, run.inputs.dtype
        x = self._coordinates(run)
        n = x.shape[1]
        require_shape("loss.Q", self.Q, (n, n), "One weight for each state")
        require_shape("loss.R", self.R, (m, m), "One weight for each input")
        if self.band is not None and (n > 1 or np.ndim(self.band)):
            require_shape("loss.band", self.band, (n,), "One number for each state")
        if self.limits is not None:
            self.limits.validate("loss.limits", n)
        r, s = self._aim("reference", T, n), self._aim("input_reference", T, m)
        if r.ndim == 2:
            r = jnp.concatenate([r, r[-1:]])[: T + 1]
        r = jnp.broadcast_to(r, x.shape)
        e = jax.vmap(partial(error_of, self.plant, self.limits))(x, r)
        v = run.inputs - (s[:T] if s.ndim == 2 else s)
        square = lambda v, W: jnp.sum(v * matmul(v, jnp.asarray(W, dtype)))
        terms = {"tracking": square(e[:-1], self.Q) / T, "effort": square(v, self.R) / T}
        if self.limits is not None and _counts(self.violation):
            terms["violation"] = self.violation * jnp.sum(self.excess(x)) / T
        if _counts(self.settling):
            d = jnp.max(jnp.abs(e[1:]) / jnp.asarray(self.band, dtype), axis=1)
            inside = jax.nn.log_sigmoid((1 - d) / self.softness)
            stays = jnp.exp(jnp.cumsum(inside[::-1])[::-1])
            terms["settling"] = self.settling * jnp.sum(1 - stays)
        return terms

    def excess(self, x: Array) -> Array:
        """Return by how much the states x (T+1, n) violate each row of the limits, (T+1, rows)."""
        limits = jax.tree.map(lambda v: jnp.asarray(v, x.dtype), self.limits)
        units = limits.half_widths() if isinstance(limits, Box) else 1.0
        return row_violations(limits, x) / units

    def kept(self, run: Run) -> Array:
        """Return whether a run keeps the limits."""
        x = self._coordinates(run)
        limits = jax.tree.map(lambda v: jnp.asarray(v, x.dtype), self.limits)
        return jnp.all(rows_kept(limits, x))

    def _coordinates(self, run: Run) -> Array:
        """Return the states in the coordinates of the problem, (T+1, n)."""
        return run.states if self.plant is None else jax.vmap(self.plant.coordinates)(run.states)

    def _aim(self, name: str, samples: int, size: int) -> Array:
        """Return a reference, (size,) or at least so many rows of it."""
        reference = getattr(self, name)
        if reference is None:
            return jnp.zeros(size)
        require_real(f"loss.{name}", reference)
        reference = jnp.asarray(reference)
        shape = reference.shape
        if reference.ndim == 2 and shape[1] == size and shape[0] >= samples:
            return reference
        if shape != (size,) and (shape or size > 1):
            cure = f"Give ({size},), or a row for each of the {samples} samples"
            fail(f"loss.{name}", f"shape {shape}", cure)
        return reference


@record
class SeveralLosses:
    """Several losses of one run, by name, as a function of it with L numbers."""

    functions: Mapping[str, Callable[[Run], Any]]

    def __call__(self, run: Run) -> Array:
        """Return the losses (L,) of one run."""
        found = {name: jnp.asarray(function(run)) for name, function in self.functions.items()}
        for name, value in found.items():
            if value.shape != ():
                fail(f"losses[{name!r}]", f"has shape {value.shape}", "Return one number")
        return jnp.stack(list(found.values()))
