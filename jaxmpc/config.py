"""A problem and what to ask of it, as a TOML file: read, checked, turned into an MPC, written.

    name = "joint"

    [system]  A, B, c, dt, continuous, state_names, state_units, input_names, input_units
    [limits]  x_min, x_max, margin  or  H_x, h_x;  u_min, u_max
    [cost]    Q, R, P, rho
    [mpc]     horizon, terminal  or  H_f, h_f  or  P_f, level_f;  constrain_initial, control_horizon
    [solver]  iterations, rho, alpha, refine
    [sweep]   grid, lower, upper, axes, fixed | projection, iterations, dtype
    [recursion]  steps, grid, lower, upper, regions, seconds

The fields below say what each key means. Every error is a ValueError that names the
file and the key (or the option of the command line that set it) and what would be right.
A robot's weights have a file of their own, with the sections [robot] and [cost].
"""

import dataclasses
import json
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import tomli_w
from pydantic import AfterValidator, ConfigDict, Field, FiniteFloat, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass

from jaxmpc.checks import fail
from jaxmpc.control.named_terminal import named_terminal_set
from jaxmpc.control.riccati import lqr
from jaxmpc.control.sets import Box, Ellipsoid, Polytope
from jaxmpc.control.system import LinearSystem
from jaxmpc.explicit.exact_penalty import exact_penalty
from jaxmpc.feasible.map import grid as grid_points
from jaxmpc.mpc.problem import MPC
from jaxmpc.mpc.soften import soften
from jaxmpc.qp.admm import ADMM


def _not_nan(value: float) -> float:
    if np.isnan(value):
        raise ValueError("is NaN; use inf or -inf where there is no limit")
    return value


def _rectangular(rows: tuple[tuple[float, ...], ...]) -> tuple[tuple[float, ...], ...]:
    if len({len(row) for row in rows}) != 1:
        raise ValueError("is no matrix: give at least one row and rows of one length")
    return rows


_STRICT = ConfigDict(extra="forbid", ser_json_inf_nan="strings")

