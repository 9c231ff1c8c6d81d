"""Programs of many sizes in one shape, compiled once for the tests of this folder: each shape of a
batch takes ten seconds."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

import jaxmpc as jm

VARIABLES, ROWS, COUNT = 8, 19, 32
INF = np.inf


@jax.jit
@partial(jax.vmap, in_axes=(0, None))
def solve(qp, eps):
    return jm.solve_qp(qp, jm.ADMM(eps=eps))


def padded(qp):
    """Return the program with variables that no row holds and rows that hold nothing; a linear one
    stays linear, and hard rows are those of infinite weight."""
    m, n = qp.A.shape
    P, A = np.eye(VARIABLES) * np.any(qp.P), np.zeros((ROWS, VARIABLES))
    P[:n, :n], A[:m, :n] = qp.P, qp.A
    q, free = np.append(qp.q, np.zeros(VARIABLES - n)), np.full(ROWS - m, INF)
    linear = np.full(m, INF) if qp.soft_linear is None else qp.soft_linear
    quadratic = np.zeros(m) if qp.soft_quadratic is None else qp.soft_quadratic
    weights = np.append(linear, free), np.append(quadratic, np.zeros(ROWS - m))
    return jm.QP(P, q, A, np.append(qp.l, -free), np.append(qp.u, free), *weights)


def solutions(qps, eps=1e-6, dtype=float):
    """Return the solutions of programs of one size without balls, in NumPy."""
    parts = []
    for first in range(0, len(qps), COUNT):
        some = [padded(qps[i % len(qps)]) for i in range(first, first + COUNT)]
        with jax.enable_x64(dtype != np.float32):
            batch = jax.tree.map(lambda *v: jnp.asarray(np.stack(v), dtype), *some)
            parts.append(solve(batch, np.dtype(dtype).type(eps)))
    found = jax.tree.map(lambda *v: np.concatenate(v)[: len(qps)], *parts)
    m, n = qps[0].A.shape
    of_variables = {name: getattr(found, name)[:, :n] for name in ("z", "ray")}
    of_rows = {name: getattr(found, name)[:, :m] for name in ("y", "certificate")}
    return replace(found, **of_variables, **of_rows)


def solution(qp, eps=1e-6):
    """Return the solution of one program."""
    return jax.tree.map(lambda v: v[0], solutions([qp], eps))
