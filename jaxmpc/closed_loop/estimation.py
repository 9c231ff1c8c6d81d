"""Noise of a plant and of its measurements, and the Kalman filter that estimates the state, with
constant disturbances beside it."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jax import Array

from jaxmpc.arrays import as_floats, dimensions, module_of
from jaxmpc.checks import (
    concrete,
    fail,
    is_definite,
    nearest,
    require_finite,
    require_kind,
    require_real,
    require_shape,
    require_symmetric_psd,
)
from jaxmpc.mpc.stagewise.nonlinear import NonlinearMPC, linear_model
from jaxmpc.pytrees import named_pytree, pytree, static
from jaxmpc.qp.linalg import arrays, matmul, solve, symmetric, symmetric_root
from jaxmpc.robots.configurations import nearest_turns, quaternions, rotations
from jaxmpc.robots.linear_plant import LinearPlant
from jaxmpc.robots.mujoco_access import BALL
from jaxmpc.robots.parameters import FIELDS, NONNEGATIVE, OF_PLANTS, PAYLOAD, require_numbers
from jaxmpc.robots.robot import Robot, RobotModel
from jaxmpc.systems.riccati import UNREACHED, least_reached, lqr
from jaxmpc.systems.system import LinearSystem, host_matrices, numbered
from jaxmpc.systems.units import balanced, less_identity, natural_units

# Singular values of balanced matrices, relative to the largest, that count as zero.
UNDETECTED = 1e-10


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
                # JAX takes 32 bits of it, unless 64-bit mode is on.
                if not concrete(seed) or -(2**31) <= int(seed) < 2**32:
                    return jax.random.PRNGKey(seed)
        return fail("noise.seed", f"{seed!r}", "Give a whole number below 2^32, or one JAX key")

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
    return module_of(value).asarray(value)


def covariance(spread: Any, size: int) -> Any:
    """Return the covariance (size, size) of standard deviations, or the covariance that it is."""
    xp = module_of(spread)
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
    return matmul(draws, symmetric_root(symmetric(spread)))


# What a disturbance is added to.
KINDS = ("input", "output", "state")


@pytree
class Disturbance:
    """Disturbances d (k,) that a Kalman filter estimates beside the state: constant but for the
    white noise w that moves them, d⁺ = d + w.

    kind: what M d is added to:
        "input"    u, M (m, k): ξ⁺ = f(ξ, u + M d), loads such as friction and payloads;
        "output"   what is measured, M (p, k): y = C ξ + M d, such as a sensor's offset;
        "state"    the next state, M (n, k): ξ⁺ = f(ξ, u) + M d;
        a number of a robot's model, as `Robot.vary` names it ("payload", "dof_damping",
                   "actuator_gear"), M (its entries, k): it is that of the model plus M d.
    process: of w, of one time step, in the unit of d; as in `Noise`. The larger, the sooner a
        change of d is followed, and the more measurement noise is taken for one.
    matrix M: None for one d for each input, output, state or entry; of the gear of a motor
        np.eye(6, 1).
    initial: of the error of the first estimate d = 0, where the filter has `initial`.

    No more disturbances of inputs, outputs and states than measured outputs can be told from each
    other; numbers of a model are told apart by motion. With as many, and with any model errors that
    leave the loop stable, `OffsetFreeController` has no steady-state error in the outputs that it
    tracks.
    """

    kind: str = static()
    process: Any
    matrix: Any = None
    initial: Any = None


@named_pytree
class Belief(NamedTuple):
    """What a filter knows of ξ and the disturbances.

    mean (n + k,): their estimate. covariance (n + k, n + k): of its error, None with a constant
    gain.
    """

    mean: Array
    covariance: Array | None


@pytree
class KalmanFilter:
    """Kalman filter of a model ξ⁺ = f(ξ, u) + w with outputs y = C ξ + v, w and v white.

    model: a LinearSystem or LinearPlant; or a Robot, of which the predictor is the model, or a
        NonlinearMPC with its model: their next state is the prediction, their linear model about
        the estimate moves the covariance (extended Kalman filter).
    process: of w, measurement: of v; standard deviations, a number or one an entry, or covariances,
        as in `Noise`. That of v must be positive definite.
    C (p, n): outputs; None: the positions, the first half of the coordinates (of a
        robot with activations, which come last, the first nv).
    initial: of the error of the first estimate, as `process`. None, for linear models: the gain is
        constant, that of the steady state,
            L = P C'(C P C' + V)⁻¹,   P = A P A' + W − A P C'(C P C' + V)⁻¹ C P A'.
    start (n,): first estimate, before the first output is measured; None: the true initial state.
    disturbance: `Disturbance`, or a tuple of them, estimated beside the state; none by default.
    gain (n + k, p): filled in by `prepared`; leave it None.

    ξ_t is estimated from y_0 … y_t (filtered estimate, corrected before the input is computed):
        ξ̂_t|t = ξ̂_t|t−1 + L (y_t − C ξ̂_t|t−1),   ξ̂_t+1|t = f(ξ̂_t|t, u_t).
    Outputs of which one is NaN or infinite correct nothing: ξ̂_t|t = ξ̂_t|t−1.
    Source: Anderson & Moore 1979, Optimal Filtering, chapters 3, 4 and 8. A pytree.
    """

    model: Any
    process: Any
    measurement: Any
    C: Any = None
    initial: Any = None
    start: Any = None
    disturbance: tuple[Disturbance, ...] | Disturbance = ()
    gain: Any = None

    def prepared(self) -> "KalmanFilter":
        """Return the filter with its constant gain, if it has one; raise ValueError where data do
        not fit together, or where no steady state exists (outside traces; there the gain is NaN).
        """
        kinds = LinearSystem, LinearPlant, Robot, NonlinearMPC
        require_kind("observer.model", self.model, *kinds)
        if not isinstance(self.model, Robot):
            self.model.validate()
        n = self.model.n
        if self.C is None and n % 2 and _robot_model(self.model) is None:
            fail("observer.C", f"is None with {n} states", "Say which outputs are measured")
        p = self.p if self.C is None or dimensions(self.C) == 2 else 1
        if self.C is not None:
            require_shape("observer.C", self.C, (p, n), "One row an output")
            require_finite("observer.C", self.C)
        for name, size in (("process", n), ("measurement", p)):
            if getattr(self, name) is None:
                fail(f"observer.{name}", "is None", "Give standard deviations or a covariance")
            require_spread(f"observer.{name}", getattr(self, name), size)
        V = covariance(self.measurement, p)
        if concrete(V) and not is_definite(np.asarray(V)):
            cure = "Give each output some noise, or leave it out"
            fail("observer.measurement", "has a combination of outputs without noise", cure)
        require_spread("observer.initial", self.initial, n)
        if self.start is not None:
            require_shape("observer.start", self.start, (n,), "Coordinates of the first estimate")
            require_finite("observer.start", self.start)
        names = ("process", "measurement", "C", "initial", "start")
        given: dict[str, Any] = {name: whole_array(getattr(self, name)) for name in names}
        given["disturbance"] = self._prepared_disturbances(p)
        if self.initial is not None or self.gain is not None:
            return replace(self, **given)
        if isinstance(self.model, Robot | NonlinearMPC):
            cure = "Give standard deviations, or use the LinearSystem of the set-point as the model"
            fail("observer.initial", f"is None for a {type(self.model).__name__}", cure)
        made = replace(self, **given)
        system = made.linear_model
        if made.disturbance and concrete(system, made.C, made.disturbance):
            made.require_detectable(system)
        return replace(made, gain=made._steady_gain(system))

    def _prepared_disturbances(self, p: int) -> tuple[Disturbance, ...]:
        """Return the disturbances with their matrices; raise ValueError where one is wrong."""
        found = []
        given = self._each
        if not all(isinstance(one, Disturbance) for one in given):
            what = f"is a {type(self.disturbance).__name__}"
            fail("observer.disturbance", what, "Give a closed_loop.Disturbance, or several")
        for i, one in enumerate(given):
            name = f"observer.disturbance[{i}]"
            if one.kind not in KINDS:
                self._require_number(f"{name}.kind", one.kind)
            rows = self._rows(one.kind)
            M = whole_array(np.eye(rows) if one.matrix is None else one.matrix)
            if M.ndim != 2 or M.shape[0] != rows or not M.shape[1]:
                cure = f"Give ({rows}, k), a row for each entry of {one.kind}, or None"
                fail(f"{name}.matrix", f"shape {M.shape}", cure)
            require_finite(f"{name}.matrix", M)
            if concrete(M) and not np.all(np.any(M, axis=0)):
                fail(f"{name}.matrix", "has a column of zeros, which acts nowhere", "Leave it out")
            k = M.shape[1]
            if one.process is None:
                fail(f"{name}.process", "is None", "Give standard deviations or a covariance")
            require_spread(f"{name}.process", one.process, k)
            require_spread(f"{name}.initial", one.initial, k)
            W = covariance(one.process, k)
            if concrete(W) and not is_definite(np.asarray(W)):
                what, cure = "leaves a disturbance without noise", "Give it some, or leave it out"
                fail(f"{name}.process", what, cure)
            if self.initial is not None and one.initial is None:
                fail(f"{name}.initial", "is None, and observer.initial is given", "Give it too")
            spreads = (whole_array(one.process), M, whole_array(one.initial))
            found.append(Disturbance(one.kind, *spreads))
        k = sum(np.shape(one.matrix)[1] for one in found if one.kind in KINDS)
        if k > p:
            what = f"has {k} disturbances, and {p} outputs are measured"
            fail("observer.disturbance", what, "Give at most one for each measured output")
        return tuple(found)

    def _rows(self, kind: str) -> int:
        """Return how many numbers M d of a kind has."""
        sizes = {"input": self.model.m, "output": self.p, "state": self.model.n}
        return sizes[kind] if kind in KINDS else np.size(_number(_robot_model(self.model), kind))

    def _require_number(self, name: str, kind: str) -> None:
        """Raise ValueError unless the model is one of a robot that has this number."""
        model = _robot_model(self.model)
        if model is None:
            cure = f"Give one of {', '.join(KINDS)}; with a Robot as the model also its numbers"
            fail(name, f"{kind!r}", cure)
        physics = model.robot.predictor
        if not isinstance(kind, str) or kind not in (*FIELDS, *physics.own):
            near = nearest(str(kind), (*KINDS, *FIELDS, PAYLOAD))
            cure = f"{near}Give one of {', '.join(KINDS)}, or a number as in Robot.vary"
            fail(name, f"{kind!r}", cure)
        if kind in OF_PLANTS and not physics.limited:
            fail(name, f"{kind!r}, of which the model has nothing", "Estimate another number")
        require_numbers(physics, {kind: _number(model, kind)})

    @property
    def estimates_numbers(self) -> bool:
        """Return whether numbers of the robot's model are estimated."""
        return any(one.kind not in KINDS for one in self._each)

    def numbers(self, d: Array) -> dict[str, Array]:
        """Return the numbers of the robot's model, the model's own and those that are estimated, by
        name, where the disturbances are d (k,); for `numbers=` of a `RobotController`. Those that
        cannot be negative are held at 0."""
        model = _robot_model(self.model)
        assert model is not None  # `prepared` says so
        found = dict(model.numbers)
        for kind in dict.fromkeys(one.kind for one in self._each if one.kind not in KINDS):
            M, own = (jnp.asarray(v, d.dtype) for v in (self.matrix(kind), _number(model, kind)))
            value = own + matmul(M, d).reshape(own.shape)
            if kind in NONNEGATIVE:
                # With the derivative of what d says, by which it leaves 0 again.
                value = value + jax.lax.stop_gradient(jnp.maximum(value, 0) - value)
            found[kind] = value
        return found

    def _informed(self, d: Array, numbers: Mapping[str, Any]) -> Any:
        """Return the model with these disturbances, and with others of its own numbers, in its
        numbers."""
        model = _robot_model(self.model)
        own = {} if model is None else model.robot.predictor.own
        known = {name: value for name, value in numbers.items() if name in own}
        if model is None or not (self.estimates_numbers or known):
            return self.model
        return replace(model, numbers={**self.numbers(d), **known})

    @property
    def linear_model(self) -> LinearSystem:
        """Return the LinearSystem of a linear model."""
        return self.model if isinstance(self.model, LinearSystem) else self.model.system

    @property
    def disturbances(self) -> int:
        """Return k, the number of disturbances of a prepared filter."""
        return sum(np.shape(one.matrix)[1] for one in self._each)

    @property
    def _each(self) -> tuple[Disturbance, ...]:
        """Return the disturbances as a tuple."""
        given = self.disturbance
        return tuple(given) if isinstance(given, tuple | list) else (given,)

    def split(self, mean: Array) -> tuple[Array, Array]:
        """Return the state (n,) and the disturbances (k,) of an estimate."""
        return mean[: self.model.n], mean[self.model.n :]

    def matrix(self, kind: str) -> Any:
        """Return M with M d added to inputs, outputs, states or a number (rows, k) of a prepared
        filter."""
        rows = self._rows(kind)
        sizes = [(one, np.shape(one.matrix)[1]) for one in self._each]
        parts = [one.matrix if one.kind == kind else np.zeros((rows, k)) for one, k in sizes]
        return module_of(parts).concatenate([np.zeros((rows, 0)), *parts], axis=1)

    def on_states(self, B: Any) -> Any:
        """Return what the disturbances add to the next state, B M_input + M_state (n, k)."""
        return B @ self.matrix("input") + self.matrix("state")

    def require_detectable(self, system: LinearSystem) -> None:
        """Raise ValueError unless outputs tell states and disturbances of this model apart.

        Where the model without disturbances is detectable, that is so if and only if
            [[A − I, B_d], [C, C_d]]
        has n + k independent columns (Pannocchia & Rawlings 2003, AIChE Journal 49(2), lemma 1;
        Maeder, Borrelli & Morari 2009, Automatica 45(10), proposition 1). Rows and columns are put
        in units of their size first, so that no choice of units decides.
        """
        A, B, _ = host_matrices(system)
        n, k = system.n, self.disturbances
        moved = np.hstack([less_identity(A), self.on_states(B)])
        M = np.vstack([moved, self._outputs_of_all()])
        row, column = balanced(M)
        _, values, axes = np.linalg.svd(row[:, None] * M * column)
        if values[n + k - 1] > UNDETECTED * values[0]:
            return
        hidden = np.abs(axes[values <= UNDETECTED * values[0]])
        large = np.any(hidden > 0.1 * hidden.max(axis=1, keepdims=True), axis=0)
        names = system.state_names or numbered("x", n)
        states = [name for name, one in zip(names, large[:n], strict=True) if one]
        loads = [name for name, one in zip(self._load_names(), large[n:], strict=True) if one]
        if not loads:
            what = f"no output shows {', '.join(states)} at rest"
            fail("observer.C", what, "Measure it")
        if not states:
            what = f"outputs do not tell {', '.join(loads)} apart at rest"
            fail("observer.disturbance", what, "Leave one out, or measure more outputs")
        what = f"outputs do not tell {', '.join(loads)} from {', '.join(states)} at rest"
        cure = "Let disturbances act on inputs where states integrate, or measure more outputs"
        fail("observer.disturbance", what, cure)

    def _load_names(self) -> list[str]:
        """Return a name for each disturbance, such as "the disturbance of output 2"."""
        found = []
        for one in self._each:
            for column in np.asarray(one.matrix).T:
                (where,) = np.nonzero(column)
                places = " and ".join(str(i + 1) for i in where) or "nothing"
                found.append(f"the disturbance of {one.kind} {places}")
        return found

    @property
    def p(self) -> int:
        """Return the number of outputs."""
        if self.C is not None:
            return np.shape(self.C)[0]
        # Positions; a robot's activations come after its velocities.
        model = _robot_model(self.model)
        return self.model.n // 2 if model is None else model.robot.mujoco.nv

    def outputs(self, xi: Array) -> Array:
        """Return C ξ (p,)."""
        xi = jnp.asarray(as_floats(xi))
        return xi[: self.p] if self.C is None else matmul(jnp.asarray(self.C, xi.dtype), xi)

    def first(self, xi: Array) -> Belief:
        """Return the estimate before the first output, where the plant starts at ξ; d is 0."""
        xi = jnp.asarray(as_floats(xi))
        state = xi if self.start is None else jnp.asarray(self.start, xi.dtype)
        mean = jnp.concatenate([state, jnp.zeros(self.disturbances, xi.dtype)])
        if self.gain is not None:
            return Belief(mean, None)
        return Belief(mean, jnp.asarray(self._covariance("initial"), xi.dtype))

    def corrected(self, belief: Belief, y: Array) -> Belief:
        """Return the estimate after the output y (p,)."""
        mean, P = belief
        C = jnp.asarray(self._outputs_of_all(), mean.dtype)
        known, expected = jnp.all(jnp.isfinite(y)), matmul(C, mean)
        error = self._nearest_turns(jnp.where(known, y, expected), expected) - expected
        if P is None:
            return Belief(mean + matmul(jnp.asarray(self.gain, mean.dtype), error), None)
        V = jnp.asarray(covariance(self.measurement, self.p), mean.dtype)
        L = jnp.where(known, _gain(P, C, V), 0.0)
        # Joseph's form: a sum of semidefinite terms, whatever the rounding of L.
        left = jnp.eye(len(mean), dtype=mean.dtype) - matmul(L, C)
        P = matmul(left, matmul(P, left.T)) + matmul(L, matmul(V, L.T))
        return Belief(mean + matmul(L, error), P)

    def predicted(
        self,
        belief: Belief,
        u: Array,
        known: Array | None = None,
        numbers: Mapping[str, Any] = MappingProxyType({}),
    ) -> Belief:
        """Return the estimate one time step later, under the input u (m,) and what is known to be
        added to the next state (n,), None for nothing. numbers: of the robot's model at this step,
        such as which feet stand."""
        mean, P = belief
        xi, d = self.split(mean)
        of_states = None
        if len(d):
            on_inputs, on_states = (
                jnp.asarray(self.matrix(k), d.dtype) for k in ("input", "state")
            )
            u, of_states = u + matmul(on_inputs, d), matmul(on_states, d)
        model = self._informed(d, numbers)
        after = model_step(model, xi, u)
        for more in (of_states, known):
            after = after if more is None else after + more
        canonical = _canonical(model)
        moved, after = after, after if canonical is None else canonical(after)
        after = jnp.concatenate([after, d])
        if P is None:
            return Belief(after, None)
        A, B = (jnp.asarray(v, d.dtype) for v in _slopes(model, xi, u))
        A, _ = self._with_disturbances(A, B)
        if self.estimates_numbers:
            of_numbers = jax.jacfwd(lambda d: model_step(self._informed(d, numbers), xi, u))(d)
            A = jnp.asarray(A).at[: len(xi), len(xi) :].add(of_numbers)
        if canonical is not None:
            turned = matmul(jax.jacfwd(canonical)(moved), jnp.asarray(A)[: len(xi)])
            A = jnp.concatenate([turned, A[len(xi) :]])
        W = jnp.asarray(self._covariance("process"), d.dtype)
        return Belief(after, matmul(A, matmul(P, A.T)) + W)

    def _nearest_turns(self, y: Array, expected: Array) -> Array:
        """Return the outputs (p,) with rotation vectors of free bodies and ball joints, where rows
        of C are their coordinates, as those of the same orientations nearest to the expected."""
        model = _robot_model(self.model)
        if model is None:
            return y
        C = jnp.eye(self.p, self.model.n) if self.C is None else jnp.asarray(self.C)
        for motion in rotations(model.robot.joints):
            places = C[:, None] == jnp.eye(self.model.n, dtype=C.dtype)[motion]
            found = jnp.all(places, axis=2)  # (p, 3)
            number = jnp.cumsum(found, axis=0)
            for k in range(1, self.p // 3 + 1):  # the k-th time that it is measured
                here = found & (number == k)
                at = jnp.argmax(here, axis=0)
                nearest = nearest_turns((BALL,), y[at], expected[at])
                y = y.at[at].set(jnp.where(jnp.all(jnp.any(here, axis=0)), nearest, y[at]))
        return y

    def _outputs_of_all(self) -> Any:
        """Return (C, C_d) (p, n + k), the outputs of states and disturbances."""
        C = np.eye(self.p, self.model.n) if self.C is None else self.C
        parts = [C, self.matrix("output")]
        return module_of(parts).concatenate(parts, axis=1)

    def _with_disturbances(self, A: Any, B: Any) -> tuple[Any, Any]:
        """Return the matrices of the model of states and disturbances (n + k): of these themselves,
        and of the inputs."""
        k = self.disturbances
        xp = module_of(A, B, self.disturbance)
        A, B = xp.asarray(A), xp.asarray(B)
        zeros = lambda *shape: xp.zeros(shape, A.dtype)
        top = xp.concatenate([A, xp.asarray(self.on_states(B), A.dtype)], axis=1)
        rest = xp.concatenate([zeros(k, len(A)), xp.eye(k, dtype=A.dtype)], axis=1)
        return xp.concatenate([top, rest]), xp.concatenate([B, zeros(k, B.shape[1])])

    def _covariance(self, name: str) -> Any:
        """Return the covariance (n + k, n + k) of `process` or `initial`, of states and
        disturbances."""
        parts = [covariance(getattr(self, name), self.model.n)]
        for one in self._each:
            parts.append(covariance(getattr(one, name), np.shape(one.matrix)[1]))
        if len(parts) == 1:
            return parts[0]
        return (scipy.linalg if concrete(parts) else jax.scipy.linalg).block_diag(*parts)

    def _steady_gain(self, system: LinearSystem) -> Any:
        """Return L of the steady state. P solves the Riccati equation of the LQR of the dual system
        ζ⁺ = A'ζ + C'ν with the weights W and V."""
        W, V = self._covariance("process"), covariance(self.measurement, self.p)
        A, _ = self._with_disturbances(system.A, system.B)
        C = self._outputs_of_all()
        if concrete(A, C, W, V):
            A, C, W, V = (np.asarray(v, float) for v in (A, C, W, V))
            units = natural_units(A.T, C.T, W, V)
            noise, _ = units.weights((W + W.T) / 2, V)
            variances, axes = np.linalg.eigh(noise)
            pushed = axes / units.states[:, None] * np.sqrt(np.maximum(variances, 0))
            for argument, (found, mode), problem, cure in (
                ("C", least_reached(A.T, C.T), "no output shows", "Measure it"),
                ("process", least_reached(A, pushed), "no noise moves", "Give it some, or initial"),
            ):
                if found <= UNREACHED:
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


def _robot_model(model: Any) -> RobotModel | None:
    """Return the model of a robot, None for other models."""
    model = model.model if isinstance(model, NonlinearMPC) else model
    model = RobotModel(model, exact=False) if isinstance(model, Robot) else model
    return model if isinstance(model, RobotModel) else None


def _canonical(model: Any) -> Callable[[Array], Array] | None:
    """Return the function that makes rotation vectors ones of at most half a turn, None where there
    are none."""
    found = _robot_model(model)
    if found is None or not quaternions(found.robot.joints):
        return None
    return lambda xi: found.robot.coordinates(found.robot.state(xi))


def _number(model: Any, kind: str) -> Any:
    """Return a number of a model of a robot: its own, else that of the file."""
    file = 0.0 if kind == PAYLOAD else np.asarray(getattr(model.robot.predictor.mjx, kind))
    return model.numbers.get(kind, file)


def model_step(model: Any, xi: Array, u: Array) -> Array:
    """Return the coordinates (n,) one time step later by a model: of a Robot, its predictor."""
    if isinstance(model, Robot):
        return RobotModel(model).step(xi, u)
    return (model.model if isinstance(model, NonlinearMPC) else model).step(xi, u)


def _slopes(model: Any, xi: Array, u: Array) -> tuple[Any, Any]:
    """Return A (n, n), B (n, m) of a model about ξ, u."""
    if isinstance(model, NonlinearMPC):
        return linear_model(model.model, xi, u)[:2]
    if isinstance(model, RobotModel):
        model = model.linearize(xi, u)
    elif not isinstance(model, LinearSystem):
        model = model.linearize(model.state(xi), u)
    return model.A, model.B