Limit = Annotated[float, AfterValidator(_not_nan)]
Limits = tuple[Limit, ...]
Vector = tuple[FiniteFloat, ...]
Matrix = Annotated[tuple[Vector, ...], AfterValidator(_rectangular)]


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class SystemSection:
    """x⁺ = A x + B u + c, or with `continuous` dx/dt = A x + B u + c held over dt."""

    A: Matrix  # (n, n)
    B: Matrix  # (n, m)
    c: Vector | None = None  # (n,), none means zero
    dt: Annotated[FiniteFloat, Field(gt=0)]  # seconds
    continuous: bool = False  # True: convert by zero-order hold
    state_names: tuple[str, ...] | None = None
    state_units: tuple[str, ...] | None = None
    input_names: tuple[str, ...] | None = None
    input_units: tuple[str, ...] | None = None


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class LimitsSection:
    """Box limits of states and inputs, or H_x x <= h_x in place of the state box."""

    x_min: Limits | None = None  # (n,), -inf where free
    x_max: Limits | None = None  # (n,), inf where free
    # Share of the half-width of x_min, x_max that the MPC keeps away from them, on each side.
    margin: Annotated[FiniteFloat, Field(ge=0, lt=1)] = 0.0
    H_x: Matrix | None = None  # (r, n)
    h_x: Vector | None = None  # (r,)
    u_min: Vector  # (m,)
    u_max: Vector  # (m,)


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class CostSection:
    """J = Σ x'Qx + u'Ru + x_N'P x_N, without ½. A flat list is a diagonal."""

    Q: Vector | Matrix
    R: Vector | Matrix
    P: Literal["lqr", "Q", "none"] | Vector | Matrix = "lqr"  # "lqr": the Riccati solution
    # L1 weight that makes state and terminal limits soft in the controller; "exact": the least one
    # that changes nothing where they can be kept, and a margin. Sets are those of the hard limits.
    rho: Annotated[FiniteFloat, Field(ge=0)] | Literal["exact"] | None = None


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class MPCSection:
    """Horizon and terminal set: "invariant" = O_inf of the LQR, "ellipsoid" = largest level set of
    its cost inside the limits, "box" = the state limits; or the set itself."""

    horizon: Annotated[int, Field(ge=1, strict=True)]
    terminal: Literal["none", "invariant", "ellipsoid", "box"] = "none"
    H_f: Matrix | None = None  # (r, n): H_f x_N <= h_f
    h_f: Vector | None = None  # (r,)
    P_f: Matrix | None = None  # (n, n): x_N'P_f x_N <= level_f
    level_f: Annotated[FiniteFloat, Field(gt=0)] | None = None
    control_horizon: Annotated[int, Field(ge=1, strict=True)] | None = None  # free moves
    constrain_initial: bool = True  # False: no state limits at k = 0


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class SweepSection:
    """Which initial states are asked: a grid over the mapped states."""

    grid: Annotated[tuple[Annotated[int, Field(ge=2)], ...], Field(min_length=1)] | None = None
    lower: Vector | None = None  # (d,), none means the state limits widened by 3 % each side
    upper: Vector | None = None  # (d,)
    axes: tuple[int | str, ...] | None = None  # names or indices, none means the first two
    fixed: Vector | None = None  # (n - d,) values of the other states: a slice
    projection: bool = False  # True: some value of the other states
    iterations: Annotated[int, Field(ge=1)] = 50  # ADMM steps in the first pass over all states
    dtype: Literal["float32", "float64"] = "float32"  # of the iterates; proofs are float64


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class RecursionSection:
    """How recursive feasibility is examined: sample states, closed loops, effort."""

    steps: Annotated[int, Field(ge=1, strict=True)] = 20  # length of the closed loops
    grid: Annotated[tuple[Annotated[int, Field(ge=2)], ...], Field(min_length=1)] | None = None
    lower: Vector | None = None  # (n,), none means the state limits widened by 3 % each side
    upper: Vector | None = None  # (n,)
    regions: Annotated[int, Field(ge=0, strict=True)] = 2000  # critical regions at most, 0: none
    seconds: Annotated[FiniteFloat, Field(gt=0)] = 60.0  # for search and proofs


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class SolverSection:
    """ADMM as the controller runs it; see `ADMM`. What jaxmpc tune penalties learns."""

    iterations: Annotated[int, Field(ge=0, strict=True)] = 100
    rho: FiniteFloat | Vector | Matrix = 1.0  # number, one a row of the QP, or (stages, rows)
    alpha: Annotated[FiniteFloat, Field(gt=0, lt=2)] = 1.6
    refine: Annotated[int, Field(ge=0, strict=True)] = 20  # Newton steps after them


