"""The constrained MPC problem as a user states it, and the same one with soft or hard limits."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import Any, NamedTuple, TypeVar

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.arrays import (
    Reals,
    as_array,
    as_column,
    as_weight,
    dimensions,
    fill,
    host_array,
    store_floats,
)
from jaxmpc.checks import (
    concrete,
    fail,
    is_definite,
    require_finite,
    require_kind,
    require_last,
    require_names,
    require_real,
    require_shape,
    require_symmetric_psd,
)
from jaxmpc.pytrees import named_pytree, prepared_pytree, pytree, static, static_pytree
from jaxmpc.qp.linalg import apply, matmul, namespace, symmetric
from jaxmpc.sets.convex_sets import Box, Ellipsoid, Polytope, Zonotope
from jaxmpc.sets.disturbances import is_centred, require_disturbance
from jaxmpc.sets.fields import require_dimension
from jaxmpc.sets.limits import output_limits
from jaxmpc.systems.system import LinearSystem, host_matrices, numbered

T = TypeVar("T")
StagesOf = Callable[[], tuple[int, ...]]

# Curvature of the cost, relative to its terms, below which a direction of the inputs costs nothing.
CURVATURE = 1e-12
# What helps where no state has a plan; without a terminal set no longer horizon: X_{N+1} ⊆ X_N.
RELAX = "Relax a limit; with a terminal set enlarge that or lengthen the horizon"
# What decides whether a state has a plan and may differ from step to step.
HARD = ("system", "states", "inputs", "outputs", "input_rate_limit")
# What makes the arguments that files may give by a name.
MADE_BY = {
    "terminal_cost": "jm.lqr(system, Q, R).P is that of LQR",
    "terminal_set": "jm.design(..., terminal=...) takes names and makes the problem",
}
# How inputs answer to disturbances: see `MPC`.
POLICIES = ("tightened", "tube", "affine")


# Axes that the arrays of limits have at one stage: with one more they differ from stage to stage.
AXES = {"lower": 1, "upper": 1, "H": 2, "h": 1, "C": 2, "D": 2, "rho": 1, "quadratic": 1}


def differing(part: Any) -> tuple[str, ...]:
    """Return the names of the arrays of a set, or of rows, that differ from stage to stage."""
    return tuple(k for k, axes in AXES.items() if dimensions(getattr(part, k, None)) == axes + 1)


def at_stage(part: T, j: int) -> T:
    """Return a set, or rows, at the j-th of the stages at which it holds."""
    names = differing(part)
    values = {name: as_array(getattr(part, name))[j] for name in names}
    return replace(part, **values) if names else part  # type: ignore[type-var]


class TwoSided:
    """Rows C, D with the sides lower and upper, either of them None."""

    C: Any
    D: Any
    lower: Any
    upper: Any

    def __post_init__(self) -> None:
        store_floats(self, *(name for name in vars(self) if name in AXES))
        self._fill()
        store_stages(self, "stages")

    def _fill(self) -> None:
        """Make one row of vectors C and D, and of numbers the sides of every row."""
        if dimensions(self.C) == 1:
            object.__setattr__(self, "C", as_column(self.C).T)
        if (dimensions(self.C) or 0) < 2:
            return  # `validate` says what is wrong, and `in_axes` are rows without arrays
        rows = np.shape(as_array(self.C))[-2]
        if dimensions(self.D) == 1 and rows == 1:
            object.__setattr__(self, "D", as_column(self.D).T)
        for name in ("lower", "upper"):
            if dimensions(getattr(self, name)) == 0:
                fill(self, name, (rows,))

    @property
    def sides(self) -> tuple[Any, Any]:
        """(lower, upper), infinite where there is no such side."""
        lower, upper = self.lower, self.upper
        free = np.full(np.shape(as_array(upper if lower is None else lower))[-1:], np.inf)
        return (-free if lower is None else lower), (free if upper is None else upper)


@pytree
class Outputs(TwoSided):
    """Hard limits of outputs, lower ≤ C x_k + D u_k ≤ upper.

    Arguments:
        C: (p, n), one row an output; a vector is one row.
        lower, upper: (p,), in the units of the outputs, or a number for all; None where all rows
            lack that side, −inf and inf where single rows do.
        D: (p, m), or None for zero.
        stages: the k at which they hold; None: those of the state limits, and where the state
            limits hold at k = N, without D there too.
        names, units: of the p outputs, for tables and pictures; () for none.

    C, D, lower and upper may have a leading axis, an entry for each of the stages.
    """

    C: Reals
    lower: Reals | None = None
    upper: Reals | None = None
    D: Reals | None = None
    stages: tuple[int, ...] | None = static(default=None)
    names: tuple[str, ...] = static(default=())
    units: tuple[str, ...] = static(default=())


@pytree
class Soft(TwoSided):
    """Rows that may be violated at a penalty:

        lower − ε_k ≤ C x_k + D u_k ≤ upper + ε_k,  ε_k ≥ 0,   cost + ρ Σ ε_k + quadratic Σ ε_k²
        (no ½).

    Arguments:
        C, D, lower, upper, names, units: as in `Outputs`.
        rho: ρ ≥ 0, in cost per unit of the row; a number or (p,).
        quadratic: ≥ 0, in cost per squared unit; a number or (p,).
        stages: the k at which they hold; None: k = 0..N, with D k = 0..N−1.

    C, D, lower, upper, rho and quadratic may have a leading axis, an entry for each of the stages.
    For ρ above the greatest multiplier of the hard rows (`exact_penalty`) the plan violates them
    only where the hard problem has no solution.
    """

    C: Reals
    lower: Reals | None = None
    upper: Reals | None = None
    rho: Reals = 1e3
    quadratic: Reals = 0.0
    D: Reals | None = None
    stages: tuple[int, ...] | None = static(default=None)
    names: tuple[str, ...] = static(default=())
    units: tuple[str, ...] = static(default=())


@named_pytree
class Weights(NamedTuple):
    """The weights of a cost as symmetric matrices of one floating type: Q (n, n), R (m, m),
    P (n, n) of x_N and W (m, m) of input rates, zero for None. Q, R and W may have a leading axis
    N; Q and R are then, and with weights of the stages, those of each step."""

    Q: Array
    R: Array
    P: Array
    W: Array

    def of_states(self, x: Array) -> Array:
        """Return Q_k x_k and P x_N (N+1, n): half the gradient of the cost."""
        return jnp.concatenate([apply(self.Q, x[:-1]), matmul(x[-1:], self.P)])

    def of_inputs(self, u: Array) -> Array:
        """Return R_k u_k (N, m)."""
        return apply(self.R, u)


@static_pytree
@dataclass(frozen=True)
class Switch:
    """True or False as a part of a pytree's structure: nothing to trace or to differentiate."""

    on: bool

    def __repr__(self) -> str:
        """Return True or False."""
        return repr(self.on)


