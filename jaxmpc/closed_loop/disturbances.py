"""Sequences of disturbances for closed loops: at random, at vertices, and the worst by gradient."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.arrays import Reals, host_array
from jaxmpc.checks import fail, generator, require_finite, require_kind, whole
from jaxmpc.closed_loop.simulation import initial_states, require_controller, simulate
from jaxmpc.mpc.problem import MPC
from jaxmpc.sets.disturbances import disturbance_columns

KINDS = ("vertices", "inside")


def draw_disturbances(
    mpc: MPC, steps: int, count: int, *, kind: str = "vertices", seed: int = 0
) -> np.ndarray:
    """Return sequences (count, steps, n) of E w with w in the disturbances of `mpc`, as `simulate`
    takes each of them.

    kind: "vertices" picks one vertex a step; "inside" a random combination of them. Raises
    ValueError for a problem without disturbances.
    """
    W, E = _disturbances(mpc)
    steps, count = whole("steps", steps, 1), whole("count", count, 1)
    if kind not in KINDS:
        fail("kind", f"{kind!r}", f"Give one of {', '.join(map(repr, KINDS))}")
    rng, corners = generator(seed), W.vertices()
    if kind == "vertices":
        return corners[rng.integers(len(corners), size=(count, steps))] @ E.T
    weights = rng.dirichlet(np.ones(len(corners)), (count, steps))
    return weights @ corners @ E.T


def worst_disturbance(
    controller: Any, x0: Reals, steps: int, *, rounds: int = 10, plant: Any = None, seed: int = 0
) -> tuple[np.ndarray, float]:
    """Return a sequence (steps, n) of E w that brings a closed loop far beyond its state limits,
    and how far: the violation in their units, negative by the distance that is left. Of many
    initial states (B, n) a sequence each (B, steps, n), and the largest violation.

    Ascent by gradient: the violation of the simulated loop is differentiated with respect to the
    sequence, and each w moves to the vertex that raises it most, as long as that helps. A local
    search: it finds violations, and proves nothing where there are none.

    controller: of a robust problem with state limits. x0: (n,) or (B, n). plant: None for its
    own model. rounds: at most. A loop that overflows has a violation of NaN.
    """
    require_controller(controller)
    mpc = controller.mpc
    W, E = _disturbances(mpc)
    if controller.limits is None:
        fail("controller", "has no state limits to exceed", "Give states to its problem")
    steps, rounds = whole("steps", steps, 1), whole("rounds", rounds, 1)
    rng, x0 = generator(seed), host_array("x0", x0)
    require_finite("x0", x0)
    starts = initial_states(controller, np.atleast_2d(x0), "x0")
    corners = W.vertices() @ E.T
    plant = mpc.system if plant is None else plant
    cast = lambda tree: jax.tree.map(lambda v: jnp.asarray(v, controller.dtype), tree)
    limits = cast(controller.limits)

    def beyond(w: Array, x0: Array) -> Array:
        run = simulate(controller, plant, x0, steps, disturbance=w)
        return jnp.max(jax.vmap(lambda x: _signed(limits, x))(run.states[1:]))

    rise = jax.jit(jax.vmap(jax.value_and_grad(beyond)))
    w = corners[rng.integers(len(corners), size=(len(starts), steps))]
    best, top = w, np.full(len(starts), -np.inf)
    for _ in range(rounds):
        value, slope = (np.asarray(v, float) for v in rise(*cast((w, starts))))
        better = ~(value <= top) & ~np.isnan(top)
        if not better.any():
            break
        best, top = np.where(better[:, None, None], w, best), np.maximum(top, value)
        w = corners[np.argmax(slope @ corners.T, axis=2)]
    return (best[0] if x0.ndim == 1 else best), float(top.max())


def _signed(limits: Any, x: Array) -> Array:
    """Return by how much x exceeds the row that it exceeds most, negative inside."""
    H, lower, upper = limits.rows()
    value = jnp.matmul(H, x, precision="highest")
    return jnp.max(jnp.maximum(value - upper, lower - value))


def _disturbances(mpc: MPC) -> tuple[Any, np.ndarray]:
    """Return W and E of a robust problem."""
    require_kind("mpc", mpc, MPC)
    if mpc.disturbance is None:
        fail("mpc", "has no disturbance", "Give MPC(disturbance=jm.Box(…))")
    return mpc.disturbance, disturbance_columns(mpc.disturbance_matrix, mpc.system.n)
