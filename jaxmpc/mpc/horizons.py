"""Problems of different horizons in one batch: the shorter ones padded to the longest.

A problem of N steps becomes one of M ≥ N by M − N steps that do nothing: A = I, B = 0, c = 0,
Q = 0, no limits, and R positive. Then x_M = … = x_N for all inputs, so that the terminal cost and
the terminal set, which are those of x_M now, are asked of the same state; the first N steps have
the costs and limits that they had; and the inputs from step N on move nothing and cost u'Ru, which
is least for u = 0. Minimisers and multipliers of the first N steps are the same, the least cost
is, and so are the states from which there is a plan. (Where moves are blocked the added inputs are
those of the last block, and cost nothing.) A constant forecast is one of the first N steps.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import jax
import numpy as np

from jaxmpc.arrays import dimensions, module_of
from jaxmpc.checks import concrete, fail, require_kind, whole
from jaxmpc.mpc.condense import prestabilising_gain
from jaxmpc.mpc.problem import (
    AXES,
    MPC,
    Outputs,
    Soft,
    Switch,
    as_tuple,
    differing,
    output_stages,
    soft_stages,
)
from jaxmpc.sets.convex_sets import Box


def pad_horizon(mpc: MPC, horizon: int) -> MPC:
    """Return the problem with a longer horizon and the same plans: u_0 … u_{N−1} and x_0 … x_N are
    those of `mpc`, whose N steps are followed by steps that do nothing (see above).

    horizon: number of steps, at least N. A reference (N+1, n) goes on with its last row. Problems
    with the same limits and weights but other horizons have the same structure afterwards, whatever
    their horizon was: `stack_horizons` makes a batch of them. Works inside jit and grad. Raises
    ValueError for an ill-posed problem and one with disturbances, and for a shorter horizon.
    """
    require_kind("mpc", mpc, MPC)
    mpc.validate()
    whole("horizon", horizon, mpc.horizon)
    if mpc.disturbance is not None:
        cure = "Leave it out, or solve problems of each horizon apart"
        fail("mpc.disturbance", "given, and policies against it have one horizon", cure)
    return _Padding(mpc, horizon).padded()


def stack_horizons(problems: Sequence[MPC]) -> MPC:
    """Return problems of different horizons as one batch, padded to the longest: an `MPC` whose
    arrays have a leading axis, for `jax.vmap`.

        plans = jax.vmap(jm.solve)(jm.mpc.stack_horizons(problems), x0s)
        plans.inputs[i, : problems[i].horizon]

    problems: a list of them, of the same sizes, kinds of limits and settings.

    Raises ValueError with the number of a problem that differs from the first one.
    """
    if not isinstance(problems, Sequence) or not problems:
        fail("problems", f"is a {type(problems).__name__} without problems", "Give a list of MPCs")
    for i, mpc in enumerate(problems):
        require_kind(f"problems[{i}]", mpc, MPC)
    longest = max(mpc.horizon for mpc in problems)
    padded = [pad_horizon(mpc, longest) for mpc in problems]
    form = lambda mpc: (jax.tree.structure(mpc), [np.shape(v) for v in jax.tree.leaves(mpc)])
    for i, mpc in enumerate(padded):
        if form(mpc) != form(padded[0]):
            what = "has other sizes, limits or settings than problems[0]"
            fail(f"problems[{i}]", what, "Stack problems that differ in numbers and horizon alone")
    xp = module_of(padded)
    return jax.tree.map(lambda *v: xp.stack(v), *padded)


class _Padding:
    """A problem, and the length that it gets. What is known stays known beside what is traced."""

    def __init__(self, mpc: MPC, horizon: int) -> None:
        self.mpc, self.horizon = mpc, horizon

    def each(self, value: Any, axes: int, steps: int) -> Any:
        """Return an array that has so many axes at one step as one for each of some steps."""
        xp = module_of(value)
        value = xp.asarray(value)
        return value if value.ndim > axes else xp.broadcast_to(value, (steps, *value.shape))

    def longer(self, value: Any, axes: int, filler: Any) -> Any:
        """Return data of N steps with the filler at each step that is added."""
        found = self.each(value, axes, self.mpc.horizon)
        added = self.horizon - self.mpc.horizon
        more = module_of(filler).broadcast_to(filler, (added, *found.shape[1:]))
        return module_of(found, more).concatenate([found, more.astype(found.dtype)])

    def padded(self) -> MPC:
        """Return the problem of the longer horizon."""
        mpc, system = self.mpc, self.mpc.system
        n, m = system.n, system.m
        changes: dict[str, Any] = {
            "A": self.longer(system.A, 2, np.eye(n)),
            "B": self.longer(system.B, 2, 0.0),
            "c": None if system.c is None else self.longer(system.c, 1, 0.0),
        }
        held = mpc.control_horizon
        if isinstance(held, tuple):
            held = (*held[:-1], held[-1] + self.horizon - mpc.horizon)
        changes = {
            "system": replace(system, **changes),
            "horizon": self.horizon,
            "Q": self.longer(mpc.Q, 2, 0.0),
            "R": self.longer(mpc.R, 2, self.effort() if held is None else 0.0),
            "control_horizon": held,
            "prestabilise": self.gain(),
        }
        for name, axes, filler in (("input_rate_weight", 2, 0.0), ("stage_weights", 0, 1.0)):
            value = getattr(mpc, name)
            changes[name] = None if value is None else self.longer(value, axes, filler)
        every = self.stages(mpc.state_stages)
        changes["states"] = self.spread(mpc.states, mpc.state_stages, every)
        if mpc.constrained_stages is not None:
            changes["constrained_stages"] = every
        steps, longer = tuple(range(mpc.horizon)), tuple(range(self.horizon))
        changes["inputs"] = self.spread(mpc.inputs, steps, longer)
        limit = mpc.input_rate_limit
        if isinstance(limit, Box):
            changes["input_rate_limit"] = self.spread(limit, steps, longer)
        elif limit is not None:
            limit = module_of(limit).broadcast_to(limit, (m,)) if dimensions(limit) == 0 else limit
            changes["input_rate_limit"] = self.longer(limit, 1, np.inf)
        changes["outputs"] = tuple(
            self.rows(rows, output_stages(mpc, rows))
            for rows in as_tuple("outputs", mpc.outputs, Outputs)
        )
        changes["soft"] = tuple(
            self.rows(rows, soft_stages(mpc, rows)) for rows in as_tuple("soft", mpc.soft, Soft)
        )
        return replace(mpc, **changes)

    def effort(self) -> Any:
        """Return R of the steps that are added, of the size of the others."""
        R = self.each(self.mpc.R, 2, 1)
        xp = module_of(R)
        size = xp.mean(xp.trace(R, axis1=1, axis2=2)) / R.shape[-1]
        return xp.where(size > 0, size, 1.0) * np.eye(R.shape[-1])

    def gain(self) -> Any:
        """Return the prestabilising gain of each step, zero where it is added."""
        mpc = self.mpc
        if mpc.control_horizon is not None or not (
            concrete(mpc.system.A, mpc.system.B) or not isinstance(mpc.prestabilise, Switch | None)
        ):
            return mpc.prestabilise
        return self.longer(prestabilising_gain(mpc), 2, 0.0)

    def stages(self, stages: Sequence[int]) -> tuple[int, ...]:
        """Return all stages at which rows may hold, from the first on: to the last step, or to the
        end where they hold at the end."""
        end = self.horizon + (self.mpc.horizon in stages)
        return tuple(range(0 if self.mpc.constrain_initial else 1, end))

    def rows(self, rows: Any, stages: tuple[int, ...]) -> Any:
        """Return rows that hold at these stages, free at all others."""
        every = tuple(range(self.horizon + (self.mpc.horizon in stages)))
        return replace(self.spread(rows, stages, every), stages=every)

    def spread(self, part: Any, stages: Sequence[int], every: Sequence[int]) -> Any:
        """Return a set, or rows, of these stages at all others too, without limits there; what
        held at the end does so at the new one."""
        if part is None:
            return None
        ends = {"lower": -np.inf, "upper": np.inf, "h": np.inf}
        end = {self.mpc.horizon: self.horizon}
        place = {end.get(k, k): j for j, k in enumerate(stages)}
        at = np.array([place.get(k, len(stages)) for k in every], int)
        changes: dict[str, Any] = {}
        for name in {*differing(part), *(k for k in ends if getattr(part, k, None) is not None)}:
            value = self.each(getattr(part, name), AXES[name], len(stages))
            free = np.full((1, *value.shape[1:]), ends.get(name, 0.0), value.dtype)
            changes[name] = module_of(value).concatenate([value, free])[at]
        return replace(part, **changes)