@prepared_pytree
class MPC:
    """Constrained linear-quadratic MPC over the horizon N:

        min  Σ_{k<N} (x_k'Q x_k + u_k'R u_k) + x_N'P x_N          (no ½)
        s.t. x_{k+1} = A x_k + B u_k + c,  x_0 given,
             x_k ∈ states (k = 0..N−1; from 1 if constrain_initial is False),
             u_k ∈ inputs (k = 0..N−1),  x_N ∈ terminal_set.

    Arguments:
        system: LinearSystem with n states and m inputs. A (N, n, n), B (N, n, m) and c (N, n), or
            some of them, make it another one at each step: x_{k+1} = A_k x_k + B_k u_k + c_k.
        Q: (n, n) ⪰ 0, or its diagonal (n,), or a number for one state; or one for each step,
            (N, n, n), also (N,) for one state.
        R: (m, m) ⪰ 0, or its diagonal (m,), or a number for one input; or (N, m, m), also (N,) for
            one input.
        horizon: N ≥ 1.
        states: Box or Polytope in the units of x; None: no limits. Its arrays may have a leading
            axis, an entry for each k at which it holds: lower (N, n), H (N, rows, n) and so on.
        inputs: Box or Polytope in the units of u; None: no limits. Its arrays may have a leading
            axis of N steps.
        terminal_cost: P (n, n) ⪰ 0 or its diagonal; None: no terminal cost.
        terminal_set: Box, Polytope or Ellipsoid that holds x_N; None: x_N is free.
        constrain_initial: whether `states` hold at k = 0, which no input moves.
        prestabilise: gain K (m, n) of the substitution u = Kx + v, which keeps long predictions of
            unstable plants well-conditioned; True: the LQR gain; False: none; None: the LQR gain
            where A has an eigenvalue outside the unit circle. It changes rounding, not the problem;
            with control_horizon there is none. Inside `jit` with A as an argument None is none,
            since it reads A: give True, or K itself.
        soft: `Soft`, or a tuple of them.
        outputs: `Outputs`, or a tuple of them.
        constrained_stages: the k in 0..N at which `states` hold, where that is another index set.
        control_horizon: number of free moves m ≤ N, u_k = u_{m−1} from k = m − 1 on, or a tuple of
            block lengths that add up to N (move blocking).
        input_rate_weight: W (m, m) or its diagonal (m,), or a number for one input, or (N, m, m):
            adds Σ Δu_k'W Δu_k with Δu_k = u_k − u_{k−1}.
        input_rate_limit: |Δu_k| ≤ limit, (m,) or a number, or Δu_k in a Box; in the units of u for
            each time step; with a leading axis, (N, m), one for each step. With it, or a weight of
            rates, the previous input u_{−1} is part of the state of the controller:
            `solve(..., previous_input=)`; in sweeps the states are (x, u_{−1}), n + m in all, if
            there is a limit.
        stage_weights: s (N,) ≥ 0 weighs the stages, Σ s_k (x_k'Q x_k + u_k'R u_k); None: all 1.
        disturbance: W, a bounded Box, Polytope or Zonotope that holds the origin: the plant is
            x⁺ = A x + B u + c + E w, and all rows, the terminal set and soft rows too, are kept for
            every w_k ∈ W.
        disturbance_matrix: E (n, p); None: the identity.
        policy: how later inputs answer to disturbances: "tightened", "affine" or, to a Box or
            Zonotope, "tube".
        gain: K (m, n) of the policies, u = Kx; None: the LQR gain of Q and R.

    Weights are symmetric; of one that is traced by JAX the symmetric part counts, in derivatives
    too. R need not be definite where Q, P or input_rate_weight give u_0, the input that is applied,
    a cost: it is unique then. Later ones may have none, as the last has without an end cost;
    solvers stage by stage and explicit laws need a cost of each.

    The policy "tightened" is u_k = v_k + K (x_k − z_k) with z the nominal states of the plan v.
    Plans, costs and multipliers are those of z and v, whose rows are tightened by what the
    disturbance can do (`tightening.py`). "affine": u_k = v_k + Σ_{j<k} M_kj w_j, of which these are
    a part; it has the largest feasible set. "tube": u_k = v_k + K (x_k − z_k) with z_0 anywhere in
    x_0 − S, S the minimal robust invariant set under K. Plans of these two are those of the
    undisturbed plant under the policy, from x_0, and so are their costs (`policy_rows.py`). Labels
    of feasible sets are claims about the policy.
    """

    system: LinearSystem
    Q: Any
    R: Any
    horizon: int = static()
    states: Box | Polytope | None = None
    inputs: Box | Polytope | None = None
    terminal_cost: Any = None
    terminal_set: Box | Polytope | Ellipsoid | None = None
    constrain_initial: bool = static(default=True)
    prestabilise: Any = None
    soft: tuple[Soft, ...] | Soft = ()
    outputs: tuple[Outputs, ...] | Outputs = ()
    constrained_stages: tuple[int, ...] | None = static(default=None)
    control_horizon: int | tuple[int, ...] | None = static(default=None)
    input_rate_weight: Any = None
    input_rate_limit: Any = None
    stage_weights: Any = None
    disturbance: Any = None
    disturbance_matrix: Any = None
    policy: str = static(default="tightened")
    gain: Any = None

    def __post_init__(self) -> None:
        N = self.horizon
        if not concrete(N):
            cure = (
                "It is static: give a Python int; jm.mpc.stack_horizons makes a batch of horizons"
            )
            fail("horizon", "is traced by JAX", cure)
        if not isinstance(N, int | np.integer) or isinstance(N, bool) or N < 1:
            require_kind("system", self.system, LinearSystem)  # MPC(A, B, Q, R, 10)
            fail("horizon", f"{N!r}", "Give a whole number of steps, at least 1")
        weights = ("Q", "R", "terminal_cost", "input_rate_weight", "stage_weights")
        store_floats(self, *weights, "prestabilise", "input_rate_limit")
        store_floats(self, "disturbance_matrix", "gain")
        store_stages(self, "constrained_stages")
        for name in ("outputs", "soft"):
            if isinstance(getattr(self, name), list):
                object.__setattr__(self, name, tuple(getattr(self, name)))
        if isinstance(self.control_horizon, np.ndarray) and not self.control_horizon.ndim:
            object.__setattr__(self, "control_horizon", self.control_horizon.item())
        if isinstance(self.control_horizon, list | range | np.ndarray):
            store_stages(self, "control_horizon")
        for name, cure in MADE_BY.items():
            if isinstance(getattr(self, name), str):
                fail(name, f"{getattr(self, name)!r} is text, which files alone know", cure)
        if dimensions(self.disturbance_matrix) == 1:
            object.__setattr__(self, "disturbance_matrix", as_column(self.disturbance_matrix))
        # JAX rebuilds this object with placeholders, and `in_axes` are one without arrays.
        if isinstance(self.prestabilise, bool | np.bool_):
            object.__setattr__(self, "prestabilise", Switch(bool(self.prestabilise)))
        system = self.system
        if not isinstance(system, LinearSystem):
            return
        if not {dimensions(system.A), dimensions(system.B)} <= {2, 3}:
            return
        n, m = system.n, system.m
        for name, size in (("Q", n), ("R", m), ("terminal_cost", n), ("input_rate_weight", m)):
            steps = None if name == "terminal_cost" else self.horizon
            object.__setattr__(self, name, as_weight(getattr(self, name), size, steps))
        sets = {"states": n, "inputs": m, "terminal_set": n, "disturbance": self.disturbances}
        for name, size in sets.items():
            if isinstance(getattr(self, name), Box):
                object.__setattr__(self, name, getattr(self, name).spread(size))
        self._require_fitting(n, m)

    def _require_fitting(self, n: int, m: int) -> None:
        """Raise ValueError where the last axes of weights and limits do not fit n states and m
        inputs: what a constructor can say whatever stands for the numbers."""
        weights = {
            "Q": (n, "Q weighs the states: one row for each"),
            "R": (m, "R weighs the inputs: one row for each"),
            "terminal_cost": (n, "P weighs the last state"),
            "input_rate_weight": (m, f"Give ({m}, {m}) or ({m},)"),
        }
        for name, (size, cure) in weights.items():
            value = getattr(self, name)
            if dimensions(value):
                if np.shape(as_array(value)) == (self.horizon, size) != (size, size):
                    cure = self._of_diagonals(name, size)
                require_last(name, value, (size, size), cure)
        for name, size in (("states", n), ("inputs", m), ("terminal_set", n)):
            part = getattr(self, name)
            kinds = ((Box, "lower"), (Polytope, "H"), (Ellipsoid, "P"))
            found = [getattr(part, held) for kind, held in kinds if isinstance(part, kind)]
            if found and dimensions(found[0]):
                require_dimension(name, np.shape(as_array(found[0]))[-1], size)

    @property
    def disturbances(self) -> int:
        """Number p of coordinates of the disturbance: the columns of E, n without it."""
        E = self.disturbance_matrix
        return self.system.n if E is None else (np.shape(as_array(E)) or (1,))[-1]

    @property
    def rate_limited(self) -> bool:
        """True when the feasible set depends on the previous input."""
        return self.input_rate_limit is not None

    @property
    def input_in_state(self) -> bool:
        """True when the plan depends on the previous input."""
        return self.rate_limited or self.input_rate_weight is not None

    @property
    def dimension(self) -> int:
        """Number of coordinates of the parameter (x_0, u_{−1}) of the problem: n, or n + m."""
        return self.system.n + (self.system.m if self.input_in_state else 0)

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels of these coordinates, with units."""
        system = self.system
        previous = tuple(f"previous {label}" for label in system.input_labels)
        return system.state_labels + (previous if self.input_in_state else ())

    def volume_unit(self, axes: Sequence[int] | None = None) -> str:
        """Return the unit of volumes of these coordinates (None: those of feasible sets), with a
        blank before it, such as " rad·rad/s" or " mg²"; "" where one of them has no unit."""
        system = self.system
        units = (system.state_units or ("",) * system.n) + (system.input_units or ("",) * system.m)
        if axes is None:
            axes = range(system.n + (system.m if self.rate_limited else 0))
        chosen = [units[i] for i in axes]
        return " " + _product_unit(chosen) if all(chosen) else ""

    @property
    def state_stages(self) -> tuple[int, ...]:
        """The k at which `states` hold."""
        if self.constrained_stages is not None:
            return tuple(sorted(self.constrained_stages))
        return tuple(range(0 if self.constrain_initial else 1, self.horizon))

    @property
    def moves(self) -> tuple[int, ...]:
        """Number of the free move that each of the N inputs is."""
        blocks, N = self.control_horizon, self.horizon
        if blocks is None:
            return tuple(range(N))
        if isinstance(blocks, int | np.integer):
            return tuple(min(k, int(blocks) - 1) for k in range(N))
        return tuple(int(i) for i in np.repeat(np.arange(len(blocks)), blocks))

    def validate(self) -> None:
        """Raise ValueError that names the field, its value and the cure, before any compile."""
        self.require_sizes()
        if not isinstance(self.constrain_initial, bool | np.bool_):
            fail("constrain_initial", f"{self.constrain_initial!r}", "Give True or False")
        self._validate_stages()
        n, m = self.system.n, self.system.m
        self._require_weight("Q", n, "Q weighs the states: one row for each")
        self._require_weight("R", m, "R weighs the inputs: one row for each")
        if self.terminal_cost is not None:
            require_shape("terminal_cost", self.terminal_cost, (n, n), "P weighs the last state")
            require_symmetric_psd("terminal_cost", self.terminal_cost)
        if self.stage_weights is not None:
            s, N = self.stage_weights, self.horizon
            require_shape("stage_weights", s, (N,), "One number for each k = 0..N−1")
            if concrete(s) and not (np.all(np.isfinite(s)) and np.all(np.asarray(s) >= 0)):
                fail("stage_weights", f"{np.asarray(s).tolist()}", "Give numbers of at least 0")
        every = lambda: tuple(range(self.horizon))
        sets: tuple[tuple[str, tuple[type, ...], int, StagesOf | None], ...] = (
            ("states", (Box, Polytope), n, lambda: self.state_stages),
            ("inputs", (Box, Polytope), m, every),
            ("terminal_set", (Box, Polytope, Ellipsoid), n, None),
        )
        for name, kinds, size, stages in sets:
            value = getattr(self, name)
            if value is None:
                continue
            if not isinstance(value, kinds):
                wanted = " or ".join(kind.__name__ for kind in kinds)
                cure = f"Give a {wanted}, or None"
                if isinstance(value, int):
                    cure += "; numbers of steps are horizon= and control_horizon="
                fail(name, f"is a {type(value).__name__}", cure)
            for where, part in _stage_by_stage(name, value, stages):
                part.validate(where, size)
            if isinstance(value, Ellipsoid):
                value.require_origin(name)
        if not isinstance(self.prestabilise, Switch | None):
            K = self.prestabilise
            if np.shape(K) != (self.horizon, m, n):
                require_shape("prestabilise", K, (m, n), "A gain K with u = Kx + v, or N of them")
        for i, soft in enumerate(as_tuple("soft", self.soft, Soft)):
            self._validate_rows(f"soft[{i}]", soft)
            for what, weight in (("rho", soft.rho), ("quadratic", soft.quadratic)):
                name = f"soft[{i}].{what}"
                require_real(name, weight)
                shape, rows = np.shape(as_array(weight)), np.shape(as_array(soft.C))[-2:-1]
                if shape != () and (len(shape) > 2 or shape[-1:] != rows):
                    fail(name, f"shape {shape}", "One number, or one a row")
                require_finite(name, weight)
                if concrete(weight) and np.any(np.asarray(weight) < 0):
                    fail(name, f"{weight}", "Penalties are at least 0")
        for i, outputs in enumerate(as_tuple("outputs", self.outputs, Outputs)):
            self._validate_rows(f"outputs[{i}]", outputs)
        self._validate_rates()
        self._validate_disturbance()
        self.require_unique_inputs(first=1)

    def require_sizes(self) -> None:
        """Raise ValueError where the system is wrong, which gives all else its shape."""
        require_kind("system", self.system, LinearSystem)
        self.system.validate(self.horizon)

    @property
    def varying(self) -> tuple[str, ...]:
        """Names of the data that differ from step to step: "system.A", "Q", "states" and so on."""
        system = self.system
        matrices = {
            "system.A": system.A,
            "system.B": system.B,
            "Q": self.Q,
            "R": self.R,
            "input_rate_weight": self.input_rate_weight,
        }
        found = [name for name, value in matrices.items() if dimensions(value) == 3]
        found += ["system.c"] if dimensions(system.c) == 2 else []
        for name in ("states", "inputs", "outputs", "soft", "input_rate_limit"):
            value = getattr(self, name)
            parts = value if isinstance(value, tuple) else (value,)
            if any(map(differing, parts)) or dimensions(value) == 2:
                found.append(name)
        return tuple(found)

    def differs(self, *names: str) -> str | None:
        """Return the first name of `varying` that is one of these, or of a part of one; None for
        none. names: none stands for all."""
        own = (name for name in self.varying if not names or {name, name.split(".")[0]} & {*names})
        return next(own, None)

    def require_constant(self, what: str, *names: str) -> None:
        """Raise ValueError where data differ from step to step, and say why they must not; names:
        as in `differs`."""
        name = self.differs(*names)
        if name is not None:
            cure = "Give the same at all steps: leave the leading axis out"
            fail(name, f"differs from step to step, and {what}", cure)

    def _require_weight(self, name: str, size: int, cure: str) -> None:
        """Raise ValueError unless a weight is a matrix, or one for each step, and none is
        indefinite."""
        value, N = getattr(self, name), self.horizon
        shape = np.shape(as_array(value)) if dimensions(value) is not None else ()
        if shape == (N, size) != (size, size):
            cure = self._of_diagonals(name, size)
        if len(shape) != 3:
            require_shape(name, value, (size, size), cure)
            require_symmetric_psd(name, value)
            return
        require_shape(name, value, (N, size, size), f"A leading axis counts the {N} steps")
        for k in range(N if concrete(value) else 0):
            require_symmetric_psd(f"{name}[{k}]", np.asarray(value)[k])

    def _of_diagonals(self, name: str, size: int) -> str:
        """Return what to do about a weight of shape (N, size)."""
        N = self.horizon
        return f"For the diagonals of {N} steps give {name}[:, :, None] * np.eye({size})"

    def _validate_stages(self) -> None:
        N = self.horizon
        require_stages("constrained_stages", self.constrained_stages, N)
        if not self.constrain_initial and 0 in (self.constrained_stages or ()):
            what = "is False, and constrained_stages has 0"
            fail("constrain_initial", what, "Leave 0 out, or this argument")
        blocks = self.control_horizon
        if blocks is None:
            return
        gain = self.prestabilise
        if isinstance(gain, Switch):
            given = gain.on
        else:
            given = gain is not None and concrete(gain) and bool(np.any(np.asarray(gain)))
        if given:
            fail("prestabilise", "given beside control_horizon", "Blocked inputs are u, not u − Kx")
        lengths = blocks if isinstance(blocks, tuple) else (blocks,)
        if not _whole_numbers(lengths) or min(lengths, default=0) < 1:
            cure = "Give a number of moves, or a tuple of block lengths, such as (1, 1, 3)"
            fail("control_horizon", f"{blocks!r}", cure)
        if isinstance(blocks, tuple) and sum(blocks) != N:
            fail("control_horizon", f"{blocks} adds up to {sum(blocks)}", f"Make it {N} steps")
        if not isinstance(blocks, tuple) and blocks > N:
            fail("control_horizon", f"{blocks} moves in {N} steps", f"Give at most {N}")

    def _validate_rows(self, name: str, rows: Soft | Outputs) -> None:
        """Raise ValueError unless rows have the sizes of the problem, at each of their stages."""
        last = self.horizon - (rows.D is not None)
        require_stages(f"{name}.stages", rows.stages, last)
        find: Any = soft_stages if isinstance(rows, Soft) else output_stages
        for where, part in _stage_by_stage(name, rows, lambda: find(self, rows)):
            self._validate_rows_at(where, part)

    def _validate_rows_at(self, name: str, rows: Soft | Outputs) -> None:
        n, m = self.system.n, self.system.m
        require_real(f"{name}.C", rows.C)
        shape = np.shape(as_array(rows.C))
        if len(shape) != 2 or shape[1] != n or not shape[0]:
            fail(f"{name}.C", f"shape {shape}", f"Give (p, {n}), one column a state")
        p = shape[0]
        require_finite(f"{name}.C", rows.C)
        if rows.D is not None:
            require_shape(f"{name}.D", rows.D, (p, m), "One column an input, or None")
            require_finite(f"{name}.D", rows.D)
        if rows.lower is None and rows.upper is None:
            fail(f"{name}.upper", "is None, and so is lower", "Give one of them, or both")
        for bound in ("lower", "upper"):
            value = getattr(rows, bound)
            if value is None:
                continue
            require_shape(f"{name}.{bound}", value, (p,), "One bound for each row of C")
            if concrete(value) and np.isnan(np.asarray(value, float)).any():
                fail(f"{name}.{bound}", "holds NaN", "Use inf where there is no limit")
        if concrete(rows.sides):  # −inf above or inf below: no row reaches that
            Box(*rows.sides).validate(name)
        for what in ("names", "units"):
            require_names(f"{name}.{what}", getattr(rows, what), p)

    def _validate_rates(self) -> None:
        m, W, limit = self.system.m, self.input_rate_weight, self.input_rate_limit
        if W is not None:
            require_real("input_rate_weight", W)
            if np.ndim(W) < 2:
                fail("input_rate_weight", f"shape {np.shape(W)}", f"Give ({m}, {m}) or ({m},)")
            self._require_weight("input_rate_weight", m, "One row for each input")
        if isinstance(limit, Box):
            every = lambda: tuple(range(self.horizon))
            for where, part in _stage_by_stage("input_rate_limit", limit, every):
                part.validate(where, m)
        elif limit is not None:
            if concrete(limit):
                host_array("input_rate_limit", limit)
            if np.shape(limit) not in ((), (m,), (self.horizon, m)):
                fail("input_rate_limit", f"shape {np.shape(limit)}", f"Give ({m},) or a Box")
            if concrete(limit) and not np.all(np.asarray(limit, float) >= 0):
                fail("input_rate_limit", f"{limit}", "|Δu| ≤ limit needs limit ≥ 0 (inf: none)")

    def _validate_disturbance(self) -> None:
        n, m, W = self.system.n, self.system.m, self.disturbance
        if self.policy not in POLICIES:
            fail("policy", f"{self.policy!r}", f"Give one of {', '.join(map(repr, POLICIES))}")
        if W is None:
            for name in ("disturbance_matrix", "gain"):
                if getattr(self, name) is not None:
                    fail(name, "given without a disturbance", "Give disturbance=jm.Box(…) too")
            if self.policy != "tightened":
                cure = "Give disturbance=jm.Box(…) too, or leave policy out"
                fail("policy", f"{self.policy!r} without a disturbance", cure)
            return
        self.require_constant("policies against a disturbance know one for all", *HARD, "soft")
        if self.gain is None and self.policy != "affine":
            self.require_constant("no LQR belongs to it: a disturbance needs a gain then", "Q", "R")
        if self.disturbance_matrix is not None:
            p = self.disturbances
            require_real("disturbance_matrix", self.disturbance_matrix)
            require_shape("disturbance_matrix", self.disturbance_matrix, (n, p), "One row a state")
            require_finite("disturbance_matrix", self.disturbance_matrix)
        require_disturbance("disturbance", W, self.disturbances)
        off_centre = isinstance(W, Box | Zonotope) and concrete(W) and not is_centred(W)
        held = len(set(self.moves)) < self.horizon
        if self.policy == "affine" and held and off_centre:
            cure = "Move its centre w into system.c, by disturbance_matrix times w, and W by -w"
            what = "is not symmetric about 0, where a control horizon holds affine policies"
            fail("disturbance", what, cure)
        if self.gain is not None and self.policy == "affine":
            fail("gain", "given with affine policies, which find their own", "Leave it out")
        if self.gain is not None:
            require_real("gain", self.gain)
            require_shape("gain", self.gain, (m, n), "A gain K with u = v + K (x − z)")
            require_finite("gain", self.gain)
        if isinstance(self.terminal_set, Ellipsoid):
            cure = "Give a Polytope, such as maximal_invariant_set(..., disturbance=...)"
            fail("terminal_set", "is an Ellipsoid, which has no rows to tighten", cure)

    def require_unique_inputs(self, first: int = 0) -> None:
        """Raise ValueError where R is not definite and the other weights do not make up for it.

        first: the move from which on inputs may have no cost: 0, none of them; 1, all but the one
        that is applied, as in tracking without an end cost.

        By a Riccati recursion for the state (x_k, u_{k−1}), which holds a blocked input too: the
        Hessian of the condensed cost is definite where G = s R + W + B'SB is, at each free move;
        where G is at k = 0, whatever the others are, all minimisers have the same u_0.
        """
        data = (self.system, self.Q, self.R, self.terminal_cost, self.stage_weights)
        if not concrete(data, self.input_rate_weight):
            return
        n, m, N = self.system.n, self.system.m, self.horizon
        all_R, stage = host_array("R", self.R), self.stage_weights
        definite = all(is_definite(R) for R in all_R.reshape(-1, m, m))
        if definite and (stage is None or np.all(np.asarray(stage) > 0)):
            return
        stage = np.ones(N) if stage is None else np.asarray(stage, float)
        zero = lambda size: np.zeros((size, size))
        each = lambda M: np.broadcast_to(M, (N, *M.shape[-2:]))
        given = lambda W, size: zero(size) if W is None else np.asarray(W, float)
        all_R, all_Q = each(all_R), each(np.asarray(self.Q, float))
        all_A, all_B = map(each, host_matrices(self.system, by_step=True)[:2])
        all_W = each(given(self.input_rate_weight, m))
        block = lambda a, b, c, d: np.block([[a, b], [c, d]])
        off = np.zeros((n, m))
        S = size = block(given(self.terminal_cost, n), off, off.T, zero(m))
        moves = self.moves
        for k in reversed(range(N)):
            A, B, W = all_A[k], all_B[k], all_W[k]
            held = block(A, B, off.T, np.eye(m))  # u_k = u_{k−1}
            free, move = block(A, off, off.T, zero(m)), np.vstack([B, np.eye(m)])
            cost, effort = block(stage[k] * all_Q[k], off, off.T, zero(m)), stage[k] * all_R[k]
            if k and moves[k] == moves[k - 1]:
                own = block(zero(n), 0 * B, 0 * B.T, effort)
                S, size = cost + own + held.T @ S @ held, abs(cost + own) + _form(held, size)
                continue
            G = effort + W + move.T @ S @ move
            # In units of its own terms, of which rounding leaves eps.
            terms = np.diag(abs(effort) + abs(W) + _form(move, size))
            unit = 1 / np.sqrt(np.where(terms > 0, terms, 1.0))
            values, axes = np.linalg.eigh(unit[:, None] * G * unit)
            curved = values > CURVATURE
            if not (curved.all() or 0 < first <= moves[k]):
                self._refuse_flat(k, unit[:, None] * axes[:, ~curved])
            Y = move.T @ S @ free - np.hstack([np.zeros((m, n)), W])
            axes = unit[:, None] * axes[:, curved]
            K = -(axes / values[curved]) @ axes.T @ Y
            closed, rate = free + move @ K, K - np.hstack([np.zeros((m, n)), np.eye(m)])
            size = abs(cost) + _form(free, size) + _form(np.eye(n + m)[n:], abs(W))
            S = cost + closed.T @ S @ closed + K.T @ effort @ K + rate.T @ W @ rate

    def _refuse_flat(self, k: int, directions: np.ndarray) -> None:
        labels = self.system.input_names or numbered("u", self.system.m)
        large = (abs(directions) > 0.1 * abs(directions).max(axis=0)).any(axis=1)
        names = ", ".join(name for name, one in zip(labels, large, strict=True) if one)
        if self.stage_weights is not None and np.asarray(self.stage_weights)[k] == 0:
            what = f"is 0 at k = {k}, where R then costs nothing and no other weight gives {names}"
            cure = f"Give stage {k} a positive weight, or every input one in input_rate_weight"
            fail("stage_weights", f"{what} a cost", cure)
        what = f"is not positive definite, and at k = {k} no other weight gives {names} a cost"
        cure = "Put a positive weight on every input, in R or in input_rate_weight"
        last = self.terminal_cost is None and k == self.horizon - 1
        fail("R", what, f"{cure}{', or give a terminal_cost' if last else ''}")


def weights_of(mpc: MPC, dtype: Any) -> Weights:
    """Return the weights as all solvers and costs take them. Works inside jit, vmap and grad.

    x'Qx depends on the symmetric part of Q alone. Of a Q that is not symmetric a minimiser
    would take it for curvature, but Q itself for linear terms.
    """

    given = mpc.Q, mpc.R, mpc.terminal_cost, mpc.input_rate_weight, mpc.stage_weights
    xp = namespace(given)

    def matrix(value: Reals | None, size: int) -> Array:
        M = xp.asarray(np.zeros(size) if value is None else value, dtype)
        return symmetric(xp.diag(M) if M.ndim == 1 else M)

    n, m = mpc.system.n, mpc.system.m
    Q, R, P = matrix(mpc.Q, n), matrix(mpc.R, m), matrix(mpc.terminal_cost, n)
    if mpc.stage_weights is not None:
        stage = xp.asarray(mpc.stage_weights, dtype)[:, None, None]
        Q, R = stage * Q, stage * R
    return Weights(Q, R, P, matrix(mpc.input_rate_weight, m))


def dynamics_of(system: LinearSystem, dtype: Any) -> tuple[Array, Array, Array]:
    """Return A, B and c, zero for None, in one floating type, each with a leading axis where it
    differs from step to step. Works inside jit, vmap and grad."""
    xp = namespace((system.A, system.B, system.c))
    A, B = xp.asarray(system.A, dtype), xp.asarray(system.B, dtype)
    return A, B, xp.zeros(system.n, dtype) if system.c is None else xp.asarray(system.c, dtype)


def _product_unit(units: Sequence[str]) -> str:
    """Return the product of units: ("mg", "mg") gives "mg²", ("m/s", "rad") "(m/s)·rad"."""
    different = list(dict.fromkeys(units))
    factors = []
    for unit in different:
        power = units.count(unit)
        ends = power == 1 and unit == different[-1]  # nothing after it could be read as divided
        factor = unit if ends or not set(unit) & set("/ ·^") else f"({unit})"
        raised = str(power).translate(str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹"))
        factors.append(factor + (raised if power > 1 else ""))
    return "·".join(factors)


def _form(M: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Return the size of the terms of M'SM where those of S have this size."""
    return abs(M).T @ size @ abs(M)


