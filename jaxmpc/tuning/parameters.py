"""Parameters: numbers and matrices that stay in their domain for any step of the optimiser.

An optimiser moves free real numbers θ; `values` maps them to what the problem takes:

    real       v = θ
    positive   v = exp(θ), entry by entry
    interval   v = lower + (upper − lower)/(1 + exp(−θ)), entry by entry
    diagonal   V = diag(exp(θ))
    definite   V = L L', L lower triangular with θ below and exp(θ) on the diagonal: every
               symmetric positive definite V has exactly one such L (Golub & Van Loan 2013, §4.2.3)

so that a step of θ is a relative change of a weight, independent of its units. Matrices may have a
leading axis: one for each step, each in the domain.
"""

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.arrays import as_floats, host_array
from jaxmpc.checks import fail, require_finite, require_symmetric_psd
from jaxmpc.pytrees import record

DOMAINS = ("real", "positive", "interval", "diagonal", "definite")


@record
class Parameter:
    """One quantity to tune: its initial value, its domain, and which of its entries are trained.

    value: a number or an array; for "diagonal" and "definite" a matrix (n, n), or one for each of N
    steps, (N, n, n), for "diagonal" also its diagonal (n,). domain: see above. lower, upper: ends
    of an "interval", numbers or arrays of the value's shape. train: True, False, or a mask of the
    shape of what is free: of value itself, of the diagonal (n,) for "diagonal", of L (n, n) for
    "definite" (its upper triangle does not count), with a leading axis N where the value has one.
    Entries not trained keep their value, up to rounding; of a "real" value they may be infinite,
    as limits are that are not there. Raises ValueError for values outside the domain.
    """

    value: Any
    domain: str = "real"
    lower: Any = None
    upper: Any = None
    train: Any = True

    def __post_init__(self) -> None:
        if self.domain not in DOMAINS:
            fail("domain", f"{self.domain!r}", f"Give one of {', '.join(DOMAINS)}")
        value = host_array("value", self.value)
        if self.domain != "real" or np.isnan(value).any():
            require_finite("value", value)
        if self.domain in ("diagonal", "definite"):
            if self.domain == "diagonal" and value.ndim == 1:
                value = np.diag(value)
            if value.ndim not in (2, 3) or value.shape[-2] != value.shape[-1]:
                fail("value", f"shape {value.shape}", "Give a square matrix, or one for each step")
            for k, matrix in enumerate(value.reshape(-1, *value.shape[-2:])):
                name = "value" if value.ndim == 2 else f"value[{k}]"
                require_symmetric_psd(name, matrix, definite=True)
            if self.domain == "diagonal" and not is_diagonal(value):
                fail("value", "is not diagonal", 'Use the domain "definite"')
        if self.domain == "positive" and not np.all(value > 0):
            fail("value", "holds an entry that is not positive", 'Use "real" or "interval"')
        if (self.domain == "interval") != (self.lower is not None and self.upper is not None):
            fail("lower, upper", "belong to an interval, both of them", 'domain="interval"')
        object.__setattr__(self, "value", value)
        if self.domain == "interval":
            for name in ("lower", "upper"):
                require_finite(name, getattr(self, name))
                end = np.asarray(getattr(self, name), np.float64)
                if end.shape not in ((), value.shape):
                    fail(name, f"shape {end.shape}", f"Give a number or shape {value.shape}")
                object.__setattr__(self, name, end)
            if not (np.all(self.lower < value) and np.all(value < self.upper)):
                fail("value", f"{value.tolist()}", "Start inside the interval, not at its ends")
        free = self._free(value)
        train = np.asarray(self.train)
        if train.dtype != bool or train.shape not in ((), free.shape):
            mask = f"a mask of True and False, shape {free.shape}"
            fail("train", f"{self.train!r}", f"Give True, False or {mask}")
        train = np.broadcast_to(train, free.shape)
        if self.domain == "definite":
            train = np.tril(train)
        if not np.all(np.isfinite(free[train])):
            fail("value", "is infinite where it is trained", "Use train=np.isfinite(value)")
        object.__setattr__(self, "train", train)

    def _free(self, value: np.ndarray) -> np.ndarray:
        """Return θ of a value, all entries."""
        if self.domain == "positive":
            return np.log(value)
        if self.domain == "interval":
            return np.log(value - self.lower) - np.log(self.upper - value)
        if self.domain == "diagonal":
            return np.log(np.diagonal(value, axis1=-2, axis2=-1))
        if self.domain == "definite":
            L = np.linalg.cholesky((value + value.swapaxes(-1, -2)) / 2)
            return np.tril(L, -1) + _diagonal(np.log(np.diagonal(L, axis1=-2, axis2=-1)))
        return value

    def record(self) -> dict[str, Any]:
        """Return the map from θ to the value, as JSON data."""
        ends = [
            None if end is None else np.asarray(end).tolist() for end in (self.lower, self.upper)
        ]
        return {
            "domain": self.domain,
            "value": self.value.tolist(),
            "train": self.train.tolist(),
            "ends": ends,
        }

    def raw(self) -> np.ndarray:
        """Return θ of the entries that are trained, (k,)."""
        return self._free(self.value)[self.train]

    def at(self, raw: Any) -> Array:
        """Return the value where the trained entries have the θ (k,). Works inside jit, vmap and
        grad."""
        raw = jnp.asarray(as_floats(raw))
        theta = jnp.asarray(self._free(self.value), raw.dtype).at[self.train].set(raw)
        if self.domain == "positive":
            return _positive(theta)
        if self.domain == "interval":
            lower, upper = (jnp.asarray(end, raw.dtype) for end in (self.lower, self.upper))
            value = lower + (upper - lower) * jax.nn.sigmoid(theta)
            tiny = jnp.finfo(raw.dtype).tiny  # smaller numbers are flushed to 0
            least = jnp.where(lower == 0, tiny, jnp.nextafter(lower, upper))
            most = jnp.where(upper == 0, -tiny, jnp.nextafter(upper, lower))
            return jnp.clip(value, least, most)
        if self.domain == "diagonal":
            return _diagonal(_positive(theta))
        if self.domain == "definite":
            scales = _positive(jnp.diagonal(theta, axis1=-2, axis2=-1), 0.5)
            L = jnp.tril(theta, -1) + _diagonal(scales)
            return jnp.matmul(L, L.swapaxes(-1, -2), precision="highest")
        return theta


