"""Noise: random disturbances of a plant and of its measurements."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.checks import concrete, fail, require_finite, require_real, require_symmetric_psd
from jaxmpc.pytrees import pytree
from jaxmpc.qp.linalg import eigh
from jaxmpc.qp.precision import arrays, matmul, symmetric


@pytree
class Noise:
    """White Gaussian noise of a closed loop: ξ_{t+1} = f(ξ_t, u_t) + w_t, y_t = C ξ_t + v_t.

    process: of w_t, of one time step, in the coordinates ξ (n,) of the plant. measurement: of v_t,
        in the outputs (p,) of the observer; without one all coordinates are measured, p = n.
        Each is a standard deviation for all entries, one for each (k,), or a covariance (k, k);
        None for no noise.
    seed: a whole number or a JAX key; the same seed, the same noise. `simulate_many` gives loop i
        the key `jax.random.fold_in(key, i)`: its noise depends neither on the chunks nor on how
        many loops there are.

    The coordinates of a robot are ξ = (q ⊖ anchor, qvel), so that orientations stay rotations. A
    pytree; the noise of a run is differentiable in standard deviations and covariances.
    """

    process: Any = None
    measurement: Any = None
    seed: Any = 0

    def prepared(self, n: int, p: int) -> "Noise":
        """Return the noise with arrays and a key; raise ValueError unless it is of n coordinates
        and p outputs."""
        require_spread("noise.process", self.process, n)
        require_spread("noise.measurement", self.measurement, p)
        spreads = arrays([whole_array(spread) for spread in (self.process, self.measurement)])
        return Noise(spreads[0], spreads[1], self.key())

    def key(self) -> Array:
        """Return the seed as the numbers (2,) of a JAX key."""
        seed = self.seed
        if isinstance(seed, jax.Array) and jnp.issubdtype(seed.dtype, jax.dtypes.prng_key):
            seed = jax.random.key_data(seed)
        if not isinstance(seed, bool) and np.shape(seed) in ((), (2,)):
            kind = seed.dtype if hasattr(seed, "dtype") else np.asarray(seed).dtype
            if kind == np.uint32 and np.shape(seed) == (2,):
                return jnp.asarray(seed)
            if np.issubdtype(kind, np.integer) and np.shape(seed) == ():
                return jax.random.PRNGKey(seed)
        return fail("noise.seed", f"{seed!r}", "Give a whole number or one JAX key")

    def of_loop(self, index: Any) -> "Noise":
        """Return the noise of loop `index` of many."""
        return replace(self, seed=jax.random.fold_in(self.key(), index))

    def draw(self, steps: int, n: int, p: int, dtype: Any) -> tuple[Array | None, Array | None]:
        """Return w (steps, n) and v (steps, p), None where there is no such noise."""
        first, second = jax.random.split(self.key())
        w = _drawn(first, self.process, (steps, n), dtype)
        return w, _drawn(second, self.measurement, (steps, p), dtype)


def require_spread(name: str, value: Any, size: int) -> None:
    """Raise ValueError unless `value` is a standard deviation, (size,) of them, or a covariance."""
    if value is None:
        return
    require_real(name, value)
    shape = np.shape(value)
    if shape not in ((), (size,), (size, size)):
        cure = f"Give standard deviations, a number or ({size},), or a covariance ({size}, {size})"
        fail(name, f"shape {shape}", cure)
    require_finite(name, value)
    if len(shape) == 2:
        require_symmetric_psd(name, value)
    elif concrete(value) and np.any(np.asarray(value) < 0):
        fail(name, "has a negative standard deviation", "Give numbers of at least 0")


def whole_array(value: Any) -> Any:
    """Return lists as one array, so that a pytree has one leaf for them; None as it is."""
    if value is None:
        return None
    return np.asarray(value) if concrete(value) else jnp.asarray(value)


def covariance(spread: Any, size: int) -> Any:
    """Return the covariance (size, size) of standard deviations, or the covariance that it is."""
    xp = np if concrete(spread) else jnp
    spread = xp.asarray(spread)
    if spread.ndim == 2:
        return symmetric(spread)
    return xp.diag(xp.broadcast_to(spread, (size,)) ** 2)


def _drawn(key: Array, spread: Any, shape: tuple[int, int], dtype: Any) -> Array | None:
    """Return draws (T, k) with this spread, None for none."""
    if spread is None:
        return None
    draws, spread = jax.random.normal(key, shape, dtype), jnp.asarray(spread, dtype)
    if spread.ndim < 2:
        return draws * spread
    variances, axes = eigh(symmetric(spread))  # no Cholesky factor: covariances may be singular
    return matmul(draws * jnp.sqrt(jnp.maximum(variances, 0)), axes.T)