def store_stages(instance: Any, name: str) -> None:
    """Make a tuple of a field of a frozen dataclass: of a number, a list, a range or an array."""
    value = getattr(instance, name)
    if value is not None:
        object.__setattr__(instance, name, tuple(np.atleast_1d(np.asarray(value, object))))


def _whole_numbers(values: tuple) -> bool:
    """Return whether all are whole numbers; entries of a mask are none."""
    return all(isinstance(k, int | np.integer) and not isinstance(k, bool) for k in values)


def require_stages(name: str, stages: Any, last: int) -> None:
    """Raise ValueError unless `stages` is None or different whole numbers from 0 to `last`."""
    if stages is None:
        return
    whole = _whole_numbers(stages) and all(0 <= k <= last for k in stages)
    if not whole or len(set(stages)) != len(stages):
        cure = f"Give a tuple of different stages from 0 to {last}"
        if any(k is True for k in stages):
            cure = "Give np.flatnonzero(mask) in place of a mask"
        fail(name, f"{stages!r}", cure)


def _stage_by_stage(name: str, part: Any, at: StagesOf | None) -> Iterator[tuple[str, Any]]:
    """Yield a set, or rows, with the name for errors: at each of its stages where it differs from
    one to the next (what is traced at the first alone, for its shapes), else once. at: gives the
    stages, None for a set that may not differ. Raises ValueError for a leading axis of another
    length."""
    names = differing(part)
    if at is None or not names:
        yield name, part
        return
    stages = at()
    for field in names:
        shape = np.shape(as_array(getattr(part, field)))
        if shape[0] != len(stages):
            cure = f"A leading axis counts the {len(stages)} stages at which they hold"
            fail(f"{name}.{field}", f"shape {shape}", cure)
    for j, k in enumerate(stages if concrete(part) else stages[:1]):
        yield f"{name} at k = {k}", at_stage(part, j)


