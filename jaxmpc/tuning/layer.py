"""An MPC problem as a layer of a network: free parameters, and a pure function of them.

The layer keeps the problem, which nothing trains; what is learned are free real numbers θ, a dict
of arrays that any optimiser, module or checkpoint takes. `Parameter` maps them to weights that stay
positive definite, and so on. The derivative of a plan is that of the solution of its program
(Amos et al. 2018, Agrawal et al. 2019, NeurIPS), see `ADMM.differentiate` and `ADMM.smoothing`.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import reduce
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.arrays import Reals, host_array
from jaxmpc.checks import concrete, fail, require_kind, require_shape
from jaxmpc.mpc.controller import Controller
from jaxmpc.mpc.plan import Control, Plan
from jaxmpc.mpc.problem import MPC
from jaxmpc.qp.admm import ADMM, DEFAULT
from jaxmpc.systems.riccati import lqr
from jaxmpc.tuning.parameters import (
    Parameter,
    exact_values,
    is_diagonal,
    raw,
    require_parameters,
    values,
)

# Short names of what lies in the system, and of the terminal weight.
SHORT = {"A": "system.A", "B": "system.B", "c": "system.c", "P": "terminal_cost"}
TERMINAL_WEIGHTS = ("given", "lqr")
# Fields whose values are positive definite matrices, and others that stay positive.
MATRICES = ("Q", "R", "terminal_cost", "input_rate_weight")
POSITIVE = ("stage_weights", "rho", "quadratic", "radius")


class MPCLayer:
    """A differentiable MPC problem with some of its data learned: θ, x ↦ the input and its plan.

        layer = jm.tuning.MPCLayer(mpc, learn=("Q", "R", "A"))
        theta = layer.init()                        # {"Q": ..., "R": ..., "A": ...}, free numbers
        u = jax.vmap(layer, (None, 0))(theta, x).u  # (B, m), within the limits of the inputs

    Arguments:
        mpc: The problem; what is not learned stays as it is here.
        learn: Names of fields of the problem: "Q", "R", "P" or "terminal_cost", "stage_weights", …,
            with a dot those of its parts, "inputs.upper", "soft.rho"; "A", "B", "c" of the system.
            They may differ from step to step. Or a mapping of such names to a `Parameter`, which
            says the domain, the start and the entries that are trained. Where only names are given
            Q, R and other weights stay diagonal where they are, and positive definite; penalties
            stay positive; all else is real, and infinite limits stay as they are.
        solver: Settings of the solver: `smoothing` for derivatives that see limits before they are
            reached, `eps`, and so on.
        terminal_weight: "given": P is that of the problem, unless it is learned; "lqr": at each θ
            it is the P of `jm.lqr` for its A, B, Q and R, and so are the derivatives.

    A step of Adam moves every entry of θ by its learning rate. Of weights θ is a logarithm, of A, B
    and c the entry itself: 0.1 is a tenth of a weight and much of a model. Give these a learning
    rate of their own (`optax.multi_transform`).

    A layer is no pytree: in a module of Equinox mark it as static, in one of Flax it is already. It
    may be called in `jax.jit`, `jax.vmap`, `jax.grad`, `jax.lax.scan`. Raises ValueError for names
    that the problem does not have, for values that are not there (None), outside their domain or
    that the problem does not allow.
    """

    def __init__(
        self,
        mpc: MPC,
        learn: Sequence[str] | Mapping[str, Parameter] = ("Q", "R"),
        solver: ADMM = DEFAULT,
        terminal_weight: str = "given",
    ) -> None:
        require_kind("mpc", mpc, MPC)
        require_kind("solver", solver, ADMM)
        if terminal_weight not in TERMINAL_WEIGHTS:
            fail("terminal_weight", f"{terminal_weight!r}", 'Give "given" or "lqr"')
        if not concrete(mpc):
            fail("mpc", "holds traced arrays", "Make the layer outside jax.jit, and learn these")
        if not isinstance(learn, Iterable) or not all(isinstance(name, str) for name in learn):
            fail("learn", f"{learn!r}", 'Give names of what is learned, such as ("Q", "R")')
        names = [learn] if isinstance(learn, str) else list(learn)
        for i, name in enumerate(names):
            if same := [other for other in names[:i] if _path(other) == _path(name)]:
                fail("learn", f"names {name!r} as {same[0]!r} already", "Leave one of the two out")
        given = learn if isinstance(learn, Mapping) else {}
        mpc.validate()
        parts = {name: _at(mpc, name) for name in names}
        found = {n: given[n] if given else _parameter(n, value) for n, value in parts.items()}
        if not found:
            fail("learn", "names nothing", 'Give names of what is learned, such as ("Q", "R")')
        require_parameters(found, "learn")
        for name, parameter in found.items():
            if np.shape(parameter.value) != np.shape(parts[name]):
                shape = np.shape(parameter.value)
                fail(f"learn[{name!r}]", f"shape {shape}", f"Needed: {np.shape(parts[name])}")
        _replaced(mpc, {name: start.value for name, start in found.items()}).validate()
        solver.validate()
        if terminal_weight == "lqr":
            mpc.require_constant("the LQR is that of one problem", "A", "B", "Q", "R")
            if learned := {"P", "terminal_cost"} & set(found):
                problem = f"'lqr', and {learned.pop()} is learned itself"
                fail("terminal_weight", problem, "Leave one of the two out")
        self.mpc, self.solver, self.parameters = mpc, solver, found
        self.terminal_weight = terminal_weight

    def __repr__(self) -> str:
        learned = ", ".join(f"{name} ({p.domain})" for name, p in self.parameters.items())
        return f"MPCLayer(horizon {self.mpc.horizon}, learns {learned})"

    def init(self) -> dict[str, Array]:
        """Return θ at which the problem is as given: {name: (k,)}, entries that are trained."""
        return {name: jnp.asarray(v) for name, v in raw(self.parameters).items()}

    def values(self, theta: Mapping[str, Any]) -> dict[str, np.ndarray]:
        """Return what is learned at θ, as NumPy arrays."""
        self._require_theta(theta)
        return exact_values(self.parameters, theta)

    def problem(self, theta: Mapping[str, Any]) -> MPC:
        """Return the problem at θ, for any function that takes one. Works inside jit and grad."""
        self._require_theta(theta)
        mpc = _replaced(self.mpc, values(self.parameters, theta))
        if self.terminal_weight == "lqr":
            mpc = replace(mpc, terminal_cost=lqr(mpc.system, mpc.Q, mpc.R).P)
        return mpc

    def controller(self, theta: Mapping[str, Any]) -> Controller:
        """Return the controller at θ: of many calls with one θ, such as a closed loop, the problem
        is condensed and factored once."""
        return Controller(self.problem(theta), self.solver)

    def start(self, theta: Mapping[str, Any], x: Reals) -> Control[Plan]:
        """Return what stands for the time step before the first, to carry through
        `jax.lax.scan`."""
        return self.controller(theta).start(jnp.asarray(x))

    def __call__(
        self,
        theta: Mapping[str, Any],
        x: Reals,
        before: Control[Plan] | None = None,
        reference: Reals | None = None,
        **aim: Any,
    ) -> Control[Plan]:
        """Return the input u (m,) at x (n,), its plan, and what the next call goes on from.

        before: what the last call returned, for a warm start; None for none. reference, aim
        (input_reference, previous_input, forecast): as in `jm.solve`. u is within the limits of the
        inputs if these are a Box, and finite, also where there is no plan; `plan.solved` is the
        mask of a loss.
        """
        return self.controller(theta)(x, before, reference, **aim)

    def _require_theta(self, theta: Any) -> None:
        require_kind("theta", theta, Mapping, cure="Give a dict of arrays, as from init()")
        if set(theta) != set(self.parameters):
            given, needed = ", ".join(theta), ", ".join(self.parameters)
            fail("theta", f"has the names {given or 'none'}", f"Needed: {needed}, as from init()")
        for name, parameter in self.parameters.items():
            shape = parameter.raw().shape
            require_shape(f"theta[{name!r}]", theta[name], shape, "Give θ as from init()")


def _path(name: str) -> list[str]:
    return SHORT.get(name, name).split(".")


def _at(mpc: MPC, name: str) -> np.ndarray:
    """Return what lies at a name in the problem; ValueError where there is nothing."""
    known = 'such as "Q", "R", "P", "A", "B", "c", "inputs.upper"'
    *parts, last = _path(name)
    part: Any = mpc
    try:
        part = reduce(_part, parts, mpc)
        value = _part(part, last)
    except (AttributeError, IndexError):
        if (part is None or (isinstance(part, tuple) and not part)) and hasattr(mpc, parts[0]):
            problem = f"{'.'.join(parts)!r} is {part} in the problem"
            fail("learn", problem, f"Give it, with {last!r} to start from")
        fail("learn", f"{name!r} is no field of the problem", f"Give names {known}")
    part = _alone(part)
    field = getattr(part, "__dataclass_fields__", {}).get(last)
    if field is None:  # a property, or an attribute of an array
        fail("learn", f"{name!r} is no field of the problem", f"Give names {known}")
    if field.metadata.get("static"):
        fail("learn", f"{name!r} is a constant of the problem", f"Give names {known}")
    if value is None:
        fail("learn", f"{name!r} is None in the problem", "Give it a value to start from")
    if not isinstance(value, float | int | np.ndarray | Array):
        kind = type(value).__name__
        fail("learn", f"{name!r} is a {kind} in the problem", "Name an array, such as a part of it")
    return host_array(name, value)


def _part(whole: Any, name: str) -> Any:
    """Return a field, or the part of a tuple with this number. Of a tuple with one part the number
    may be left out: "soft.rho" for "soft.0.rho"."""
    if isinstance(whole, tuple) and name.isdecimal():
        return whole[int(name)]
    return getattr(_alone(whole), name)


def _alone(whole: Any) -> Any:
    return whole[0] if isinstance(whole, tuple) and len(whole) == 1 else whole


def _parameter(name: str, value: np.ndarray) -> Parameter:
    """Return the parameter that starts at the value, in the domain of its field."""
    field = _path(name)[-1]
    if field in MATRICES and value.ndim >= 2:
        return Parameter(value, "diagonal" if is_diagonal(value) else "definite")
    if field in (*MATRICES, *POSITIVE):
        return Parameter(value, "positive")
    return Parameter(value, train=np.isfinite(value))


def _replaced(mpc: MPC, values: Mapping[str, Any]) -> MPC:
    """Return the problem with other values at these names."""
    return reduce(lambda mpc, name: _with(mpc, _path(name), values[name]), values, mpc)


def _with(part: Any, path: list[str], value: Array) -> Any:
    """Return the problem, or a part of it, with another value at a path."""
    first, *rest = path
    if isinstance(part, tuple):
        i, rest = (int(first), rest) if first.isdecimal() else (0, path)
        return (*part[:i], _with(part[i], rest, value), *part[i + 1 :])
    inner = _with(getattr(part, first), rest, value) if rest else value
    return replace(part, **{first: inner})
