"""Instances of a batch whose data are no numbers: they change no derivative of what it shares."""

from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmpc as jm

SYSTEM = jm.LinearSystem([[1.0, 0.3], [0.1, 1.0]], [[0.1], [0.3]])
START = np.array([0.8, 0.1])
NOMINAL = jm.MPC(
    SYSTEM, np.eye(2), 0.1 * np.eye(1), 3,
    states=jm.Polytope(np.vstack([np.eye(2), -np.eye(2)]), [2.0] * 4),
    inputs=jm.Box([-1.5], [1.5]), terminal_cost=np.eye(2),
    outputs=jm.Outputs([[1.0, 1.0]], [-4.0], [4.0], D=[[0.5]]),
    input_rate_weight=0.1 * np.eye(1),
)  # fmt: skip
SOFT = jm.Soft([[1.0, 0.0]], upper=[0.7], D=[[0.1]])
DENSE = replace(NOMINAL, terminal_set=jm.Ellipsoid(np.eye(2), 1.5), soft=SOFT)


@partial(jax.tree_util.register_dataclass, data_fields=["stiffness"], meta_fields=[])
@dataclass
class Pendulum:
    """A model with a number of its own, by which it divides."""

    stiffness: float

    def step(self, x, u):
        """Return the next state."""
        push = u[0] - jnp.sin(x[0]) / self.stiffness
        return jnp.stack([x[0] + 0.1 * x[1], x[1] + 0.1 * push])


TASK = jm.mpc.Task(lambda point: point.x[:1] ** 2, np.eye(1), upper=[0.9], rho=100.0)
GAIN = np.array([[-0.8, -1.2]])
W = jm.sets.Zonotope([0.01, 0.0], [[0.05, 0.01], [0.0, 0.02]])
ROBUST = replace(
    NOMINAL, disturbance=W, disturbance_matrix=np.eye(2), gain=GAIN, input_rate_weight=None
)
BOX = jm.Box([-0.05, -0.02], [0.05, 0.02])
TUBE = replace(ROBUST, policy="tube", disturbance=BOX)
AFFINE = replace(ROBUST, policy="affine", gain=None)
PROBLEMS = {
    "dense": (jm.solve, DENSE),
    "prestabilised": (jm.solve, replace(NOMINAL, prestabilise=GAIN)),
    "stages": (jm.mpc.solve_stagewise, replace(NOMINAL, soft=SOFT)),
    "tightened": (jm.solve, ROBUST),
    "affine": (jm.solve, AFFINE),
    "tube": (jm.solve, TUBE),
    "nonlinear": (
        jm.mpc.solve_nonlinear,
        jm.mpc.NonlinearMPC(replace(NOMINAL, soft=SOFT), Pendulum(1.2), (TASK,)),
    ),
}


@pytest.mark.long
@pytest.mark.first(6)
@pytest.mark.parametrize("kind", PROBLEMS)
def test_the_derivative_by_what_a_batch_shares(x64, kind):
    """Each instance but the first has NaN in another array of its problem; all are multiplied by
    what the batch shares. The derivative is that of the first alone."""
    solve, mpc = PROBLEMS[kind]
    # A tube's section is computed outside of traces.
    # The system of a nonlinear problem is read for its sizes.
    known = {"tube": (".system", ".gain", ".disturbance"), "nonlinear": ".mpc.system"}
    known = known.get(kind, "nothing")
    paths, tree = jax.tree.flatten_with_path(mpc)
    leaves = [leaf for _, leaf in paths]
    names = np.array(["none", *(jax.tree_util.keystr(path) for path, _ in paths)])

    def loss(shares, offsets):
        """Each instance has its share of what is shared: the sum of slopes is the slope."""

        def one(s, offset, i):
            data = [
                leaf if name.startswith(known) else s * leaf + v
                for name, leaf, v in zip(names[1:], leaves, offset, strict=True)
            ]
            plan = solve(jax.tree.unflatten(tree, data), s * START)
            counts = plan.solved & (i == 0)
            return jnp.where(counts, plan.cost + jnp.sum(plan.inputs), 0.0), plan.status

        found, status = jax.vmap(one)(shares, offsets, jnp.arange(len(names)))
        return jnp.sum(found), status

    slopes = jax.jit(jax.value_and_grad(loss, has_aux=True))
    shares, offsets = (
        np.ones(len(names)),
        [np.zeros((len(names), *np.shape(leaf))) for leaf in leaves],
    )
    (value, status), wanted = slopes(shares, offsets)
    assert np.all(status == jm.Status.SOLVED) and wanted[0] != 0 and not wanted[1:].any()
    for i, offset in enumerate(offsets):
        offset[i + 1] = np.nan
    (spoilt, status), found = slopes(shares, offsets)
    assert status[0] == jm.Status.SOLVED
    unnamed = [n for n, s in zip(names[1:], status[1:], strict=True) if s == jm.Status.SOLVED]
    assert not [name for name in unnamed if not name.startswith(known)], status
    assert not [*names[~np.isfinite(found)]]
    np.testing.assert_allclose([spoilt, *found], [value, *wanted], rtol=1e-9)
