"""What TOML files hold, section by section, and what is made of it: MPC, solver, grid, weights."""

import dataclasses
import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from functools import wraps
from typing import Annotated, Any, Literal, NamedTuple, TypeVar

import numpy as np
import tomli_w
from pydantic import (
    AfterValidator,
    AllowInfNan,
    BeforeValidator,
    ConfigDict,
    Field,
    Strict,
    TypeAdapter,
)
from pydantic.dataclasses import dataclass

from jaxmpc.checks import MOST_COUNT, fail
from jaxmpc.explicit.exact_penalties import exact_penalty
from jaxmpc.grids import axis_indices, grid, grid_ends, mesh
from jaxmpc.mpc.problem import MPC, Outputs, Soft, soften, within_outputs
from jaxmpc.qp.admm import ADMM
from jaxmpc.sets.convex_sets import Box, Ellipsoid, Polytope
from jaxmpc.sets.invariant import OF_A_LAW, named_terminal_set
from jaxmpc.systems.riccati import LQR, lqr
from jaxmpc.systems.system import LinearSystem, numbered


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
    dt: Annotated[Number, Field(gt=0)]  # seconds, or in time_unit
    continuous: Switch = False  # True: convert by zero-order hold
    state_names: tuple[str, ...] | None = None
    state_units: tuple[str, ...] | None = None
    input_names: tuple[str, ...] | None = None
    input_units: tuple[str, ...] | None = None
    time_unit: str = "s"  # of dt and, in its inverse, of a continuous A


@dataclass(frozen=True, kw_only=True, config=STRICT)
class LimitsSection:
    """Box limits of states and inputs, or H_x x <= h_x in place of the state box."""

    x_min: Limits | None = None  # (n,), -inf where free
    x_max: Limits | None = None  # (n,), inf where free
    # Fraction of the half-width of x_min, x_max that the MPC keeps away from them, on each side.
    margin: Annotated[Number, Field(ge=0, lt=1)] = 0.0
    H_x: Matrix | None = None  # (r, n)
    h_x: Vector | None = None  # (r,)
    u_min: Limits  # (m,), -inf where free
    u_max: Limits  # (m,), inf where free
    input_rate_limit: Vector | None = None  # (m,): |u_k - u_{k-1}| <= input_rate_limit


@dataclass(frozen=True, kw_only=True, config=STRICT)
class CostSection:
    """J = Σ x'Qx + u'Ru + x_N'P x_N, without ½. A flat list is a diagonal."""

    Q: Vector | Matrix
    R: Vector | Matrix
    P: Literal["lqr", "Q", "none"] | Vector | Matrix = "lqr"  # "lqr": the Riccati solution
    # L1 weight that makes state and terminal limits soft in the controller; "exact": the least one
    # that changes nothing where they can be kept, and a margin. Sets are those of the hard limits.
    rho: Annotated[Number, Field(ge=0)] | Literal["exact"] | None = None
    # Adds Σ Δu'W Δu with Δu = u_k - u_{k-1}.
    input_rate_weight: Vector | Matrix | None = None
    stage_weights: Vector | None = None  # (N,) > 0: weighs x'Qx + u'Ru of each step


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
    # Number of free inputs, the last one held, or lengths of blocks that add up to the horizon.
    control_horizon: (
        Annotated[Whole, Field(ge=1)] | tuple[Annotated[Whole, Field(ge=1)], ...] | None
    ) = None
    constrain_initial: Switch = True  # False: no state limits at k = 0
    constrained_stages: tuple[Whole, ...] | None = None  # the k at which state limits hold


@dataclass(frozen=True, kw_only=True, config=STRICT)
class OutputsSection:
    """Rows lower <= C x + D u <= upper of p outputs: hard, or with rho soft, at that L1 weight."""

    C: Matrix  # (p, n)
    lower: Limits | Limit | None = None  # (p,) or one for all, -inf where free
    upper: Limits | Limit | None = None  # (p,) or one for all, inf where free
    D: Matrix | None = None  # (p, m), none means zero
    stages: tuple[Whole, ...] | None = None  # the k at which they hold, none means the usual ones
    names: tuple[str, ...] = ()
    units: tuple[str, ...] = ()
    rho: Annotated[Number, Field(ge=0)] | Annotated[Vector, Field(min_length=1)] | None = None
    quadratic: Annotated[Number, Field(ge=0)] | None = None  # weight of squares, with rho alone


