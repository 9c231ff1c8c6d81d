"""Noise of a plant and of its measurements, and the Kalman filter that estimates the state."""

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.checks import (
    concrete,
    fail,
    require_finite,
    require_kind,
    require_real,
    require_shape,
    require_symmetric_psd,
)
from jaxmpc.pytrees import named_pytree, pytree
from jaxmpc.qp.linalg import arrays, eigh, matmul, solve, symmetric
from jaxmpc.robots.linear_plant import LinearPlant
from jaxmpc.robots.robot import Robot, RobotModel
from jaxmpc.systems.riccati import least_reached, lqr
from jaxmpc.systems.system import LinearSystem


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


@named_pytree
class Belief(NamedTuple):
    """An estimate ξ̂ (n,), and the covariance (n, n) of its error; None with a constant gain."""

    mean: Array
    covariance: Array | None


@pytree
class KalmanFilter:
    """Kalman filter of a model ξ⁺ = f(ξ, u) + w with outputs y = C ξ + v, w and v white.

    model: a LinearSystem or LinearPlant, or a Robot, of which the predictor is the model: its own
        next state is the prediction, its linear model about the estimate moves the covariance
        (extended Kalman filter).
    process: of w, measurement: of v; standard deviations, a number or one an entry, or covariances,
        as in `Noise`. That of v must be positive definite.
    C (p, n): outputs; None: the positions, the first half of the coordinates.
    initial: of the error of the first estimate, as `process`. None, for linear models: the gain is
        constant, that of the steady state,
            L = P C'(C P C' + V)⁻¹,   P = A P A' + W − A P C'(C P C' + V)⁻¹ C P A'.
    start (n,): first estimate, before the first output is measured; None: the true initial state.
    gain (n, p): filled in by `prepared`; leave it None.

    ξ_t is estimated from y_0 … y_t (filtered estimate, corrected before the input is computed):
        ξ̂_t|t = ξ̂_t|t−1 + L (y_t − C ξ̂_t|t−1),   ξ̂_t+1|t = f(ξ̂_t|t, u_t).
    Source: Anderson & Moore 1979, Optimal Filtering, chapters 3, 4 and 8. A pytree.
    """

    model: Any
    process: Any
    measurement: Any
    C: Any = None
    initial: Any = None
    start: Any = None
    gain: Any = None

    def prepared(self) -> "KalmanFilter":
        """Return the filter with its constant gain, if it has one; raise ValueError where data do
        not fit together, or where no steady state exists (outside traces; there the gain is NaN).
        """
        require_kind("observer.model", self.model, LinearSystem, LinearPlant, Robot)
        if not isinstance(self.model, Robot):
            self.model.validate()
        n = self.model.n
        if self.C is None and n % 2:
            fail("observer.C", f"is None with {n} states", "Say which outputs are measured")
        p = n // 2 if self.C is None else np.shape(self.C)[0] if np.ndim(self.C) == 2 else 1
        if self.C is not None:
            require_shape("observer.C", self.C, (p, n), "One row an output")
            require_finite("observer.C", self.C)
        for name, size in (("process", n), ("measurement", p)):
            if getattr(self, name) is None:
                fail(f"observer.{name}", "is None", "Give standard deviations or a covariance")
            require_spread(f"observer.{name}", getattr(self, name), size)
        V = covariance(self.measurement, p)
        if concrete(V) and np.linalg.eigvalsh(V)[0] <= 0:
            cure = "Give each output some noise, or leave it out"
            fail("observer.measurement", "has a combination of outputs without noise", cure)
        require_spread("observer.initial", self.initial, n)
        if self.start is not None:
            require_shape("observer.start", self.start, (n,), "Coordinates of the first estimate")
        names = ("process", "measurement", "C", "initial", "start")
        given = {name: whole_array(getattr(self, name)) for name in names}
        if self.initial is not None or self.gain is not None:
            return replace(self, **given)
        if isinstance(self.model, Robot):
            cure = "Give standard deviations, or use the LinearSystem of the set-point as the model"
            fail("observer.initial", "is None for a Robot", cure)
        return replace(self, **given, gain=self._steady_gain())

    @property
    def p(self) -> int:
        """Return the number of outputs."""
        return self.model.n // 2 if self.C is None else np.shape(self.C)[0]

    def outputs(self, xi: Array) -> Array:
        """Return C ξ (p,)."""
        return xi[: self.p] if self.C is None else matmul(self._matrix(xi.dtype), xi)

    def first(self, xi: Array) -> Belief:
        """Return the estimate before the first output, where the plant starts at ξ."""
        mean = xi if self.start is None else jnp.asarray(self.start, xi.dtype)
        if self.gain is not None:
            return Belief(mean, None)
        return Belief(mean, jnp.asarray(covariance(self.initial, self.model.n), xi.dtype))

    def corrected(self, belief: Belief, y: Array) -> Belief:
        """Return the estimate after the output y (p,)."""
        xi, P = belief
        if P is None:
            L = jnp.asarray(self.gain, xi.dtype)
            return Belief(xi + matmul(L, y - self.outputs(xi)), None)
        C, V = self._matrix(xi.dtype), jnp.asarray(covariance(self.measurement, self.p), xi.dtype)
        L = _gain(P, C, V)
        # Joseph's form: a sum of semidefinite terms, whatever the rounding of L.
        left = jnp.eye(self.model.n, dtype=xi.dtype) - matmul(L, C)
        P = matmul(left, matmul(P, left.T)) + matmul(L, matmul(V, L.T))
        return Belief(xi + matmul(L, y - self.outputs(xi)), P)

    def predicted(self, belief: Belief, u: Array) -> Belief:
        """Return the estimate one time step later, under the input u (m,)."""
        xi, P = belief
        after = model_step(self.model, xi, u)
        if P is None:
            return Belief(after, None)
        model = self.model
        if not isinstance(model, LinearSystem):
            model = model.linearize(model.state(xi), u)
        A = jnp.asarray(model.A, xi.dtype)
        W = jnp.asarray(covariance(self.process, self.model.n), xi.dtype)
        return Belief(after, matmul(A, matmul(P, A.T)) + W)

    def _matrix(self, dtype: Any) -> Array:
        C = np.eye(self.p, self.model.n) if self.C is None else self.C
        return jnp.asarray(C, dtype)

    def _steady_gain(self) -> Any:
        """Return L of the steady state. P solves the Riccati equation of the LQR of the dual system
        ζ⁺ = A'ζ + C'ν with the weights W and V."""
        system = self.model if isinstance(self.model, LinearSystem) else self.model.system
        W, V = covariance(self.process, system.n), covariance(self.measurement, self.p)
        A: Any = system.A
        C: Any = np.eye(self.p, system.n) if self.C is None else self.C
        if concrete(A, C, W, V):
            A, C, W, V = (np.asarray(v, float) for v in (A, C, W, V))
            variances, axes = np.linalg.eigh((W + W.T) / 2)
            pushed = axes * np.sqrt(np.maximum(variances, 0))
            for argument, (found, mode), problem, cure in (
                ("C", least_reached(A.T, C.T), "no output shows", "Measure it"),
                ("process", least_reached(A, pushed), "no noise moves", "Give it some, or initial"),
            ):
                if found <= 1e-10:
                    fail(f"observer.{argument}", f"{problem} the mode with eigenvalue {mode}", cure)
            P: Any = lqr(LinearSystem(A.T, C.T), W, V).P
            return np.linalg.solve(C @ P @ C.T + V, C @ P).T
        dual = lqr(LinearSystem(jnp.asarray(A).T, jnp.asarray(C).T), W, V)
        P = dual.P
        return _gain(P, jnp.asarray(C, P.dtype), jnp.asarray(V, P.dtype))


def _gain(P: Array, C: Array, V: Array) -> Array:
    """Return P C'(C P C' + V)⁻¹ (n, p)."""
    CP = matmul(C, P)
    return solve(matmul(CP, C.T) + V, CP).T


def model_step(model: Any, xi: Array, u: Array) -> Array:
    """Return the coordinates (n,) one time step later by a model: of a Robot, its predictor."""
    if isinstance(model, Robot):
        return RobotModel(model).step(xi, u)
    return model.step(xi, u)
