"""Equilibria of a linear system: the steady state and input that a reference requires."""

import numpy as np
from scipy.optimize import lsq_linear

from jaxmpc.arrays import Reals, host_array
from jaxmpc.checks import fail, require_finite, require_shape
from jaxmpc.sets.convex_sets import Box
from jaxmpc.systems.system import LinearSystem, host_matrices


def equilibrium(
    system: LinearSystem,
    target: Reals,
    *,
    C: Reals | None = None,
    states: Box | None = None,
    inputs: Box | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return (x, u) with x = A x + B u + c and C x = target: what to track and the input that holds
    it.

    target (p,): of the outputs C x, C (p, n); without C of all states. Of several equilibria it is
    the one of least norm, if that keeps the limits. states, inputs: Box limits to stay in, or None.
    Give x and u to `solve` as reference and input_reference, so that the cost vanishes there.

    Raises ValueError where no equilibrium meets the target, within the limits if there are any: the
    message says how far the closest one stays from it. NumPy in float64; not traceable; residual
    below 1e-11 + 1e-9 times the size of its terms.
    """
    if not isinstance(system, LinearSystem):
        fail("system", f"is a {type(system).__name__}", "Give a jm.LinearSystem")
    system.validate()
    n, m = system.n, system.m
    C = np.eye(n) if C is None else host_array("C", C)
    if C.ndim != 2 or C.shape[1] != n:
        fail("C", f"shape {C.shape}", f"Give (p, {n}), one column a state")
    require_finite("C", C)
    require_shape("target", target, (len(C),), "One value for each row of C")
    target = host_array("target", target)
    require_finite("target", target)
    A, B, c = host_matrices(system)
    M = np.block([[np.eye(n) - A, -B], [C, np.zeros((len(C), m))]])
    value = np.concatenate([c, target])
    low, high = np.full(n + m, -np.inf), np.full(n + m, np.inf)
    for set_, part, name, size in (
        (states, slice(0, n), "states", n),
        (inputs, slice(n, n + m), "inputs", m),
    ):
        if set_ is not None:
            if not isinstance(set_, Box):
                fail(name, f"is a {type(set_).__name__}", "Give a Box, or None")
            set_.validate(name, size)
            low[part], high[part] = np.asarray(set_.lower, float), np.asarray(set_.upper, float)
    found = np.linalg.lstsq(M, value, rcond=None)[0]
    if not np.all((low <= found) & (found <= high)):
        # bvls: an active-set method, exact up to rounding. Fixed entries are its open case.
        width = np.where(high > low, 0.0, 1e-12 * (1 + np.abs(high)))
        found = lsq_linear(M, value, (low - width, high + width), method="bvls", tol=1e-15).x
        found = np.clip(found, low, high)
    error = M @ found - value
    size = np.abs(M) @ np.abs(found) + np.abs(value)
    if not np.all(np.abs(error) <= 1e-11 + 1e-9 * size):
        closest = C @ found[:n]
        drift = np.abs(error[:n]).max()
        away = f"the closest has outputs {closest} and drifts by {drift:.3g} a step"
        what = f"{target} is held by no equilibrium ({away})"
        fail("target", what, "Choose another target or widen the limits")
    return found[:n], found[n:]