@dataclass(frozen=True, kw_only=True, config=STRICT)
class ReferenceSection:
    """What closed loops track in place of the origin; limits and sets stay where they are."""

    state: Vector  # (n,)
    input: Vector | None = None  # (m,), none means zero


@dataclass(frozen=True, kw_only=True, config=STRICT)
class DisturbanceSection:
    """x⁺ = A x + B u + c + E w with w_min <= w <= w_max: limits are kept for all of them."""

    w_min: Vector  # (p,), at most 0
    w_max: Vector  # (p,), at least 0
    E: Matrix | None = None  # (n, p) of a time step, none means the identity
    # How later inputs answer to w: by a gain, in a tube, or by any affine function; maps that are
    # stored, and exported controllers, take the first alone.
    policy: Literal["tightened", "affine", "tube"] = "tightened"
    gain: Matrix | None = None  # (m, n), none means that of the LQR


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


# Keys that results have only where they are given.
NEWER = {
    "": ("disturbance", "outputs", "reference"),
    "limits": ("input_rate_limit",),
    "cost": ("input_rate_weight", "stage_weights"),
    "mpc": ("constrained_stages",),
}
# Commands that have a section of their own.
SECTION_COMMANDS = ("sweep", "recursion")
# Arguments by which errors of the library name what these keys give.
KEYS = {
    **{name: f"system.{name}" for name in ("A", "B", "c", "dt", "state_names", "state_units")},
    **{name: f"system.{name}" for name in ("input_names", "input_units", "time_unit")},
    "mpc.soft": "cost.rho",
    "rho": "solver.rho",
    "iterations": "solver.iterations",
    "Q": "cost.Q",
    "R": "cost.R",
    "terminal_cost": "cost.P",
    "horizon": "mpc.horizon",
    "control_horizon": "mpc.control_horizon",
    "terminal": "mpc.terminal",
    "states": "limits.x_min, x_max",
    "states.lower": "limits.x_min",
    "states.upper": "limits.x_max",
    "inputs": "limits.u_min, u_max",
    "inputs.lower": "limits.u_min",
    "inputs.upper": "limits.u_max",
    "disturbance": "disturbance.w_min, w_max",
    "disturbance.lower": "disturbance.w_min",
    "disturbance.upper": "disturbance.w_max",
    "disturbance_matrix": "disturbance.E",
    "gain": "disturbance.gain",
    "policy": "disturbance.policy",
    "input_rate_limit": "limits.input_rate_limit",
    "input_rate_weight": "cost.input_rate_weight",
    "stage_weights": "cost.stage_weights",
    "constrained_stages": "mpc.constrained_stages",
    "states.H": "limits.H_x",
    "states.h": "limits.h_x",
    "terminal_set.H": "mpc.H_f",
    "terminal_set.h": "mpc.h_f",
    "terminal_set.P": "mpc.P_f",
    "terminal_set.level": "mpc.level_f",
}
Result = TypeVar("Result")


@dataclasses.dataclass(frozen=True)
class Origin:
    """Where the keys of a configuration come from: a file, and options of the command line (keys
    such as "mpc.horizon")."""

    file: str = ""
    options: frozenset[str] = frozenset()

    def error(self, message: str) -> ValueError:
        """Return the error with the file, or the option, that holds the key it begins with."""
        key, _, rest = message.partition(": ")
        if key in self.options:
            return ValueError(f"command line: --{key.split('.')[-1]}: {rest}")
        return ValueError(f"{self.file}: {message}" if self.file else message)


