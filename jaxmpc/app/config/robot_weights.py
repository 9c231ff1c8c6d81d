"""The TOML file with the weights of a robot's MPC: what jaxmpc tune weights --robot writes."""

from dataclasses import field
from typing import Annotated, Any, Literal

from pydantic import Field, TypeAdapter
from pydantic.dataclasses import dataclass

from jaxmpc.app.config.files import Origin, to_toml
from jaxmpc.app.config.sections import STRICT, Matrix, Number, Vector, Whole, to_matrix


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
    origin: Annotated[Origin, Field(exclude=True)] = field(
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
