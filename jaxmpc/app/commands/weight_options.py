"""The options of `jaxmpc tune weights`, and their checks."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from jaxmpc.app.commands.options import (
    NOT_NEGATIVE,
    PART,
    POSITIVE,
    SHARE,
    Horizon,
    Overwrite,
    Payload,
    Resume,
    RobotDamping,
    RobotMass,
    Terminal,
    Values,
    at_least,
    option,
    refuse,
)
from jaxmpc.checks import fail

SPREAD = Values(lambda value: 0 < value <= 1, "Give a fraction above 0 and up to 1")


@dataclass(frozen=True)
class WeightOptions:
    """The options of `jaxmpc tune weights`."""

    config: Annotated[Path | None, option("FILE", "the built-in joint")] = None
    """TOML file with the problem; with --robot the weights to start from."""
    robot: Annotated[str | None, option("NAME|FILE", "none: a linear system")] = None
    """joint, pendulum, cartpole, arm2, arm6, arm7, quadrotor, or an MJCF or URDF file."""
    tune: Annotated[
        tuple[Literal["Q", "R", "P", "rho", "tightening"], ...],
        option("{Q,R,P,rho,tightening} [...]", "Q R"),
    ] = ("Q", "R")
    """What is tuned; see above."""
    weights: Annotated[Literal["diagonal", "full"], option("{diagonal,full}", "diagonal")] = (
        "diagonal"
    )
    """Form of Q and R. P is full unless it starts diagonal."""
    updates: Annotated[int, option("K", "100"), at_least(0)] = 100
    """Steps of the optimizer."""
    count: Annotated[int, option("B", "64"), at_least(2)] = 64
    """Number of initial states, validation included."""
    batch: Annotated[int | None, option("B", "all training loops"), at_least(1)] = None
    """Number of loops of each step, drawn again each time."""
    validation: Annotated[float, option("FRACTION", "0.25"), PART] = 0.25
    """Fraction of the initial states in the validation set."""
    steps: Annotated[int | None, option("K", "50; robots: 1 s"), at_least(1)] = None
    """Length of the closed loops in time steps."""
    seconds: Annotated[float | None, option("S", "none: --steps"), POSITIVE] = None
    """Length of the closed loops in seconds."""
    optimizer: Annotated[str, option("NAME", "adam")] = "adam"
    """Optimizer of optax, by name: adam, adamw, sgd, rmsprop, lion, ..."""
    learning_rate: Annotated[float, option("X", "0.05"), POSITIVE] = 0.05
    """Learning rate; with adam a weight changes by about this fraction in a step."""
    mode: Annotated[
        Literal["auto", "forward", "reverse"], option("{auto,forward,reverse}", "auto")
    ] = "auto"
    """Differentiation: the time of forward grows with the number of weights, the memory of
    reverse with the length of the loops. auto: the one with fewer operations."""
    tracking: Annotated[tuple[float, ...] | None, option("Q [Q ...]", "Q at the start")] = None
    """Diagonal of the loss's own Q."""
    effort: Annotated[tuple[float, ...] | None, option("R [R ...]", "R at the start")] = None
    """Diagonal of the loss's own R."""
    violation: Annotated[float, option("W", "10"), NOT_NEGATIVE] = 10.0
    """Weight in the loss of violations of state limits, as fractions of half the range."""
    settling: Annotated[float, option("W", "0"), NOT_NEGATIVE] = 0.0
    """Weight in the loss of the time to settle, for each time step."""
    tolerance: Annotated[float, option("FRACTION", "0.02"), POSITIVE] = 0.02
    """Distance that counts as at the target, as a fraction of half the range of each state."""
    lower: Annotated[tuple[float, ...] | None, option("X [X ...]", "state limits x --spread")] = (
        None
    )
    """Lower ends of the initial states, one number a state. Not for robots."""
    upper: Annotated[tuple[float, ...] | None, option("X [X ...]", "state limits x --spread")] = (
        None
    )
    """Upper ends. States from which no plan keeps the limits (by linear programs) are replaced."""
    spread: Annotated[float | None, option("FRACTION", "0.9; robots 0.5"), SPREAD] = None
    """Initial states are uniform up to this fraction of the way to the limits."""
    horizon: Horizon = None
    terminal: Terminal = None
    margin: Annotated[
        float | None, option("FRACTION", "from the file; 0.02 if tuned or robot"), SHARE
    ] = None
    """Tightening of the state limits before tuning, as a fraction of half the range."""
    target: Annotated[tuple[float, ...] | None, option("Q [Q ...]", "home of the model")] = None
    """With --robot: configuration to rest at."""
    linearize: Annotated[
        Literal["set-point", "state", "trajectory"] | None,
        option("{set-point,state,trajectory}", "from the file, else state"),
    ] = None
    """With --robot: where the linear models are taken; see jaxmpc simulate."""
    mass: RobotMass = 0.0
    damping: RobotDamping = 0.0
    payload: Payload = 0.0
    iterations: Annotated[int | None, option("K", "[solver], else 50; robots 0"), at_least(1)] = (
        None
    )
    """ADMM steps of each plan."""
    newton_steps: Annotated[
        int | None, option("K", "[solver], else 20; robots as needed"), at_least(0)
    ] = None
    """Newton steps after them."""
    dtype: Annotated[
        Literal["float32", "float64"] | None,
        option("{float32,float64}", "float64; robots float32"),
    ] = None
    """Precision of loops and derivatives."""
    seed: Annotated[int, option("K", "0"), at_least(0)] = 0
    """Seed of initial states, batches, masses, damping and payloads."""
    output: Annotated[Path, option("DIR", "jaxmpc-weights")] = Path("jaxmpc-weights")
    """Folder for the files; created if absent."""
    resume: Resume = False
    overwrite: Overwrite = False

    def check(self) -> None:
        """Raise ValueError for options that do not go together."""
        if self.robot is None:
            names = ("target", "linearize", "mass", "damping", "payload")
            given = {name: getattr(self, name) or None for name in names}
            refuse(given, None, "It is of robots")
        else:
            given = {"lower": self.lower, "upper": self.upper, "terminal": self.terminal}
            refuse(given, self.robot, "Starts are drawn by --spread, and no terminal set is used")
        if not self.tune or len(set(self.tune)) != len(self.tune):
            fail("--tune", f"{' '.join(self.tune) or 'nothing'}", "Name each quantity once")
        if self.steps is not None and self.seconds is not None:
            fail("--seconds", "given beside --steps", "Give one of them")
