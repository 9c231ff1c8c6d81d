"""Limits of joints and outputs as sets, and by how much points violate limits.

`row_violations`, `worst_violation` and `rows_kept` work on NumPy arrays, and on JAX arrays,
traced or not.
"""

from collections.abc import Sequence
from types import ModuleType
from typing import Any, TypeAlias, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

from jaxmpc.arrays import Reals, host_array
from jaxmpc.checks import entries, fail, require_finite
from jaxmpc.pytrees import record
from jaxmpc.sets.convex_sets import Box, Polytope, product

# A limit counts as kept where it is exceeded by at most this, in parts of the bound, as float32
# holds 150 N m only to 1e-5; see `rows_kept`.
TOLERANCE = {"float64": 1e-6, "float32": 1e-4}

# A set, rows (H, lower, upper) of lower ≤ H x ≤ upper, or None for none.
Limits: TypeAlias = Box | Polytope | tuple[Reals, Reals, Reals] | None
Values = TypeVar("Values", jax.Array, np.ndarray)
# A limit as `joint_limits` takes it.
Limit = float | Reals | tuple[Reals, Reals] | None


@record
class JointLimits:
    """Limits of n joints with the state x = (q, dq) in R^2n and the torques u in R^n.

    states: Polytope in R^2n, a labelled row for each limit. inputs: Box in R^n.
    state_names, state_units: 2n each; input_names, input_units: n each.
    """

    states: Polytope
    inputs: Box
    state_names: tuple[str, ...]
    state_units: tuple[str, ...]
    input_names: tuple[str, ...]
    input_units: tuple[str, ...]

    @property
    def names(self) -> dict[str, tuple[str, ...]]:
        """Return the names and units as LinearSystem takes them: LinearSystem(A, B,
        **limits.names)."""
        keys = ("state_names", "state_units", "input_names", "input_units")
        return {key: getattr(self, key) for key in keys}


def joint_limits(
    position: Limit = None,
    velocity: Limit = None,
    torque: Limit = None,
    *,
    names: Sequence[str] | None = None,
    units: Sequence[str | Sequence[str]] = ("rad", "rad/s", "N m"),
) -> JointLimits:
    """Return the limits of a robot's joints as sets, for x = (q, dq), q in R^n, and u the n
    torques.

    Arguments:
        position, velocity, torque: (lower, upper), each a number for all joints or (n,) with
            -inf or inf for no bound; one number v for |.| <= v; None for no limit.
        names: of the n joints. Without names they are q1..qn, and n is the length of the
            limits given as arrays (1 if there is none).
        units: of position, velocity and torque; each a string, or n strings.

    Returns JointLimits. With S_q = [I 0] and S_dq = [0 I], `states` is G_x x <= g_x,
        G_x = [S_q; -S_q; S_dq; -S_dq],  g_x = (q_max, -q_min, dq_max, -dq_min),
    without the rows of infinite bounds; `inputs` is the Box of the
    torques. Rows are named after joints, such as "q1 <= 1.5 rad" and "dq1 >= -2 rad/s", or with
    the joint's own name "elbow <= 1.5 rad" and "elbow velocity >= -2 rad/s".

    Raises ValueError for limits that are not pairs, of different lengths, NaN or empty.
    """
    if names is not None:
        names = strings("names", names)
    units = entries("units", units, "Give three, of position, velocity and torque")
    limits = {"position": position, "velocity": velocity, "torque": torque}
    pairs = {key: limit_pair(key, value) for key, value in limits.items()}
    ends = [(key, end) for key, pair in pairs.items() for end in pair]
    n = max((end.size for _, end in ends if end.ndim), default=1) if names is None else len(names)
    for key, value in limits.items():
        require_one_reading(key, value, n)
    for key, end in ends:
        if end.shape not in ((), (n,)):
            fail(key, f"{end.size} entries for {n} joints", "Give one a joint, or a number")
    if len(units) != 3:
        fail("units", f"{units!r} is not one of position, velocity, torque", "Give three")
    if names is None:
        numbers = range(1, n + 1)
        q, dq, tau = ([f"{letter}{i}" for i in numbers] for letter in ("q", "dq", "tau"))
    else:
        q, dq, tau = ([name + what for name in names] for what in ("", " velocity", " torque"))
    unit = [[u] * n if isinstance(u, str) else strings("units", u) for u in units]
    if any(len(u) != n for u in unit):
        fail("units", f"{units!r} does not fit {n} joints", "Give a string, or one a joint")
    selector = np.eye(2 * n)
    positions = output_limits(selector[:n], *pairs["position"], q, unit[0], "position")
    velocities = output_limits(selector[n:], *pairs["velocity"], dq, unit[1], "velocity")
    inputs = Box(*(np.broadcast_to(end, n).copy() for end in pairs["torque"]))
    inputs.validate("torque", n)
    return JointLimits(
        positions.intersect(velocities),
        inputs,
        (*q, *dq),
        (*unit[0], *unit[1]),
        tuple(tau),
        tuple(unit[2]),
    )