def _in_keys(method: Callable[..., Result]) -> Callable[..., Result]:
    """Let errors of a method of `Config` name file and key, not the library's arguments."""

    @wraps(method)
    def wrapped(self: "Config", *args: Any) -> Result:
        try:
            return method(self, *args)
        except ValueError as error:
            raise self.origin.error(self.renamed(str(error))) from None

    return wrapped


@dataclass(frozen=True, kw_only=True, config=STRICT)
class Config:
    """A problem and the settings of commands: the sections of the file."""

    name: str = "mpc"
    system: SystemSection
    limits: LimitsSection
    cost: CostSection
    mpc: MPCSection
    outputs: tuple[OutputsSection, ...] = ()
    disturbance: DisturbanceSection | None = None
    reference: ReferenceSection | None = None
    sweep: SweepSection = SweepSection()
    recursion: RecursionSection = RecursionSection()
    solver: SolverSection | None = None
    origin: Annotated[Origin, Field(exclude=True)] = dataclasses.field(
        init=False, compare=False, repr=False, default=Origin()
    )

    def renamed(self, message: str) -> str:
        """Return an error of the library with the key of this file for its argument."""
        argument, colon, rest = message.partition(": ")
        mpc, limits = self.mpc, self.limits
        found = {
            "Polytope": "limits.H_x",
            "terminal_set": "mpc.H_f" if mpc.H_f else "mpc.P_f" if mpc.P_f else "mpc.terminal",
            **({"states": "limits.H_x"} if limits.H_x is not None else {}),
        }
        rows = re.fullmatch(r"(outputs|soft)\[(\d+)\](.*)", argument)
        if rows is not None:  # the place of these rows in the file, where hard and soft ones mix
            soft = rows[1] == "soft"
            places = [i for i, each in enumerate(self.outputs) if (each.rho is not None) == soft]
            if int(rows[2]) < len(places):
                return f"outputs.{places[int(rows[2])]}{rows[3]}{colon}{rest}"
        return found.get(argument, KEYS.get(argument, argument)) + colon + rest

    def to_dict(self, command: str = "sweep") -> dict[str, Any]:
        """Return the sections that a command reads as JSON data; infinity is "Infinity"."""
        data = json.loads(ADAPTER.dump_json(self))
        # As results had it before there were these keys.
        for section, keys in NEWER.items():
            part = data if section == "" else data[section]
            for key in keys:
                if part[key] is None or (key == "outputs" and not part[key]):
                    del part[key]
        return {
            key: part for key, part in data.items() if key == command or key not in SECTION_COMMANDS
        }

    def to_toml(self) -> str:
        """Return the text of a file that `load` reads back as this very configuration."""
        document = ADAPTER.dump_python(self, exclude_none=True)
        if not self.outputs:
            del document["outputs"]
        return to_toml(document)

    @_in_keys
    def build_mpc(self) -> MPC:
        """Return the problem with hard limits. Raises ValueError, naming file and key, as
        `MPC.validate` does."""
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
            time_unit=s.time_unit,
        )
        states = self.state_limits()
        if isinstance(states, Box) and limits.margin:
            states = states.tightened(limits.margin)
        inputs = Box(np.asarray(limits.u_min), np.asarray(limits.u_max))
        Q, R = to_matrix(cost.Q), to_matrix(cost.R)
        name, regulator = self.mpc.terminal, None
        if cost.P == "lqr" or name in OF_A_LAW:
            regulator = lqr(system, Q, R)
        terminal_cost: Any = Q if cost.P == "Q" else None
        if cost.P == "lqr":
            terminal_cost = regulator and regulator.P
        elif not isinstance(cost.P, str):
            terminal_cost = to_matrix(cost.P)
        against = self.disturbance_fields()
        law = regulator
        if law is not None and against.get("gain") is not None:
            law = LQR(K=against["gain"], P=law.P)
        W, E = (against.get(key) for key in ("disturbance", "disturbance_matrix"))
        rows = [_rows(each) for each in self.outputs]
        mpc = MPC(
            system=system,
            Q=Q,
            R=R,
            horizon=self.mpc.horizon,
            states=states,
            inputs=inputs,
            terminal_cost=terminal_cost,
            constrain_initial=self.mpc.constrain_initial,
            control_horizon=self.mpc.control_horizon,
            constrained_stages=self.mpc.constrained_stages,
            input_rate_limit=as_array(limits.input_rate_limit),
            input_rate_weight=as_array(cost.input_rate_weight),
            stage_weights=as_array(cost.stage_weights),
            outputs=tuple(each for each in rows if isinstance(each, Outputs)),
            soft=tuple(each for each in rows if isinstance(each, Soft)),
            **against,
        )
        kept = within_outputs(mpc, law.K) if law and name in OF_A_LAW else states
        terminal_set: Any = named_terminal_set(name, system, law, kept, inputs, W, E)
        if self.mpc.H_f is not None:
            terminal_set = Polytope(np.asarray(self.mpc.H_f), np.asarray(self.mpc.h_f))
        if self.mpc.P_f is not None:
            terminal_set = Ellipsoid(np.asarray(self.mpc.P_f), np.asarray(self.mpc.level_f))
        mpc = dataclasses.replace(mpc, terminal_set=terminal_set)
        mpc.validate()
        return mpc

    def disturbance_fields(self) -> dict[str, Any]:
        """Return the fields of `MPC` that [disturbance] gives, none without that section."""
        given = self.disturbance
        if given is None:
            return {}
        return {
            "disturbance": Box(np.asarray(given.w_min), np.asarray(given.w_max)),
            "disturbance_matrix": as_array(given.E),
            "policy": given.policy,
            "gain": as_array(given.gain),
        }

    @property
    def dimension(self) -> int:
        """Number of coordinates of an initial state: n, or n + m with the previous input where
        input rates are limited."""
        n, m = len(self.system.A), len(self.system.B[0])
        return n if self.limits.input_rate_limit is None else n + m

    @property
    def coordinate_names(self) -> tuple[str, ...]:
        """Names of these coordinates, where states have names."""
        inputs = self.system.input_names or numbered("u", len(self.system.B[0]))
        names = self.system.state_names or ()
        previous = tuple(f"previous {name}" for name in inputs) if names else ()
        return (names + previous)[: self.dimension]

    def references(self) -> dict[str, Any]:
        """Return reference and input_reference of closed loops; none without [reference]."""
        given = self.reference
        if given is None:
            return {}
        return {"reference": as_array(given.state), "input_reference": as_array(given.input)}

    def build_controlled(self) -> MPC:
        """Return the problem that the controller solves: `build_mpc` softened by cost.rho."""
        mpc, rho = self.build_mpc(), self.cost.rho
        return mpc if rho is None else self._softened(mpc, rho)

    @_in_keys
    def _softened(self, mpc: MPC, rho: Any) -> MPC:
        if isinstance(rho, str):
            if mpc.soft:
                what = '"exact" beside soft outputs, whose violation can push plans through limits'
                fail("cost.rho", what, "Give a number, far larger than their rho")
            rho = exact_penalty(mpc, **self.references()).advised
        return soften(mpc, rho)

    @_in_keys
    def build_solver(self) -> ADMM | None:
        """Return the solver of [solver]; None without that section."""
        if self.solver is None:
            return None
        given = self.solver.rho
        rho = np.asarray(given) if isinstance(given, tuple) else given
        found = ADMM(self.solver.iterations, rho, self.solver.alpha, self.solver.newton_steps)
        found.validate()
        return found

    def state_limits(self) -> Box | Polytope | None:
        """Return the state limits without the margin; None where there are none."""
        limits = self.limits
        if limits.H_x is not None:
            return Polytope(np.asarray(limits.H_x), np.asarray(limits.h_x))
        if limits.x_min is not None:
            return Box(np.asarray(limits.x_min), np.asarray(limits.x_max))
        return None

    @_in_keys
    def initial_range(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the ends of the smallest box round the initial states, `dimension` numbers each:
        `state_range`, and the input limits where input rates are limited."""
        lower, upper = self.state_range()
        if self.dimension > len(self.system.A):
            lower = np.concatenate([lower, self.limits.u_min])
            upper = np.concatenate([upper, self.limits.u_max])
        return lower, upper

    @_in_keys
    def state_range(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the ends (n,), (n,) of the smallest box round the state limits; ±inf without."""
        states, n = self.state_limits(), len(self.system.A)
        if isinstance(states, Box):
            return np.asarray(states.lower), np.asarray(states.upper)
        if isinstance(states, Polytope):
            corners = np.asarray(states.vertices())
            return corners.min(axis=0), corners.max(axis=0)
        return np.full(n, -np.inf), np.full(n, np.inf)

    def around_target(self, fraction: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the states this fraction of the way, at most, from where closed loops aim in the
        end to the ends (n,), (n,) of `state_range`."""
        lower, upper = self.state_range()
        aim = self.references().get("reference")
        target = np.clip(0.0 if aim is None else aim.reshape(-1, len(lower))[-1], lower, upper)
        return target + fraction * (lower - target), target + fraction * (upper - target)


ADAPTER = TypeAdapter(Config)


@dataclass(frozen=True, kw_only=True, config=STRICT)
class RobotSection:
    """Which robot's MPC this is, with arguments of `robot_mpc` and `RobotController`."""

    name: str
    horizon: Annotated[Whole, Field(ge=1)] = 20
    margin: Annotated[Number, Field(ge=0, lt=1)] = 0.02
    linearize: Literal["set-point", "state", "trajectory"] = "state"


@dataclass(frozen=True, kw_only=True, config=STRICT)
class RobotCostSection:
    """J as in a linear problem. rho: the L1 weight of state limits, which are always soft."""

    Q: Vector | Matrix
    R: Vector | Matrix
    P: Literal["lqr", "none"] | Matrix = "lqr"
    rho: Annotated[Number, Field(gt=0)] = 1e4


@dataclass(frozen=True, kw_only=True, config=STRICT)
class RobotConfig:
    """The weights of a robot's MPC: the sections of the file."""

    robot: RobotSection
    cost: RobotCostSection
    origin: Annotated[Origin, Field(exclude=True)] = dataclasses.field(
        init=False, compare=False, repr=False, default=Origin()
    )

    def weights(self, robot: Any) -> dict[str, Any]:
        """Return Q, R and terminal_cost as `robot_mpc` takes them.

        Raises ValueError where the file is of another robot, or of other sizes.
        """
        if self.robot.name != robot.name:
            what = f"robot.name: {self.robot.name!r}, asked is {robot.name!r}. Give that --robot"
            raise self.origin.error(what)
        cost = self.cost
        for key, value, size in (
            ("Q", cost.Q, robot.n),
            ("R", cost.R, robot.m),
            ("P", cost.P, robot.n),
        ):
            if not isinstance(value, str) and len(value) != size:
                what = f"cost.{key}: has {len(value)} entries. {robot.name} needs {size}"
                raise self.origin.error(what)
        P: Any = None if cost.P == "none" else cost.P
        terminal = P if P is None or isinstance(P, str) else to_matrix(P)
        return {"Q": to_matrix(cost.Q), "R": to_matrix(cost.R), "terminal_cost": terminal}

    def to_toml(self) -> str:
        """Return the text of a file that `load_robot_config` reads back."""
        return to_toml(ROBOT_ADAPTER.dump_python(self, exclude_none=True))


ROBOT_ADAPTER = TypeAdapter(RobotConfig)


class SweepPoints(NamedTuple):
    """Initial states of a sweep: a grid of mapped states, as `map_feasible_set` takes it."""

    along: tuple[np.ndarray, ...]  # the coordinates along each of the d axes
    axes: tuple[int, ...]  # the d states mapped
    fixed: np.ndarray | None  # (n,) for a slice; None: all states mapped, or a projection

    @property
    def total(self) -> int:
        """Return the number of points B."""
        return math.prod(len(line) for line in self.along)

    @property
    def points(self) -> np.ndarray:
        """Return all points (B, d)."""
        return mesh(self.along)


def sweep_points(config: Config) -> SweepPoints:
    """Return the grid of initial states that [sweep] describes."""
    axes = mapped_axes(config)
    lower, upper = section_ends(config, axes, config.sweep)
    shape = grid_shape(config)
    along = tuple(np.linspace(*ends) for ends in zip(lower, upper, shape, strict=True))
    if config.sweep.fixed is None and (config.sweep.projection or len(axes) == config.dimension):
        return SweepPoints(along, axes, None)
    others = [i for i in range(config.dimension) if i not in axes]
    fixed = np.zeros(config.dimension)
    given = config.sweep.fixed or ()  # previous inputs that it leaves out are zero
    fixed[others[: len(given)]] = given
    return SweepPoints(along, axes, fixed)


def grid_shape(config: Config) -> tuple[int, ...]:
    """Return the number of points of a sweep along each mapped axis."""
    d = len(mapped_axes(config))
    # 256 along each of two axes; about as many points in all along more.
    return config.sweep.grid or (min(256, int(65_536.5 ** (1 / d))),) * d


def recursion_states(config: Config) -> np.ndarray | None:
    """Return states (B, n) for `recursive_feasibility`; None for its own choice (n > 3)."""
    if config.disturbance is not None:
        problem = "given beside [disturbance], under which no samples are followed"
        fail("recursion.grid, lower, upper", problem, "Leave them out")
    shape, axes = recursion_shape(config), range(config.dimension)
    return None if shape is None else grid(*section_ends(config, axes, config.recursion), shape)


def recursion_shape(config: Config) -> tuple[int, ...] | None:
    """Return the number of sample states along each axis; None for those that
    `recursive_feasibility` chooses itself (n > 3)."""
    usual = {1: (1001,), 2: (128, 128), 3: (24, 24, 24)}
    return config.recursion.grid or usual.get(config.dimension)


def mapped_axes(config: Config) -> tuple[int, ...]:
    """Return the indices of the mapped states, which [sweep] gives by name or index."""
    n, axes = config.dimension, config.sweep.axes
    given = tuple(range(min(2, n))) if axes is None else axes
    return axis_indices("sweep.axes", "state", given, config.coordinate_names, n)


def section_ends(
    config: Config, axes: Sequence[int], section: SweepSection | RecursionSection
) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of the grid of [sweep] or [recursion]; see `grid_ends`."""
    where = "sweep." if isinstance(section, SweepSection) else "recursion."
    limits = lambda: tuple(end[list(axes)] for end in config.initial_range())
    return grid_ends(where, section.lower, section.upper, limits)


def to_toml(document: Mapping[str, Any]) -> str:
    """Return TOML text with each vector, and each row of a matrix, on a line."""
    text = tomli_w.dumps(document)
    line = lambda found: f"[{' '.join(part.strip() for part in found[1].splitlines())}]"
    # What holds a bracket of its own, a matrix or a name with one, stays as it is.
    return re.sub(r"\[\n([^\[\]]+?),?\n *\]", line, text)


def as_array(value: Any) -> np.ndarray | None:
    """Return a key's numbers as an array; None for a key that is not given."""
    return None if value is None else np.asarray(value, dtype=np.float64)


def _rows(given: OutputsSection) -> Outputs | Soft:
    """Return rows of outputs: hard ones without rho."""
    named: dict[str, Any] = {key: getattr(given, key) for key in ("stages", "names", "units")}
    named |= {key: as_array(getattr(given, key)) for key in ("C", "lower", "upper", "D")}
    if given.rho is None:
        return Outputs(**named)
    return Soft(**named, rho=np.asarray(given.rho), quadratic=given.quadratic or 0.0)


def to_matrix(value: Any) -> np.ndarray:
    """Return a weight as a matrix (n, n); a flat list is a diagonal."""
    array = np.asarray(value, dtype=np.float64)
    return np.diag(array) if array.ndim == 1 else array