class SweepPoints(NamedTuple):
    """The initial states of a sweep, as `map_feasible_set` takes them."""

    points: np.ndarray  # (B, d)
    axes: tuple[int, ...]  # the d states mapped
    fixed: np.ndarray | None  # (n,) for a slice; None: all states mapped, or a projection


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class Config:
    """A problem and what is asked of it, as a file says it."""

    name: str = "mpc"
    system: SystemSection
    limits: LimitsSection
    cost: CostSection
    mpc: MPCSection
    sweep: SweepSection = SweepSection()
    recursion: RecursionSection = RecursionSection()
    solver: SolverSection | None = None

    @staticmethod
    def default(overrides: Mapping[str, Any] | None = None, command: str = "sweep") -> "Config":
        """The lesson's joint: inertia 0.05 kg m², period 0.01 s, x = (q, dq), u = τ."""
        return _parse(_JOINT, "built-in joint", overrides or {}, command)

    def to_dict(self, command: str = "sweep") -> dict[str, Any]:
        """The sections a command reads as plain JSON data; infinity is written "Infinity"."""
        data = json.loads(_ADAPTER.dump_json(self))
        return {key: part for key, part in data.items() if key == command or key not in _COMMANDS}

    def to_toml(self) -> str:
        """The file that `load` reads back as this very configuration."""
        return to_toml(_ADAPTER.dump_python(self, exclude_none=True))

    def build_mpc(self) -> MPC:
        """The problem itself, checked. Raises ValueError as `MPC.validate` does."""
        s, limits, cost = self.system, self.limits, self.cost
        make = LinearSystem.from_continuous if s.continuous else LinearSystem
        system = make(
            A=np.asarray(s.A),
            B=np.asarray(s.B),
            c=None if s.c is None else np.asarray(s.c),
            dt=s.dt,
            state_names=s.state_names or (),
            input_names=s.input_names or (),
            state_units=s.state_units or (),
            input_units=s.input_units or (),
        )
        states = self._states()
        if isinstance(states, Box) and limits.margin:
            states = states.tightened(limits.margin)
        inputs = Box(np.asarray(limits.u_min), np.asarray(limits.u_max))
        Q, R = _matrix(cost.Q), _matrix(cost.R)
        terminal_cost: Any = Q if cost.P == "Q" else None
        if not isinstance(cost.P, str):
            terminal_cost = _matrix(cost.P)
        terminal_set: Any = None
        if self.mpc.H_f is not None:
            terminal_set = Polytope(np.asarray(self.mpc.H_f), np.asarray(self.mpc.h_f))
        if self.mpc.P_f is not None:
            terminal_set = Ellipsoid(np.asarray(self.mpc.P_f), np.asarray(self.mpc.level_f))
        if cost.P == "lqr" or self.mpc.terminal != "none":
            law = lqr(system, Q, R)
            if cost.P == "lqr":
                terminal_cost = law.P
            if self.mpc.terminal != "none":
                terminal_set = named_terminal_set(self.mpc.terminal, system, law, states, inputs)
        mpc = MPC(
            system=system,
            Q=Q,
            R=R,
            horizon=self.mpc.horizon,
            states=states,
            inputs=inputs,
            terminal_cost=terminal_cost,
            terminal_set=terminal_set,
            constrain_initial=self.mpc.constrain_initial,
            control_horizon=self.mpc.control_horizon,
        )
        mpc.validate()
        return mpc

    def build_controlled(self) -> MPC:
        """The problem that the controller solves: that of `build_mpc`, softened by cost.rho."""
        mpc, rho = self.build_mpc(), self.cost.rho
        if rho is None:
            return mpc
        return soften(mpc, exact_penalty(mpc).advised if isinstance(rho, str) else rho)

    def build_solver(self) -> ADMM | None:
        """The solver of [solver]; None without that section."""
        if self.solver is None:
            return None
        rho = np.asarray(self.solver.rho, float)
        return ADMM(
            iterations=self.solver.iterations, rho=rho if rho.ndim else float(rho),
            alpha=self.solver.alpha, refine=self.solver.refine,
        )  # fmt: skip

    def state_limits(self) -> Box | Polytope | None:
        """The limits themselves, without the margin."""
        return self._states()

    def state_range(self) -> tuple[np.ndarray, np.ndarray]:
        """Ends (n,), (n,) of the smallest box round the state limits; ±inf where there is none."""
        states, n = self._states(), len(self.system.A)
        if isinstance(states, Box):
            return np.asarray(states.lower), np.asarray(states.upper)
        if isinstance(states, Polytope):
            corners = np.asarray(states.vertices())
            return corners.min(axis=0), corners.max(axis=0)
        return np.full(n, -np.inf), np.full(n, np.inf)

    def build_points(self) -> SweepPoints:
        """The grid of initial states and the axes it lies on."""
        axes = self._axes()
        lower, upper = self._bounds(axes, self.sweep)
        d = len(axes)
        # 256 along each of two axes; about as many points in all along more.
        shape = self.sweep.grid or (min(256, int(65_536.5 ** (1 / d))),) * d
        points = grid_points(lower, upper, shape)
        if self.sweep.fixed is None:
            return SweepPoints(points, axes, None)
        fixed = np.zeros(len(self.system.A))
        fixed[[i for i in range(len(fixed)) if i not in axes]] = self.sweep.fixed
        return SweepPoints(points, axes, fixed)

    def build(self) -> tuple[MPC, SweepPoints]:
        """The problem and the initial states to ask."""
        points = self.build_points()
        return self.build_mpc(), points

    def build_samples(self) -> np.ndarray | None:
        """States (B, n) for `recursive_feasibility`; None for its own choice (above 3 states)."""
        n, recursion = len(self.system.A), self.recursion
        if recursion.grid is None and n > 3:
            return None
        shape = recursion.grid or {1: (1001,), 2: (128, 128), 3: (24, 24, 24)}[n]
        return grid_points(*self._bounds(tuple(range(n)), recursion), shape)

    def check(self, command: str = "sweep") -> None:
        """Raise ValueError where keys, each good alone, do not fit one another."""
        s, limits = self.system, self.limits
        n, m = len(s.A), len(s.B[0])
        for key, value, count in (
            ("system.A", s.A[0], n),
            ("system.B", s.B, n),
            ("system.c", s.c, n),
            ("system.state_names", s.state_names, n),
            ("system.state_units", s.state_units, n),
            ("system.input_names", s.input_names, m),
            ("system.input_units", s.input_units, m),
            ("limits.x_min", limits.x_min, n),
            ("limits.x_max", limits.x_max, n),
            ("limits.u_min", limits.u_min, m),
            ("limits.u_max", limits.u_max, m),
            ("cost.Q", self.cost.Q, n),
            ("cost.R", self.cost.R, m),
            ("cost.P", None if isinstance(self.cost.P, str) else self.cost.P, n),
        ):
            if value is not None and len(value) != count:
                what = f"{m} inputs" if count == m != n else f"{n} states, {m} inputs"
                fail(key, f"has {len(value)} entries where {count} are needed", f"A, B: {what}")
        for low, high in (("x_min", "x_max"), ("u_min", "u_max")):
            _check_order("limits", low, high, getattr(limits, low), getattr(limits, high))
        self._check_state_limits()
        self._check_terminal_set(n)
        if command == "sweep":
            self._check_sweep(n)
        elif command == "recursion":
            self._check_recursion(n)

    def _check_sweep(self, n: int) -> None:
        sweep = self.sweep
        d = len(self._axes())
        for key, count in (("grid", d), ("lower", d), ("upper", d), ("fixed", n - d)):
            value = getattr(sweep, key)
            if value is not None and len(value) != count:
                cure = f"{n} states, of which {d} are mapped (sweep.axes)"
                fail(f"sweep.{key}", f"has {len(value)} entries where {count} are needed", cure)
        _check_order("sweep", "lower", "upper", sweep.lower, sweep.upper)
        if d < n and (sweep.fixed is None) != sweep.projection:
            cure = f"Give the {n - d} other values in sweep.fixed (a slice) or projection = true"
            both = "fixed and projection exclude each other"
            fail("sweep.fixed", both if sweep.projection else f"{n} states, {d} mapped", cure)
        self._bounds(self._axes(), sweep)

    def _check_recursion(self, n: int) -> None:
        recursion = self.recursion
        for key in ("grid", "lower", "upper"):
            value = getattr(recursion, key)
            if value is not None and len(value) != n:
                what = f"has {len(value)} entries where {n} are needed"
                fail(f"recursion.{key}", what, "One for each state")
        _check_order("recursion", "lower", "upper", recursion.lower, recursion.upper)
        self.build_samples()

    def _check_state_limits(self) -> None:
        limits = self.limits
        box = limits.x_min is not None or limits.x_max is not None
        polytope = limits.H_x is not None or limits.h_x is not None
        if (limits.x_min is None) != (limits.x_max is None):
            fail("limits.x_min", "x_min and x_max go together", "Use inf for a side without limit")
        if limits.margin and not box:
            fail("limits.margin", "given without x_min, x_max", "A Box of limits has half-widths")
        if (limits.H_x is None) != (limits.h_x is None):
            fail("limits.H_x", "H_x and h_x go together", "Give both: H_x x <= h_x")
        if box and polytope:
            fail("limits.H_x", "given beside x_min, x_max", "Write the box as rows of H_x")
        if limits.H_x is not None and limits.h_x is not None:
            shape = np.shape(limits.H_x)
            if shape != (len(limits.h_x), len(self.system.A)):
                fail("limits.H_x", f"shape {shape} for {len(limits.h_x)} rows", "One h_x a row")
        if not (box or polytope) and self.mpc.terminal != "none":
            fail("mpc.terminal", f'"{self.mpc.terminal}" without state limits', "Give x_min, x_max")

    def _check_terminal_set(self, n: int) -> None:
        mpc = self.mpc
        for rows, ends in (("H_f", "h_f"), ("P_f", "level_f")):
            if (getattr(mpc, rows) is None) != (getattr(mpc, ends) is None):
                fail(f"mpc.{rows}", f"{rows} and {ends} go together", "Give both")
            if getattr(mpc, rows) is not None and mpc.terminal != "none":
                fail(f"mpc.{rows}", f'given beside terminal "{mpc.terminal}"', "Choose one")
        if mpc.H_f is not None and mpc.P_f is not None:
            fail("mpc.P_f", "given beside H_f", "Choose one terminal set")
        if mpc.H_f is not None and mpc.h_f is not None:
            if np.shape(mpc.H_f) != (len(mpc.h_f), n):
                what = f"shape {np.shape(mpc.H_f)} for {len(mpc.h_f)} rows"
                fail("mpc.H_f", what, f"One h_f a row, {n} columns")
        if mpc.P_f is not None and np.shape(mpc.P_f) != (n, n):
            fail("mpc.P_f", f"shape {np.shape(mpc.P_f)}", f"Give ({n}, {n})")

    def _states(self) -> Box | Polytope | None:
        limits = self.limits
        if limits.H_x is not None:
            return Polytope(np.asarray(limits.H_x), np.asarray(limits.h_x))
        if limits.x_min is not None:
            return Box(np.asarray(limits.x_min), np.asarray(limits.x_max))
        return None

    def _axes(self) -> tuple[int, ...]:
        """Indices of the states mapped, from names or indices."""
        n = len(self.system.A)
        names = self.system.state_names or ()
        given = self.sweep.axes if self.sweep.axes is not None else tuple(range(min(2, n)))
        axes = tuple(
            names.index(axis) if axis in names else int(axis) if str(axis).isdecimal() else axis
            for axis in given
        )
        known = f"States are {', '.join(map(str, [*names, *range(n)]))}"
        for axis in axes:
            if axis not in range(n):
                fail("sweep.axes", f"no state {axis!r}", known)
        if not axes or len(set(axes)) != len(axes):
            fail("sweep.axes", f"{list(given)} repeats a state or is empty", known)
        return tuple(int(axis) for axis in axes)

    def _bounds(
        self, axes: tuple[int, ...], sweep: SweepSection | RecursionSection
    ) -> tuple[np.ndarray, np.ndarray]:
        """Corners of the grid: as given, else the state limits and 3 % more on each side."""
        where = "sweep" if isinstance(sweep, SweepSection) else "recursion"
        if sweep.lower is not None and sweep.upper is not None:
            return np.asarray(sweep.lower), np.asarray(sweep.upper)
        low, high = (end[list(axes)] for end in self.state_range())
        margin = 0.03 * (high - low) if np.all(np.isfinite([low, high])) else np.nan
        lower = np.asarray(sweep.lower) if sweep.lower is not None else low - margin
        upper = np.asarray(sweep.upper) if sweep.upper is not None else high + margin
        if not np.all(np.isfinite([lower, upper])):
            ends = f"Give {where}.lower and {where}.upper"
            cure = f"{ends}: the state limits do not bound the mapped axes"
            fail(f"{where}.lower", "no finite range to sweep", cure)
        if np.any(lower >= upper):
            fail(
                f"{where}.lower",
                f"{lower.tolist()} not below upper {upper.tolist()}",
                "Lower must be below upper",
            )
        return lower, upper


