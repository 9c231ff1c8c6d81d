"""Linear systems in discrete time, x+ = A x + B u + c."""

import dataclasses
from numbers import Real
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy

from jaxmpc.arrays import (
    Reals,
    as_array,
    as_column,
    as_floats,
    dimensions,
    host_array,
    store_floats,
)
from jaxmpc.checks import (
    concrete,
    fail,
    nearest,
    require_finite,
    require_last,
    require_names,
    require_printable,
    require_shape,
)
from jaxmpc.pytrees import prepared_pytree, static
from jaxmpc.qp.linalg import matmul

# What to do with the C and D of other toolboxes.
NO_OUTPUTS = "Outputs are no part of a system: see jm.Outputs"

_TEXTS = ("state_names", "input_names", "state_units", "input_units")
_DELAY = (
    "Put the previous input into the state: for a delay below dt, LinearSystem([[A, B − B0], "
    "[0, 0]], [[B0], [I]], dt=dt) has the state (x, u₋₁), with A, B sampled at dt and "
    "B0 = from_continuous(A, B, dt − delay).B"
)


def require_period(argument: str, dt: Any) -> None:
    """Raise unless `dt` is a positive finite Python number."""
    number = isinstance(dt, Real) and not isinstance(dt, bool)
    if not (number and np.isfinite(dt) and dt > 0):
        cure = "Give the sampling period, in seconds or in time_unit"
        fail(argument, f"{dt!r} is not a positive number", cure)


