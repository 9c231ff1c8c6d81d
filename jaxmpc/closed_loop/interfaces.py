"""What a closed loop needs of a controller and of a plant."""

from typing import Any, Protocol

from jax import Array

from jaxmpc.mpc.plan import Control
from jaxmpc.mpc.problem import MPC


class Plant(Protocol):
    """A plant: its state one time step later. Written in JAX.

    Where it has them, also `state_size` and `m`, the sizes of state and input; `coordinates(x)` and
    `state(ξ)` between states and the coordinates in which controllers are written; and
    `vary(**numbers)`, the same plant with other parameters.
    """

    def step(self, x: Any, u: Any) -> Array:
        """Return the next state."""
        ...


class Feedback(Protocol):
    """A controller: `jm.Controller`, `RobotController`, `LinearFeedback`, or another such object.

    mpc: whose horizon and weights evaluate the loop. dtype: the precision of the inputs.
    state_size: the length of the plant's state. limits: by which the plant's states are evaluated.
    """

    @property
    def mpc(self) -> MPC: ...
    @property
    def dtype(self) -> Any: ...
    @property
    def state_size(self) -> int: ...
    @property
    def limits(self) -> Any: ...
    def coordinates(self, x: Array) -> Array:
        """Return the coordinates ξ (n,) of a state."""
        ...

    def start(self, x: Array, input_reference: Any = None) -> Control[Any]:
        """Return what stands for the time step before the first."""
        ...

    def __call__(
        self,
        x: Array,
        before: Any = None,
        reference: Any = None,
        *,
        input_reference: Any = None,
        previous_input: Any = None,
    ) -> Control[Any]:
        """Return the input at the state x, its plan, and what to remember."""
        ...