def load(
    path: str | Path, overrides: Mapping[str, Any] | None = None, command: str = "sweep"
) -> Config:
    """Read a TOML file; `overrides` ("horizon", "grid", ...) replace keys of [mpc] and of the
    section of the command ("sweep" or "recursion"), whose keys are checked against each other.

    Raises ValueError, naming file and key, where the file is absent or unreadable, is no
    TOML, or holds an unknown key or a value that cannot be.
    """
    return _parse(_read(path), str(path), overrides or {}, command)


def _read(path: str | Path) -> dict[str, Any]:
    try:
        return tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        fail(str(path), f"cannot be read ({error.strerror})", "Give the path of a TOML file")
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        fail(str(path), f"is no TOML ({error})", "See the keys with: jaxmpc sweep --help")


def to_toml(document: Mapping[str, Any]) -> str:
    """TOML text with each vector, and each row of a matrix, on a line."""
    text = tomli_w.dumps(document)
    line = lambda found: f"[{' '.join(part.strip() for part in found[1].splitlines())}]"
    # What holds a bracket of its own, a matrix or a name with one, stays as it is.
    return re.sub(r"\[\n([^\[\]]+?),?\n *\]", line, text)


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class RobotSection:
    """Which robot's MPC this is, and what of it `robot_mpc` and RobotController take."""

    name: str
    horizon: Annotated[int, Field(ge=1, strict=True)] = 20
    margin: Annotated[FiniteFloat, Field(ge=0, lt=1)] = 0.02
    linearize: Literal["set-point", "state", "trajectory"] = "state"


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class RobotCostSection:
    """As in a linear problem. rho: the L1 weight of state limits, always soft."""

    Q: Vector | Matrix
    R: Vector | Matrix
    P: Literal["lqr", "none"] | Matrix = "lqr"
    rho: Annotated[FiniteFloat, Field(gt=0)] = 1e4


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class RobotConfig:
    """The weights of a robot's MPC, as a file says them."""

    robot: RobotSection
    cost: RobotCostSection

    def weights(self, robot: Any) -> dict[str, Any]:
        """Q, R and terminal_cost, as `robot_mpc` takes them. Raises ValueError where the file is of
        another robot."""
        if self.robot.name != robot.name:
            fail("robot.name", f"{self.robot.name!r}, asked is {robot.name!r}", "Give that --robot")
        cost = self.cost
        for key, value, size in (
            ("Q", cost.Q, robot.n),
            ("R", cost.R, robot.m),
            ("P", cost.P, robot.n),
        ):
            if not isinstance(value, str) and len(value) != size:
                fail(f"cost.{key}", f"has {len(value)} entries", f"{robot.name} needs {size}")
        P: Any = None if cost.P == "none" else cost.P
        terminal = P if P is None or isinstance(P, str) else _matrix(P)
        return {"Q": _matrix(cost.Q), "R": _matrix(cost.R), "terminal_cost": terminal}

    def to_toml(self) -> str:
        """The file that `load_robot_config` reads back."""
        return to_toml(_ROBOT_ADAPTER.dump_python(self, exclude_none=True))