def soft_stages(mpc: MPC, rows: Soft) -> tuple[int, ...]:
    """The k at which soft rows hold."""
    every = tuple(range(mpc.horizon + (rows.D is None)))
    return every if rows.stages is None else rows.stages


def output_stages(mpc: MPC, rows: Outputs) -> tuple[int, ...]:
    """The k at which output limits hold."""
    if rows.stages is not None:
        return rows.stages
    return tuple(k for k in mpc.state_stages if k < mpc.horizon or rows.D is None)


def within_outputs(mpc: MPC, K: Reals) -> Box | Polytope | None:
    """Return the states within their limits where u = K x keeps the limits of outputs at the end
    of the horizon, of C x + D K x, as a plan that goes on by this law has to; None without limits.
    Rows that differ from stage to stage are left out. NumPy in float64; not traceable."""
    outputs = as_tuple("outputs", mpc.outputs, Outputs)
    end = {mpc.horizon - 1, mpc.horizon}
    last = [rows for rows in outputs if end & set(output_stages(mpc, rows))]
    kept = _limits_within(mpc.states, [rows for rows in last if not differing(rows)], K)
    if last and kept is not None and kept.is_empty():
        problem = "hold at no state within the limits under the terminal law u = Kx"
        fail("outputs", problem, 'Loosen one of the two, or give terminal="none"')
    return kept