def output_limits(
    C: Reals,
    lower: Reals | None,
    upper: Reals | None,
    names: Sequence[str] = (),
    units: Sequence[str] = (),
    argument: str = "limits",
) -> Polytope:
    """Return {x : lower <= C x <= upper} as [C; -C] x <= (upper, -lower), infinite rows dropped.

    Arguments:
        C: (p, n), one row an output.
        lower, upper: numbers or (p,); -inf, inf or None for no bound.
        names, units: of the p outputs, for the rows' labels; default y1..yp and no units.
        argument: what errors call the limits.

    Raises ValueError for wrong shapes, NaN, or lower > upper.
    """
    C = host_array("C", C)
    if C.ndim != 2 or 0 in C.shape:
        fail("C", f"shape {C.shape} is not (p, n)", "Give one row an output")
    require_finite("C", C)
    p = len(C)
    ends = []
    for name, value, free in (("lower", lower, -np.inf), ("upper", upper, np.inf)):
        end = host_array(f"{argument}.{name}", free if value is None else value)
        if end.shape not in ((), (p,)):
            fail(f"{argument}.{name}", f"shape {end.shape} is not ({p},)", "Give one an output")
        ends.append(np.broadcast_to(end, p))
    Box(*ends).validate(argument, p)
    names, units = strings("names", names), strings("units", units)
    for name, given in (("names", names), ("units", units)):
        if len(given) not in (0, p):
            fail(name, f"{given!r} is not one string an output", f"Give {p} strings, or none")
    names = names or [f"y{i + 1}" for i in range(p)]
    units = units or [""] * p
    H = np.vstack([C, -C]) + 0.0  # no -0.0
    h = np.concatenate([ends[1], -ends[0]]) + 0.0
    texts = [f"<= {end:.6g}" for end in ends[1]] + [f">= {end:.6g}" for end in ends[0]]
    rows = np.flatnonzero(np.isfinite(h)).tolist()
    labels = tuple(f"{names[i % p]} {texts[i]} {units[i % p]}".rstrip() for i in rows)
    return Polytope(H[rows], h[rows], labels)


def strings(argument: str, values: Any) -> list[str]:
    """Return the strings of a sequence, checked."""
    found = entries(argument, values, "Give a list of strings")
    if not all(isinstance(text, str) for text in found):
        fail(argument, f"{found!r} are not strings", "Give a list of strings")
    return found