def _positive(theta: Array, power: float = 1.0) -> Array:
    """Return exp θ within the positive numbers to this power, however far a step has gone."""
    numbers = jnp.finfo(theta.dtype)
    least, most = math.log(float(numbers.tiny)), math.log(float(numbers.max))
    return jnp.exp(jnp.clip(theta, power * least + 1, power * most - 1))


Parameters = Mapping[str, Parameter]


def is_diagonal(M: np.ndarray) -> bool:
    """Return whether a square matrix, or each of several, has no entry beside its diagonal."""
    return bool(np.all(M[..., ~np.eye(M.shape[-1], dtype=bool)] == 0))


def _diagonal(v: Any) -> Any:
    """Return the diagonal matrices (…, n, n) of the vectors (…, n)."""
    return v[..., None] * np.eye(v.shape[-1], dtype=v.dtype)


def require_parameters(parameters: Parameters, argument: str = "parameters") -> None:
    """Raise ValueError unless this is a mapping of Parameters of which something is trained."""
    if not isinstance(parameters, Mapping) or not parameters:
        fail(argument, f"is a {type(parameters).__name__}", 'Give {"Q": jm.Parameter(...)}')
    for name, parameter in parameters.items():
        if not isinstance(parameter, Parameter):
            kind = type(parameter).__name__
            fail(f"{argument}[{name!r}]", f"is a {kind}", "Wrap it in a jm.Parameter")
    if not any(parameter.train.any() for parameter in parameters.values()):
        fail(argument, "none is trained", "Set train=True for what is to move")


def moved(parameters: Parameters, to: Mapping[str, Any]) -> dict[str, Parameter]:
    """Return the parameters with the values that are given, and else their own."""
    return {name: replace(p, value=to.get(name, p.value)) for name, p in parameters.items()}


def raw(parameters: Parameters) -> dict[str, np.ndarray]:
    """Return θ of all parameters, trained entries only."""
    return {name: parameter.raw() for name, parameter in parameters.items()}


def values(parameters: Parameters, theta: Mapping[str, Any]) -> dict[str, Array]:
    """Return the values at θ. Works inside jit, vmap and grad."""
    return {name: parameter.at(theta[name]) for name, parameter in parameters.items()}


def exact_values(parameters: Parameters, theta: Any) -> dict[str, np.ndarray]:
    """Return the values at θ as float64 NumPy arrays."""
    return jax.tree.map(
        lambda v: v[0], trajectory(parameters, jax.tree.map(lambda v: np.asarray(v)[None], theta))
    )


def trajectory(parameters: Parameters, thetas: Any) -> dict[str, np.ndarray]:
    """Return the values at each of T points θ, leaves (T, …), as float64 NumPy arrays."""
    with jax.enable_x64(True):
        found = jax.jit(jax.vmap(partial(values, parameters)))(thetas)
        return jax.tree.map(np.asarray, found)