def load_robot_config(path: str | Path) -> RobotConfig:
    """Read the file of a robot's weights; ValueError as `load`."""
    document = _read(path)
    if "robot" not in document:
        fail(str(path), "has no section [robot]", "Give what jaxmpc tune weights --robot wrote")
    try:
        return _ROBOT_ADAPTER.validate_python(document)
    except ValidationError as error:
        raise ValueError(_sentence(error, str(path), {}, _ROBOT_SECTIONS)) from None


def _parse(
    document: Mapping[str, Any], source: str, overrides: Mapping[str, Any], command: str
) -> Config:
    merged = dict(document)
    # A slice and a projection exclude each other: choosing either drops the file's choice.
    # So do the names of a terminal set and the sets themselves.
    dropped = set()
    for rivals in ({"fixed", "projection"}, {"terminal", "H_f", "h_f", "P_f", "level_f"}):
        dropped |= rivals if rivals & set(overrides) else set()
    for name in ("mpc", *({command} & set(_COMMANDS))):
        known = {field.name for field in dataclasses.fields(_SECTIONS[name])}
        changes = {key: value for key, value in overrides.items() if key in known}
        if changes and isinstance(merged.get(name, {}), dict):
            kept = {k: v for k, v in merged.get(name, {}).items() if k not in dropped}
            merged[name] = {**kept, **changes}
    try:
        config = _ADAPTER.validate_python(merged)
        config.check(command)
    except ValidationError as error:
        raise ValueError(_sentence(error, source, overrides)) from None
    except ValueError as error:
        raise ValueError(f"{source}: {error}") from None
    return config