def folded(mpc: MPC) -> MPC:
    """Return the same problem, where limits of outputs that are functions of the state at the
    stages of its limits are among these."""
    outputs = as_tuple("outputs", mpc.outputs, Outputs)
    if not concrete((mpc.states, outputs)) or differing(mpc.states):
        return mpc
    at_its_stages = lambda rows: output_stages(mpc, rows) == mpc.state_stages
    of_state = lambda rows: rows.D is None and at_its_stages(rows) and not differing(rows)
    states = _limits_within(mpc.states, list(filter(of_state, outputs)), None)
    return replace(mpc, states=states, outputs=tuple(r for r in outputs if not of_state(r)))


def _limits_within(
    states: Box | Polytope | None, outputs: Sequence[Outputs], K: Reals | None
) -> Box | Polytope | None:
    """Return the states within their limits and those of outputs under u = K x."""
    for rows in outputs:
        C = host_array("C", rows.C)
        if rows.D is not None and K is not None:
            C = C + host_array("D", rows.D) @ host_array("K", K)
        lower, upper = rows.sides
        allowed = output_limits(C, lower, upper, rows.names, rows.units)
        both: Any = allowed if states is None else states.intersect(allowed)
        states = both
    return states


def as_tuple(name: str, value: Any, kind: type) -> tuple:
    """One or several as a tuple; ValueError for anything else."""
    value = (value,) if isinstance(value, kind) else value
    if not isinstance(value, tuple | list) or not all(isinstance(v, kind) for v in value):
        fail(name, f"{type(value).__name__}", f"Give a jm.{kind.__name__}, or a tuple of them")
    return tuple(value)


