"""Are all plans solved at default settings, and how fast, beside the solvers of the field?

    python experiments/plans.py                                   # 10,000 states of each family
    python experiments/plans.py --rivals --families joint quadrotor  # beside other solvers

Families: `mpc_families.py`. All solvers get the same feasible states and the same condensed QP, in
float64. Residuals (primal, dual, gap; absolute, infinity norm) are computed here from each (z, y);
"solved" counts those within 1e-6; "false" counts plans whose status says SOLVED and that are not,
or says anything but SOLVED and ITERATION_LIMIT, for all states are feasible. The solvers take
turns, best of `rounds`; loops over C solvers run over `loop` of the states. Times are wall time a
state, without compilation and set-up; on shared machines read their ratios.
"""

from dataclasses import dataclass, replace
from importlib.util import find_spec

import jax
import numpy as np
import tyro
from benchmark import clocked, condensed, residuals
from mpc_families import FAMILIES, family
from mpc_solvers import Call, daqp_loop, moreau_batch, osqp_loop, piqp_loop

import jaxmpc as jm
from jaxmpc.mpc.condense import Condensed
from jaxmpc.mpc.plan import flat_multipliers


@dataclass(frozen=True)
class Settings:
    """states: of each family. rivals: beside other solvers. loop: states that C solvers run over.
    rounds: each solver runs so often, the best time counts."""

    families: tuple[str, ...] = FAMILIES
    states: int = 10_000
    seed: int = 0
    rivals: bool = False
    loop: int = 300
    rounds: int = 3


def pair_of(c: Condensed, plan: jm.Plan) -> tuple[np.ndarray, np.ndarray]:
    """z and y of plans."""
    with jax.enable_x64(True):
        z = jax.vmap(c.variables)(plan.states, plan.inputs)
        y = jax.vmap(lambda m: flat_multipliers(c.layout, m))(plan.multipliers)
    return np.asarray(z), np.asarray(y)


def rows_that_move(c: Condensed) -> Condensed:
    """Without the rows that no input moves: limits of the given state, which some solvers
    refuse."""
    moved = np.linalg.norm(c.C, axis=1) > 1e-12
    names = ("C", "D", "d", "lower", "upper")
    return replace(c, **{name: getattr(c, name)[moved] for name in names})


def measure(name: str, s: Settings) -> None:
    """Print the lines of one family."""
    mpc, x = family(name, s.states, s.seed)
    c, call = condensed(mpc), lambda: jm.solve_many(mpc, x)
    call()
    seconds, plan = min((clocked(call) for _ in range(s.rounds)), key=lambda found: found[0])
    worst = residuals(c, x, *pair_of(c, plan))
    said = plan.status == jm.Status.SOLVED
    other = ~said & (plan.status != jm.Status.ITERATION_LIMIT)
    print(
        f"{name:13} {c.P.shape[0]:4} variables {len(c.lower):4} rows  jaxmpc "
        f"{seconds / len(x) * 1e6:8.1f} µs  solved {np.mean(worst <= 1e-6):8.3%}  "
        f"false {np.sum(said & (worst > 1e-6)) + np.sum(other)}",
        flush=True,
    )
    if not s.rivals:
        return
    c = rows_that_move(c)
    shift = x @ c.D.T + c.d
    q, l, u = x @ c.F.T + c.f, c.lower - shift, c.upper - shift
    few = slice(s.loop)
    rivals: dict[str, tuple[Call, np.ndarray]] = {}
    for rival, make in (("daqp", daqp_loop), ("piqp", piqp_loop), ("osqp", osqp_loop)):
        if find_spec(rival):
            rivals[rival] = make(c, q[few], l[few], u[few]), x[few]
    if find_spec("moreau"):
        rivals["moreau"] = moreau_batch(c, q, l, u), x
    times: dict[str, list[float]] = {"jaxmpc": []}
    solved: dict[str, float] = {}
    for _ in range(s.rounds):
        times["jaxmpc"].append(clocked(call)[0] / len(x) * 1e6)
        for rival, (run, states) in rivals.items():
            spent, (z, y, _) = clocked(run)
            times.setdefault(rival, []).append(spent / len(states) * 1e6)
            solved[rival] = np.mean(residuals(c, states, z, y) <= 1e-6)
    least = {rival: min(spent) for rival, spent in times.items()}
    for rival in rivals:
        ratio = least[rival] / least["jaxmpc"]
        print(f"{'':15}{rival:8}{least[rival]:9.1f} µs  solved {solved[rival]:8.3%}  "
              f"{ratio:6.2f} times jaxmpc's {least['jaxmpc']:.1f} µs", flush=True)  # fmt: skip


def main(s: Settings) -> None:
    """Print all families."""
    for name in s.families:
        measure(name, s)


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
