"""The type of numbers in arguments of public functions."""

from collections.abc import Sequence
from typing import TypeAlias

from jax.typing import ArrayLike

# A number, an array of JAX or NumPy, or lists of these: not a text.
# (One Sequence: with two a type checker finds none for rows like [[1, 0.1], [0, 1]].)
Reals: TypeAlias = ArrayLike | Sequence[ArrayLike | Sequence[ArrayLike]]