def soften(mpc: MPC, rho: Reals, quadratic: Reals = 0.0) -> MPC:
    """The same problem with all state, output and terminal rows soft; inputs and rates stay hard.

    rho, quadratic: weights of every row, as in `Soft`. Rows keep their units: a violation is
    measured as H x − h in the row as given. Raises ValueError for an Ellipsoid as terminal set,
    which has no rows.
    """
    require_kind("mpc", mpc, MPC)
    mpc.validate()
    if isinstance(rho, str) and rho == "exact":
        fail("rho", f"{rho!r}", "Give a number: jm.explicit.exact_penalty(mpc).advised is exact")
    if isinstance(mpc.terminal_set, Ellipsoid):
        fail("terminal_set", "is an Ellipsoid, which stays hard", "Use a Polytope inside it")
    hard = []
    for kind, limits, stages in (
        ("state", mpc.states, mpc.state_stages),
        ("terminal", mpc.terminal_set, (mpc.horizon,)),
    ):
        if limits is not None:
            C, lower, upper = limits.rows()
            names, units = mpc.system.state_names, mpc.system.state_units
            if isinstance(limits, Polytope):
                names, units = limits.labels, ()
            names = names or numbered(f"{kind} row ", np.shape(lower)[-1])
            hard.append(Outputs(C, lower, upper, None, stages, names, units))
    for rows in as_tuple("outputs", mpc.outputs, Outputs):
        names = rows.names or numbered("output row ", np.shape(rows.sides[0])[-1])
        hard.append(replace(rows, stages=output_stages(mpc, rows), names=names))
    soft = list(as_tuple("soft", mpc.soft, Soft))
    for rows in filter(None, map(_with_limits, hard)):
        below, above = rows.sides
        one_sided = concrete(below) and not np.isfinite(below).any()
        more = (rows.D, rows.stages, rows.names, rows.units)
        soft.append(Soft(rows.C, None if one_sided else below, above, rho, quadratic, *more))
    softened = replace(mpc, states=None, terminal_set=None, outputs=(), soft=tuple(soft))
    softened.validate()
    return softened


