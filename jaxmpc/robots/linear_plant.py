"""A linear system as a plant, behind the interface of robots."""

from dataclasses import replace
from typing import Any

import numpy as np
from jax import Array

from jaxmpc.arrays import dimensions
from jaxmpc.checks import fail, require_kind, require_shape
from jaxmpc.mpc.steady_state import equilibrium
from jaxmpc.pytrees import pytree, static
from jaxmpc.sets.convex_sets import Box
from jaxmpc.systems.system import LinearSystem


@pytree
class LinearPlant:
    """A linear plant x⁺ = A x + B u + c with limits and the interface of `Robot`.

    system: LinearSystem with dt. state_limits (n,), input_limits (m,): Boxes, ±inf for no limit.
    home (n,): set-point, zeros if not given.
    """

    system: LinearSystem
    state_limits: Box
    input_limits: Box
    home: Any = None
    name: str = static(default="linear")

    def __post_init__(self) -> None:
        if not isinstance(self.system, LinearSystem) or dimensions(self.system.A) != 2:
            return  # what JAX puts in place of arrays
        if self.home is None:
            object.__setattr__(self, "home", np.zeros(self.n))
        for name, size in (("state_limits", self.n), ("input_limits", self.m)):
            if isinstance(getattr(self, name), Box):
                object.__setattr__(self, name, getattr(self, name).spread(size))

    def validate(self) -> None:
        """Raise ValueError for a bad system, or limits of other sizes."""
        require_kind("system", self.system, LinearSystem)
        self.system.validate()
        if self.system.dt is None:
            fail("system.dt", "is None", "Give the sampling period, in seconds or in time_unit")
        self.state_limits.validate("state_limits", self.n)
        self.input_limits.validate("input_limits", self.m)

    @property
    def n(self) -> int:
        """Return the number of states."""
        return self.system.n

    @property
    def m(self) -> int:
        """Return the number of inputs."""
        return self.system.m

    @property
    def state_size(self) -> int:
        """Return the length of the state, n."""
        return self.system.n

    @property
    def state_names(self) -> tuple[str, ...]:
        """Return the names of the states, if the system has any."""
        return self.system.state_names

    @property
    def dt(self) -> float:
        """Return the control period, in the system's unit of time."""
        assert self.system.dt is not None
        return self.system.dt

    @property
    def time_unit(self) -> str:
        """Return the unit of the control period."""
        return self.system.time_unit

    def step(self, x: Any, u: Any) -> Array:
        """Return the next state (n,)."""
        return self.system.step(x, u)

    def linearize(self, x: Any, u: Any, *, exact: bool = True) -> LinearSystem:
        """Return the system itself, for all x and u."""
        return self.system

    def coordinates(self, x: Any) -> Any:
        """Return x itself."""
        return x

    def state(self, coordinates: Any) -> Any:
        """Return the coordinates themselves."""
        return coordinates

    def equilibrium(self, x: Any = None) -> tuple[np.ndarray, np.ndarray]:
        """Return (x, u): the state x (n,), None for home, and the input that holds it
        (`jaxmpc.mpc.steady_state`). Raises ValueError where none does, or only beyond the
        limits."""
        target = self.home if x is None else x
        return equilibrium(self.system, target, states=self.state_limits, inputs=self.input_limits)

    def set_point(self, target: Any = None) -> tuple[np.ndarray, np.ndarray]:
        """Return `equilibrium(target)`, as a Robot does that rests at its home."""
        return self.equilibrium(target)

    def vary(self, **numbers: Any) -> "LinearPlant":
        """Return the plant with another A, B or c."""
        strange = set(numbers) - {"A", "B", "c"}
        if strange:
            fail(sorted(strange)[0], "is no parameter of a linear plant", "Give A, B or c")
        shapes = {"A": (self.n, self.n), "B": (self.n, self.m), "c": (self.n,)}
        for name, value in numbers.items():
            require_shape(name, value, shapes[name], "As in the plant's own system")
        return replace(self, system=replace(self.system, **numbers))