@prepared_pytree
class LinearSystem:
    """x+ = A x + B u + c, with x in R^n and u in R^m.

    Arguments:
        A: (n, n), state to next state.
        B: (n, m), input to next state.
        c: (n,) constant drift, or None for zero. Linearizing off an equilibrium gives one.
        dt: sampling period in seconds, or in `time_unit`, or None where it does not matter.
        state_names, input_names: tuples of n and m names; empty means x1..xn, u1..um.
        state_units, input_units: tuples of n and m units ("rad", "N m"); empty means none.
        time_unit: unit of dt, "s" or another ("h"), in which reports and plots give times too.

    In an `MPC` each of A, B and c may have a leading axis of N steps.
    A, B and c are pytree leaves (they may be batched and differentiated); the rest is
    static. The constructor checks how shapes fit together, dt, names and units, and takes a vector
    B (n,) as one input; `validate` checks the numbers too. JAX rebuilds it without checks.
    """

    A: Reals
    B: Reals
    c: Reals | None = None
    dt: float | None = static(default=None)
    state_names: tuple[str, ...] = static(default=())
    input_names: tuple[str, ...] = static(default=())
    state_units: tuple[str, ...] = static(default=())
    input_units: tuple[str, ...] = static(default=())
    time_unit: str = static(default="s")

    def __post_init__(self) -> None:
        store_floats(self, "A", "B", "c")
        if self.dt is not None:
            require_period("dt", self.dt)
        if not isinstance(self.time_unit, str) or not self.time_unit:
            fail("time_unit", f"{self.time_unit!r} is no unit", 'Write it as "s", "min" or "h"')
        require_printable("time_unit", self.time_unit)
        if dimensions(self.A) == 2 and dimensions(self.B) == 1:
            object.__setattr__(self, "B", as_column(self.B))
        if (dimensions(self.A) or 0) < 2 or (dimensions(self.B) or 0) < 2:
            return  # `validate` says what is wrong, and `in_axes` are a system without arrays
        n = self.n
        require_last("A", self.A, (n, n), "A must be square")
        rows = np.shape(as_array(self.B))[-2]
        if rows != n == self.m:
            require_last("B", self.B, (n, rows), "Give B.T")
        require_last("B", self.B, (n, self.m), "Give B as many rows as A")
        if dimensions(self.c):
            require_last("c", self.c, (n,), "Give one number a state, or None")
        elif isinstance(self.c, int | float):
            cure = f"Give one number a state; the sampling period has its name, dt={self.c!r}"
            fail("c", f"{self.c!r} where ({n},) is needed", cure)
        for kind, count in (("state", n), ("input", self.m)):
            for what in (f"{kind}_names", f"{kind}_units"):
                require_names(what, getattr(self, what), count)
            names = getattr(self, f"{kind}_names")
            if len(set(names)) < len(names):
                fail(f"{kind}_names", f"{names} has a name twice", "Give each a name of its own")

    @property
    def n(self) -> int:
        """Return the number of states."""
        return np.shape(as_array(self.A))[-1]

    @property
    def m(self) -> int:
        """Return the number of inputs."""
        return np.shape(as_array(self.B))[-1]

    @property
    def state_size(self) -> int:
        """Return the length of the state of this plant: n (a robot with orientations has more)."""
        return self.n

    @property
    def state_labels(self) -> tuple[str, ...]:
        """Return n labels for axes and tables, such as "q [rad]"."""
        return _labels("x", self.n, self.state_names, self.state_units)

    @property
    def input_labels(self) -> tuple[str, ...]:
        """Return m labels for axes and tables, such as "torque [N m]"."""
        return _labels("u", self.m, self.input_names, self.input_units)

    def step(self, x: Reals, u: Reals) -> jax.Array:
        """Return A x + B u + c for x (n,) and u (m,), computed in the dtype of x; of a system that
        differs from step to step the first step."""
        x = jnp.asarray(as_floats(x))
        parts = (self.A, 2), (self.B, 2), (0.0 if self.c is None else self.c, 1)
        every = ((jnp.asarray(v, x.dtype), axes) for v, axes in parts)
        A, B, c = (v[0] if v.ndim > axes else v for v, axes in every)
        return matmul(A, x) + matmul(B, jnp.asarray(u, x.dtype)) + c

    def validate(self, steps: int | None = None) -> None:
        """Raise ValueError for wrong shapes and entries that are not finite.

        steps: A, B and c may have a leading axis of this length, as in an `MPC`; None: none has.
        """
        for name in ("A", "B") if self.c is None else ("A", "B", "c"):
            value = getattr(self, name)
            if concrete(value):
                require_finite(name, host_array(name, value))
        A, B = (self._at_one_step(name, 2, steps) for name in ("A", "B"))
        for name, value, shape in (("A", A, "(n, n)"), ("B", B, "(n, m)")):
            given = np.shape(value)
            if len(given) != 2 or 0 in given:
                cure = "Give a matrix, [[1.0]] for the number 1"
                if len(given) > 2:
                    cure = "Give one matrix; one for each step is known to an MPC alone"
                fail(name, f"shape {given} is not {shape}", cure)
        n, m = self.n, self.m
        require_shape("A", A, (n, n), "A must be square")
        require_shape("B", B, (n, m), "Give B as many rows as A")
        if self.c is not None:
            cure = f"Give one number a state, or None. {NO_OUTPUTS}"
            require_shape("c", self._at_one_step("c", 1, steps), (n,), cure)

    def _at_one_step(self, name: str, axes: int, steps: int | None) -> Any:
        """Return A, B or c at the first step, or as it is where it has no more than these axes."""
        value = as_array(getattr(self, name))
        shape = np.shape(value)
        if steps is None or len(shape) != axes + 1:
            return value
        if shape[0] != steps:
            cure = f"A leading axis counts the {steps} steps of the horizon"
            fail(name, f"shape {shape}", f"{cure}. {NO_OUTPUTS}" if name == "c" else cure)
        return value[0] if steps else value

    @classmethod
    def from_continuous(
        cls,
        A: Reals,
        B: Reals,
        dt: float,
        c: Reals | None = None,
        *,
        time_unit: str = "s",
        **names: tuple[str, ...],
    ) -> "LinearSystem":
        """Sample dx/dt = A x + B u + c exactly, the input held constant over each period.

        With w = (x, u, 1), dw/dt = M w for M = [[A, B, c], [0, 0, 0]], so the first n rows
        of exp(M dt) are [Ad, Bd, cd] (Van Loan 1978, "Computing integrals involving the
        matrix exponential").

        Arguments:
            A: (n, n) in 1/s, B: (n, m), c: (n,) or None: continuous-time matrices.
            dt: sampling period in seconds, or in `time_unit`, of which A is the inverse then.
            time_unit: unit of dt.
            names: state_names, input_names, state_units, input_units.

        Raises ValueError for bad shapes or values, or dt <= 0.
        """
        require_period("dt", dt)
        for key, value in names.items():
            if key not in _TEXTS:
                delayed = "delay" in key.lower() or "latency" in key.lower()
                known = (*_TEXTS, "time_unit")
                cure = _DELAY if delayed else f"{nearest(key, known)}Leave it out"
                fail(key, f"is no argument (A, B, dt, c, {', '.join(known)} are)", cure)
            if not isinstance(value, list | tuple):
                fail(key, f"{value!r} is not a tuple of strings", 'Write it as ("q", "dq")')
        texts: dict[str, Any] = {key: tuple(value) for key, value in names.items()}
        continuous = cls(A, B, c, dt, time_unit=time_unit, **texts)
        continuous.validate()
        n, m = continuous.n, continuous.m
        M = np.zeros((n + m + 1, n + m + 1))
        M[:n, :n] = host_array("A", continuous.A)
        M[:n, n:-1] = host_array("B", continuous.B)
        if c is not None:
            M[:n, -1] = host_array("c", c)
        top = scipy.linalg.expm(M * dt)[:n]
        return dataclasses.replace(
            continuous, A=top[:, :n], B=top[:, n:-1], c=None if c is None else top[:, -1]
        )

    @classmethod
    def from_object(cls, obj: Any, dt: float | None = None) -> "LinearSystem":
        """Return the system held by any object with `.A`, `.B` and `.dt`.

        Understands python-control (`dt=0` continuous, `dt=True` discrete with unspecified
        period), scipy.signal (`lti` continuous, `dlti` discrete) and LinearSystem itself.
        Labels (`state_labels`, `input_labels`) become names where present. Outputs are dropped.

        Arguments:
            obj: the object.
            dt: sampling period in seconds. Required if `obj` is continuous (it is then
                sampled with the input held); fills in an unspecified period; otherwise it
                must agree with the object's own.

        Raises ValueError rather than guess: continuous without dt, a period that differs
        from dt, or an object that does not say whether it is continuous.
        """
        names: dict[str, Any] = {}
        period: bool | float | None
        if isinstance(obj, LinearSystem):
            obj.validate()
            system, period = obj, True if obj.dt is None else obj.dt
        else:
            for name in ("A", "B", "dt"):
                if not hasattr(obj, name):
                    fail("obj", f"has no .{name}", "Give a state-space object (in scipy: .to_ss())")
            for kind in ("state", "input"):
                names[f"{kind}_names"] = tuple(getattr(obj, f"{kind}_labels", None) or ())
            A, B = host_array("obj.A", obj.A), host_array("obj.B", obj.B)
            system, period = cls(A, B, **names), obj.dt
            if period is None and isinstance(obj, scipy.signal.lti):
                period = 0
        if dt is not None:
            require_period("dt", dt)
        if period is None:
            problem = "is None, which does not say whether the system is continuous or discrete"
            cure = "Use LinearSystem.from_continuous(A, B, dt) or LinearSystem(A, B, dt=dt)"
            fail("obj.dt", problem, cure)
        if period is True:
            period = dt
        elif period == 0:
            if dt is None:
                fail("dt", "is missing and obj is continuous", "Give the sampling period, dt=...")
            return cls.from_continuous(system.A, system.B, dt, **names)
        elif dt is not None and not np.isclose(dt, period, rtol=1e-12, atol=0):
            cure = "Leave dt out, or sample the continuous system again"
            fail("dt", f"{dt} differs from obj.dt = {period}", cure)
        system = dataclasses.replace(system, dt=period)
        system.validate()
        return system


def host_matrices(
    system: LinearSystem, *, by_step: bool = False
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return A (n, n), B (n, m) and c (n,), zero for None, as float64 NumPy arrays. by_step: each
    may have a leading axis of steps; else raise ValueError for one that has."""
    A, B = host_array("A", system.A), host_array("B", system.B)
    c = np.zeros(A.shape[-1]) if system.c is None else host_array("c", system.c)
    for name, value, axes in (("A", A, 2), ("B", B, 2), ("c", c, 1)):
        if value.ndim > axes and not by_step:
            what = f"shape {value.shape}: the system differs from step to step"
            fail(f"system.{name}", what, "Here it is the same at all: leave the axis out")
    return A, B, c


def numbered(word: str, count: int) -> tuple[str, ...]:
    """Return the names of what has none, such as x1, x2."""
    return tuple(f"{word}{i + 1}" for i in range(count))


def _labels(
    letter: str, count: int, names: tuple[str, ...], units: tuple[str, ...]
) -> tuple[str, ...]:
    names = names or numbered(letter, count)
    pairs = zip(names, units or ("",) * len(names), strict=True)
    return tuple(f"{name} [{unit}]" if unit else name for name, unit in pairs)
