"""How far a QP's constraints are from the edge of feasibility, as a number with a derivative."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.checks import fail, require_shape
from jaxmpc.qp.admm import ADMM
from jaxmpc.qp.problem import QP
from jaxmpc.qp.solve import as_arrays, solve_qp

LINEAR = ADMM(iterations=100, newton_steps=60)


def feasibility_margin(
    qp: QP, scale: Any = None, max_margin: float = 1e3, solver: ADMM = LINEAR
) -> tuple[Array, Array]:
    """The largest t with l + t·scale ≤ Az ≤ u − t·scale for some z, and its status.

    t > 0: all hard rows can be kept with a distance of t·scale at once. t < 0: no z keeps them,
    and |t|·scale is the least uniform widening of the bounds that lets one. t = 0 is the boundary
    of the feasible set. An equality keeps t ≤ 0. The cost P, q and soft rows do not count; t
    stops at `max_margin`, which one-sided rows alone may never do.

    scale (m,) > 0: what a violation of 1 means in each row; None: 1, the row's own unit. t is
    the value of a linear program, concave in l and u and therefore, in MPC, in the initial
    state; differentiable (the gradient is one of its supergradients) whatever its sign. The
    status is that of the linear program: t is exact where it is SOLVED. One instance;
    `jax.vmap` for many. Raises ValueError for wrong shapes and for balls.
    """
    qp.validate()
    m, n = np.shape(qp.A)
    if qp.balls:
        fail("qp", "has balls", "The margin is that of rows; give a program without balls")
    if scale is not None:
        require_shape("scale", scale, (m,), "One for each row of A")
    qp = as_arrays(qp)
    dtype, bounds = qp.q.dtype, qp.bounds.hard()
    s = jnp.ones(m, dtype) if scale is None else jnp.asarray(scale, dtype)
    # Variables (z, t): Az + t s ≤ u, l ≤ Az − t s, t ≤ max_margin.
    last = jnp.zeros(n + 1, dtype).at[n].set(1.0)
    A = jnp.concatenate([jnp.block([[qp.A, s[:, None]], [qp.A, -s[:, None]]]), last[None]])
    none = jnp.full(m, jnp.inf, dtype)
    l = jnp.concatenate([-none, bounds.l, -jnp.full(1, jnp.inf, dtype)])
    u = jnp.concatenate([bounds.u, none, jnp.full(1, max_margin, dtype)])
    solution = solve_qp(QP(jnp.zeros((n + 1, n + 1), dtype), -last, A, l, u), solver)
    return -solution.cost, solution.status