def _with_limits(rows: Outputs) -> Outputs | None:
    """Return the rows with a finite limit, None where there are none. Limits inside a trace cannot
    be read: all their rows are taken."""
    if not rows.stages or not concrete(rows):
        return rows if rows.stages else None
    lower, upper = rows.sides
    bounded = np.isfinite(lower) | np.isfinite(upper)
    bounded = bounded.any(axis=tuple(range(bounded.ndim - 1)))
    keep = lambda v: np.asarray(v)[..., bounded]
    of_rows = lambda M: np.asarray(M)[..., bounded, :]
    text = lambda v: tuple(str(part) for part in keep(v)) if v else ()
    limited = replace(
        rows,
        C=of_rows(rows.C),
        lower=keep(lower),
        upper=keep(upper),
        D=None if rows.D is None else of_rows(rows.D),
        names=text(rows.names),
        units=text(rows.units),
    )
    return limited if bounded.any() else None


def harden(mpc: MPC) -> MPC:
    """The same problem with every soft row hard: what a large enough penalty enforces where it can.

    The opposite of `soften`: rows that hold at all steps of the state limits join `states`, rows at
    k = N the terminal set, where these are not sets of another kind; the rest become `outputs`.
    """
    N, every = mpc.horizon, mpc.state_stages
    states, terminal, outputs = [], [], list(as_tuple("outputs", mpc.outputs, Outputs))
    for s in as_tuple("soft", mpc.soft, Soft):
        steps = soft_stages(mpc, s)
        lower, upper = s.sides
        if differing(replace(s, rho=0.0, quadratic=0.0)):
            outputs.append(Outputs(s.C, lower, upper, s.D, steps, s.names, s.units))
            continue
        rows = Polytope(s.C, upper, s.names)
        if s.lower is not None:
            rows = output_limits(s.C, lower, upper, s.names, s.units)
        whole = s.D is None and every and set(every) <= set(steps) <= {*every, N}
        if whole and mpc.states is None:
            states.append(rows)
            steps = tuple(set(steps) - set(every))
        if s.D is None and steps == (N,) and mpc.terminal_set is None:
            terminal.append(rows)
            steps = ()
        if steps:
            outputs.append(Outputs(s.C, lower, upper, s.D, steps, s.names, s.units))
    join = lambda given, found: reduce(Polytope.intersect, found) if found else given
    sets = {"states": join(mpc.states, states), "terminal_set": join(mpc.terminal_set, terminal)}
    return replace(mpc, soft=(), outputs=tuple(outputs), **sets)
