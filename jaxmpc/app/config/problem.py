"""The problem that a TOML file describes, and the `MPC` made of it."""

import dataclasses
import json
from collections.abc import Callable
from functools import wraps
from typing import Annotated, Any, TypeVar

import numpy as np
from pydantic import Field, TypeAdapter
from pydantic.dataclasses import dataclass

from jaxmpc.app.config.files import Origin, to_toml
from jaxmpc.app.config.sections import (
    STRICT,
    CostSection,
    LimitsSection,
    MPCSection,
    RecursionSection,
    SolverSection,
    SweepSection,
    SystemSection,
    to_matrix,
)
from jaxmpc.explicit.exact_penalties import exact_penalty
from jaxmpc.mpc.problem import MPC
from jaxmpc.mpc.softening import soften
from jaxmpc.qp.admm import ADMM
from jaxmpc.sets.box import Box
from jaxmpc.sets.ellipsoid import Ellipsoid
from jaxmpc.sets.polytope import Polytope
from jaxmpc.sets.terminal_sets import named_terminal_set
from jaxmpc.systems.riccati import lqr
from jaxmpc.systems.system import LinearSystem

# Commands that have a section of their own.
SECTION_COMMANDS = ("sweep", "recursion")
# Arguments by which errors of the library name what these keys give.
KEYS = {
    **{
        name: f"system.{name}"
        for name in (
            "A",
            "B",
            "c",
            "dt",
            "state_names",
            "state_units",
            "input_names",
            "input_units",
        )
    },
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
    "states.H": "limits.H_x",
    "states.h": "limits.h_x",
    "terminal_set.H": "mpc.H_f",
    "terminal_set.h": "mpc.h_f",
    "terminal_set.P": "mpc.P_f",
    "terminal_set.level": "mpc.level_f",
}
Result = TypeVar("Result")


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
        return found.get(argument, KEYS.get(argument, argument)) + colon + rest

    def to_dict(self, command: str = "sweep") -> dict[str, Any]:
        """Return the sections that a command reads as JSON data; infinity is "Infinity"."""
        data = json.loads(ADAPTER.dump_json(self))
        return {
            key: part for key, part in data.items() if key == command or key not in SECTION_COMMANDS
        }

    def to_toml(self) -> str:
        """Return the text of a file that `load` reads back as this very configuration."""
        return to_toml(ADAPTER.dump_python(self, exclude_none=True))

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
        )
        states = self.state_limits()
        if isinstance(states, Box) and limits.margin:
            states = states.tightened(limits.margin)
        inputs = Box(np.asarray(limits.u_min), np.asarray(limits.u_max))
        Q, R = to_matrix(cost.Q), to_matrix(cost.R)
        name, regulator = self.mpc.terminal, None
        if cost.P == "lqr" or name in ("invariant", "ellipsoid"):
            regulator = lqr(system, Q, R)
        terminal_cost: Any = Q if cost.P == "Q" else None
        if cost.P == "lqr":
            terminal_cost = regulator and regulator.P
        elif not isinstance(cost.P, str):
            terminal_cost = to_matrix(cost.P)
        terminal_set: Any = named_terminal_set(name, system, regulator, states, inputs)
        if self.mpc.H_f is not None:
            terminal_set = Polytope(np.asarray(self.mpc.H_f), np.asarray(self.mpc.h_f))
        if self.mpc.P_f is not None:
            terminal_set = Ellipsoid(np.asarray(self.mpc.P_f), np.asarray(self.mpc.level_f))
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
        """Return the problem that the controller solves: `build_mpc` softened by cost.rho."""
        mpc, rho = self.build_mpc(), self.cost.rho
        return mpc if rho is None else self._softened(mpc, rho)

    @_in_keys
    def _softened(self, mpc: MPC, rho: Any) -> MPC:
        return soften(mpc, exact_penalty(mpc).advised if isinstance(rho, str) else rho)

    def build_solver(self) -> ADMM | None:
        """Return the solver of [solver]; None without that section."""
        if self.solver is None:
            return None
        given = self.solver.rho
        rho = np.asarray(given) if isinstance(given, tuple) else given
        return ADMM(self.solver.iterations, rho, self.solver.alpha, self.solver.newton_steps)

    def state_limits(self) -> Box | Polytope | None:
        """Return the state limits without the margin; None where there are none."""
        limits = self.limits
        if limits.H_x is not None:
            return Polytope(np.asarray(limits.H_x), np.asarray(limits.h_x))
        if limits.x_min is not None:
            return Box(np.asarray(limits.x_min), np.asarray(limits.x_max))
        return None

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


ADAPTER = TypeAdapter(Config)
