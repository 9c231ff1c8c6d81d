"""The type of numbers in arguments of public functions."""

from collections.abc import Sequence
from typing import TypeAlias

from jax.typing import ArrayLike

# A number, an array of JAX or NumPy, or lists of these: not a text.
Reals: TypeAlias = ArrayLike | Sequence[ArrayLike] | Sequence[Sequence[ArrayLike]]