def limit_pair(argument: str, limit: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return (lower, upper) of a limit given as in `joint_limits`."""
    if limit is None:
        return np.array(-np.inf), np.array(np.inf)
    if not isinstance(limit, tuple | list) and np.ndim(limit) == 0:
        bound = host_array(argument, limit)
        if bound < 0:
            fail(argument, f"{limit!r} is negative", "Give v ≥ 0 for |.| ≤ v, or (lower, upper)")
        return -bound, bound
    if len(limit) != 2:
        each = "each a number or one a joint, or one number v for |.| ≤ v"
        fail(argument, f"{limit!r} is not a pair", f"Give (lower, upper), {each}")
    return host_array(argument, limit[0]), host_array(argument, limit[1])


def require_one_reading(argument: str, limit: Any, count: int) -> None:
    """Raise where two numbers for `count` = 2 coordinates may be meant as one limit each: those
    that leave out 0, read as (lower, upper)."""
    pair = isinstance(limit, tuple | list | np.ndarray) and not any(map(np.ndim, limit))
    if count != 2 or not pair or len(limit) != 2:
        return
    a, b = (float(v) for v in limit)
    if a > 0 or b < 0:
        each = f"([{-abs(a):g}, {-abs(b):g}], [{abs(a):g}, {abs(b):g}])"
        low, high = sorted((a, b))
        ends = f"([{low:g}, {low:g}], [{high:g}, {high:g}])"
        cure = f"Give {each} for one limit each, {ends} for lower and upper ends"
        fail(argument, f"[{a:g}, {b:g}] leaves out 0 as (lower, upper) of 2 coordinates", cure)


def row_violations(limits: Limits, x: Values) -> Values:
    """Return by how much points x (..., n) violate each row of some limits, in the unit of the
    row: (..., rows), 0 where a row is kept, NaN where x is not finite. A Box has one row a
    coordinate."""
    xp, value, lower, upper = _row_values(limits, x)
    return xp.maximum(xp.maximum(value - upper, lower - value), 0.0)


def worst_violation(limits: Limits, x: Values) -> Values:
    """Return the largest violation of each point, (...,): 0 where all rows are kept, NaN where x is
    not finite."""
    found = row_violations(limits, x)
    xp = _namespace(found)
    worst = xp.max(found, axis=-1, initial=0.0)
    # A maximum need not propagate NaN (XLA on CPUs).
    return xp.where(xp.any(xp.isnan(found), axis=-1), xp.nan, worst)


def rows_kept(limits: Limits, x: Values, dtype: DTypeLike | None = None) -> Values:
    """Return whether each point keeps each row to within `TOLERANCE`, (..., rows); False where x is
    not finite.

    The tolerance is in parts of the bound; of a bound that is smaller than the other one of its
    row, in parts of that or in the unit of the row, whichever is less. A bound below 1e-12 counts
    as zero, and rounding of the row is allowed for.

    dtype: the precision in which x was computed, if other than that of x.
    """
    xp, value, lower, upper = _row_values(limits, x)
    kind = np.dtype(xp.asarray(x).dtype if dtype is None else dtype)
    if kind.kind != "f":
        kind = np.dtype(value.dtype)
    relative, eps = TOLERANCE[str(kind)], float(np.finfo(kind).eps)
    size = lambda end: xp.where(xp.isfinite(end), xp.abs(end), 0.0)
    larger = xp.maximum(size(lower), size(upper))
    most = xp.where(larger > 1e-12, larger, 1.0)
    rounding = 4 * eps * _terms(limits, x)

    def room(end: Values) -> Values:
        return relative * xp.minimum(xp.maximum(1.0, size(end)), most) + rounding

    return (value - upper <= room(upper)) & (lower - value <= room(lower))


def _terms(limits: Any, x: Any) -> Any:
    """Return the sums |H| |x| (..., rows) of the sizes of the terms of each row."""
    if limits is None or isinstance(limits, Box):
        return _row_values(limits, abs(x))[1]
    H, lower, upper = limits.rows() if isinstance(limits, Polytope) else limits
    return _row_values((abs(H), lower, upper), abs(x))[1]


def _row_values(limits: Limits, x: Values) -> tuple[ModuleType, Values, Values, Values]:
    """Return NumPy or jax.numpy, H x (..., rows), NaN where x is not finite, and its bounds."""
    xp = _namespace(x, limits)
    x = xp.asarray(x)
    x = xp.where(xp.isfinite(x), x, xp.nan)
    if limits is None:
        return xp, x[..., :0], xp.zeros(0, x.dtype), xp.zeros(0, x.dtype)
    if isinstance(limits, Box):
        return xp, x, xp.asarray(limits.lower), xp.asarray(limits.upper)
    H, lower, upper = limits.rows() if isinstance(limits, Polytope) else limits
    H = xp.asarray(H).T
    return xp, product(xp, x, H), xp.asarray(lower), xp.asarray(upper)


def _namespace(*values: Any) -> ModuleType:
    """Return jax.numpy where one of the arrays is JAX's, else numpy."""
    return jnp if any(isinstance(v, jax.Array) for v in jax.tree.leaves(values)) else np