def _sentence(
    error: ValidationError, source: str, overrides: Mapping[str, Any],
    sections: Mapping[str, Any] | None = None,
) -> str:  # fmt: skip
    """The first thing wrong, in one line: where, what, and what is allowed there."""
    sections = _SECTIONS if sections is None else sections
    unknown = "unexpected_keyword_argument"  # first: a misspelt key is also a missing one
    first = min(error.errors(), key=lambda e: e["type"] != unknown)
    where = [str(part) for part in first["loc"][:2]]
    key = ".".join(where)
    if first["type"] == unknown:
        names = list(sections) if sections is not _SECTIONS else _names(Config)
        allowed = ", ".join(_names(sections[where[0]]) if len(where) == 2 else names)
        place = f"[{where[0]}]" if len(where) == 2 else "the top of the file"
        return f"{source}: unknown key {where[-1]!r} in {place}. Keys allowed there: {allowed}"
    same = [e for e in error.errors() if [str(part) for part in e["loc"][:2]] == where]
    problems = dict.fromkeys(e["msg"].removeprefix("Value error, ") for e in same)
    if first["type"] == "missing":
        return f"{source}: {key} is missing. Add it (jaxmpc sweep --help lists all keys)"
    if where[-1] in overrides:
        source, key = "command line", f"--{where[-1]}"
    value = repr(first["input"])
    shown = value if len(value) < 60 else value[:57] + "..."
    return f"{source}: {key}: {'; or '.join(problems)}. Got {shown}"


