"""The condensed rows of an MPC problem on the host, in float64, as one-sided inequalities."""

from typing import NamedTuple

import jax
import numpy as np

from jaxmpc.mpc.condense import Condensed, condense, in_float64
from jaxmpc.mpc.problem import MPC


def condensed_in_float64(mpc: MPC) -> Condensed:
    """`condense(mpc)`, every array a float64 array of NumPy."""
    with jax.enable_x64(True):
        return jax.tree.map(np.asarray, condense(in_float64(mpc)))


class Inequalities(NamedTuple):
    """C z + D θ ≤ b: one row for each finite bound of a condensed problem, balls left out.

    C (r, nz), D (r, p), b (r,). row (r,): which row of the condensed problem it is; side (r,): 1
    for its upper bound, −1 for its lower one.
    """

    C: np.ndarray
    D: np.ndarray
    b: np.ndarray
    row: np.ndarray
    side: np.ndarray

    @classmethod
    def of(cls, c: Condensed) -> "Inequalities":
        """The inequalities of a condensed problem whose arrays are NumPy's."""
        linear = len(c.C) - sum(c.balls)
        upper, lower = (np.flatnonzero(np.isfinite(v[:linear])) for v in (c.upper, c.lower))
        row, side = np.append(upper, lower), np.repeat([1.0, -1.0], [len(upper), len(lower)])
        b = side * (np.where(side > 0, c.upper[row], c.lower[row]) - c.d[row])
        return cls(side[:, None] * c.C[row], side[:, None] * c.D[row], b, row, side)

    def normalised(self) -> tuple["Inequalities", np.ndarray]:
        """The same inequalities with rows (C, D) of length 1, and the lengths (r,) they had."""
        length = row_lengths(np.hstack([self.C, self.D]))
        C, D = self.C / length[:, None], self.D / length[:, None]
        return self._replace(C=C, D=D, b=self.b / length), length


def row_lengths(M: np.ndarray) -> np.ndarray:
    """Return the norm of each row of M, and 1 for a row of zeros."""
    length = np.linalg.norm(M, axis=1)
    return np.where(length > 0, length, 1.0)
