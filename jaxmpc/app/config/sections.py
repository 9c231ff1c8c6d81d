"""The sections of a problem's TOML file: which keys each has, and which values they take."""

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, AllowInfNan, BeforeValidator, ConfigDict, Field, Strict
from pydantic.dataclasses import dataclass

from jaxmpc.checks import MOST_COUNT


def _infinity(value: Any) -> Any:
    """Return the number for the texts that `Config.to_dict` writes, JSON having none."""
    return float(value) if value in ("Infinity", "-Infinity") else value


def _not_nan(value: float) -> float:
    if np.isnan(value):
        raise ValueError("is NaN; use inf or -inf where there is no limit")
    return value


def _rectangular(rows: tuple[tuple[float, ...], ...]) -> tuple[tuple[float, ...], ...]:
    if len({len(row) for row in rows}) != 1 or not rows[0]:
        raise ValueError("is no matrix: give at least one row and rows of one length")
    return rows


STRICT = ConfigDict(extra="forbid", ser_json_inf_nan="strings")

# Strict: true and "1.0" are no numbers, 1 and "yes" no booleans.
Number = Annotated[float, Strict(), AllowInfNan(False)]
Whole = Annotated[int, Strict(), Field(le=MOST_COUNT)]
Switch = Annotated[bool, Strict()]
Limit = Annotated[float, Strict(), AfterValidator(_not_nan), BeforeValidator(_infinity)]
Limits = tuple[Limit, ...]
Vector = tuple[Number, ...]
Matrix = Annotated[tuple[Vector, ...], AfterValidator(_rectangular)]


@dataclass(frozen=True, kw_only=True, config=STRICT)
class SystemSection:
    """x⁺ = A x + B u + c, or with `continuous` dx/dt = A x + B u + c held over dt."""

    A: Matrix  # (n, n)
    B: Matrix  # (n, m)
    c: Vector | None = None  # (n,), none means zero
    dt: Annotated[Number, Field(gt=0)]  # seconds
    continuous: Switch = False  # True: convert by zero-order hold
    state_names: tuple[str, ...] | None = None
    state_units: tuple[str, ...] | None = None
    input_names: tuple[str, ...] | None = None
    input_units: tuple[str, ...] | None = None


@dataclass(frozen=True, kw_only=True, config=STRICT)
class LimitsSection:
    """Box limits of states and inputs, or H_x x <= h_x in place of the state box."""

    x_min: Limits | None = None  # (n,), -inf where free
    x_max: Limits | None = None  # (n,), inf where free
    # Fraction of the half-width of x_min, x_max that the MPC keeps away from them, on each side.
    margin: Annotated[Number, Field(ge=0, lt=1)] = 0.0
    H_x: Matrix | None = None  # (r, n)
    h_x: Vector | None = None  # (r,)
    u_min: Vector  # (m,)
    u_max: Vector  # (m,)


@dataclass(frozen=True, kw_only=True, config=STRICT)
class CostSection:
    """J = Σ x'Qx + u'Ru + x_N'P x_N, without ½. A flat list is a diagonal."""

    Q: Vector | Matrix
    R: Vector | Matrix
    P: Literal["lqr", "Q", "none"] | Vector | Matrix = "lqr"  # "lqr": the Riccati solution
    # L1 weight that makes state and terminal limits soft in the controller; "exact": the least one
    # that changes nothing where they can be kept, and a margin. Sets are those of the hard limits.
    rho: Annotated[Number, Field(ge=0)] | Literal["exact"] | None = None


@dataclass(frozen=True, kw_only=True, config=STRICT)
class MPCSection:
    """Horizon and terminal set: "invariant" = O_inf of the LQR, "ellipsoid" = largest level set of
    its cost inside the limits, "box" = the state limits; or the set itself."""

    horizon: Annotated[Whole, Field(ge=1)]
    terminal: Literal["none", "invariant", "ellipsoid", "box"] = "none"
    H_f: Matrix | None = None  # (r, n): H_f x_N <= h_f
    h_f: Vector | None = None  # (r,)
    P_f: Matrix | None = None  # (n, n): x_N'P_f x_N <= level_f
    level_f: Annotated[Number, Field(gt=0)] | None = None
    control_horizon: Annotated[Whole, Field(ge=1)] | None = None  # free inputs
    constrain_initial: Switch = True  # False: no state limits at k = 0


@dataclass(frozen=True, kw_only=True, config=STRICT)
class SweepSection:
    """The initial states of a sweep: a grid over the mapped states."""

    grid: Annotated[tuple[Annotated[Whole, Field(ge=2)], ...], Field(min_length=1)] | None = None
    lower: Vector | None = None  # (d,), none means the state limits widened by 3 % each side
    upper: Vector | None = None  # (d,)
    axes: tuple[Whole | str, ...] | None = None  # names or indices, none means the first two
    fixed: Vector | None = None  # (n - d,) values of the other states: a slice
    projection: Switch = False  # True: some value of the other states
    iterations: Annotated[Whole, Field(ge=1)] = 50  # ADMM steps in the first pass over all states
    dtype: Literal["float32", "float64"] = "float32"  # of the iterates; proofs are float64


@dataclass(frozen=True, kw_only=True, config=STRICT)
class RecursionSection:
    """How recursive feasibility is examined: sample states, closed loops, effort."""

    steps: Annotated[Whole, Field(ge=1)] = 20  # length of the closed loops
    grid: Annotated[tuple[Annotated[Whole, Field(ge=2)], ...], Field(min_length=1)] | None = None
    lower: Vector | None = None  # (n,), none means the state limits widened by 3 % each side
    upper: Vector | None = None  # (n,)
    regions: Annotated[Whole, Field(ge=0)] = 2000  # critical regions at most, 0: none
    seconds: Annotated[Number, Field(gt=0)] = 60.0  # for search and proofs


@dataclass(frozen=True, kw_only=True, config=STRICT)
class SolverSection:
    """ADMM as the controller runs it; see `ADMM`. What jaxmpc tune solver learns."""

    iterations: Annotated[Whole, Field(ge=0)] = 50
    # Number, one a row of the QP, or (stages, rows); None: chosen from the problem.
    rho: Number | Vector | Matrix | None = None
    alpha: Annotated[Number, Field(gt=0, lt=2)] = 1.9
    # Newton steps after them at most; None: as `ADMM`.
    newton_steps: Annotated[Whole, Field(ge=0)] | None = None


def to_matrix(value: Any) -> np.ndarray:
    """Return a weight as a matrix (n, n); a flat list is a diagonal."""
    array = np.asarray(value, dtype=np.float64)
    return np.diag(array) if array.ndim == 1 else array