def _names(section: Any) -> list[str]:
    return [field.name for field in dataclasses.fields(section)]


def _matrix(value: Any) -> np.ndarray:
    array = np.asarray(value, dtype=np.float64)
    return np.diag(array) if array.ndim == 1 else array


def _check_order(
    where: str, low: str, high: str, lower: tuple[float, ...] | None, upper: Any
) -> None:
    for i, (a, b) in enumerate(zip(lower or (), upper or (), strict=False)):
        if a > b or (where in _COMMANDS and a == b):
            fail(
                f"{where}.{low}", f"entry {i} is {a:g}, above {high} {b:g}", f"Check {low}, {high}"
            )


_SECTIONS = {
    "system": SystemSection,
    "limits": LimitsSection,
    "cost": CostSection,
    "mpc": MPCSection,
    "sweep": SweepSection,
    "recursion": RecursionSection,
    "solver": SolverSection,
}
_ROBOT_SECTIONS = {"robot": RobotSection, "cost": RobotCostSection}
_COMMANDS = ("sweep", "recursion")
_ADAPTER = TypeAdapter(Config)
_ROBOT_ADAPTER = TypeAdapter(RobotConfig)
_JOINT: dict[str, Any] = {
    "name": "joint",
    "system": {
        "A": [[1.0, 0.01], [0.0, 1.0]],
        "B": [[0.0], [0.2]],
        "dt": 0.01,
        "state_names": ["q", "dq"],
        "state_units": ["rad", "rad/s"],
        "input_names": ["tau"],
        "input_units": ["N m"],
    },
    "limits": {"x_min": [-1.5, -2.0], "x_max": [1.5, 2.0], "u_min": [-2.0], "u_max": [2.0]},
    "cost": {"Q": [50.0, 1.0], "R": [0.1], "P": "Q"},
    "mpc": {"horizon": 20},
    "sweep": {"grid": [256, 256]},
}
