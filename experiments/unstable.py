"""How many plans of unstable systems are solved, condensed and stage by stage, and how far apart.

    python experiments/unstable.py

Random systems whose states grow by a factor at each step in open loop, in coordinates that may
nearly coincide; soft limits of states, hard ones of inputs. Within the latter nothing keeps some of
these systems near the origin: their states grow over the horizon, and their plans are not solved.
"solved" are those of `jm.solve` and `solve_stagewise`, "cost" is the greatest relative difference
of the two.
"""

from dataclasses import dataclass, replace

import jax
import numpy as np
import tyro

import jaxmpc as jm
from jaxmpc.mpc import solve_stagewise


@dataclass(frozen=True)
class Settings:
    """systems: of each factor of growth. states, inputs, horizon: of each system."""

    systems: int = 200
    states: int = 4
    inputs: int = 2
    horizon: int = 30
    growth: tuple[float, ...] = (1.0, 1.3, 1.6, 2.0, 2.5)
    seed: int = 0


def matrices(s: Settings, growth: float, rng: np.random.Generator) -> tuple:
    """Return A and B of all systems: one eigenvalue is `growth`, one at most as large, and others
    are 1 at most."""
    T = rng.normal(size=(s.systems, s.states, s.states))
    values = rng.uniform(-1, 1, (s.systems, s.states))
    values[:, 0], values[:, 1] = growth, growth * values[:, 1]
    A = T @ (values[:, :, None] * np.linalg.inv(T))
    return A, rng.normal(size=(s.systems, s.states, s.inputs))


def main(s: Settings) -> None:
    """Print the table."""
    rng, n, m = np.random.default_rng(s.seed), s.states, s.inputs
    system = jm.LinearSystem(np.eye(n), np.ones((n, m)))
    states, inputs = (jm.Box(np.full(k, -size), np.full(k, size)) for k, size in ((n, 5), (m, 1)))
    limits = {"states": states, "inputs": inputs, "constrain_initial": False}
    # What is not known within `jax.vmap` is asked for: a gain for `solve`.
    shared = jm.MPC(system, np.eye(n), np.eye(m), s.horizon, **limits, prestabilise=True)
    shared = jm.soften(shared, 10.0)

    def solved_by(solve):
        one = lambda A, B, x: solve(replace(shared, system=jm.LinearSystem(A, B)), x)
        return jax.jit(jax.vmap(one))

    solvers = [solved_by(solve) for solve in (jm.solve, solve_stagewise)]
    print(f"{'growth':>6} {'over N':>8} {'condensed':>9} {'stage-wise':>10} {'cost':>8}")
    for growth in s.growth:
        A, B = matrices(s, growth, rng)
        x = rng.normal(size=(s.systems, n))
        condensed, stagewise = (solve(A, B, x) for solve in solvers)
        solved = [np.asarray(plan.status) == jm.Status.SOLVED for plan in (condensed, stagewise)]
        apart = np.abs(stagewise.cost / condensed.cost - 1)[solved[0] & solved[1]]
        counts = f"{solved[0].sum():>9} {solved[1].sum():>10}"
        print(f"{growth:>6} {growth**s.horizon:>8.0e} {counts} {apart.max(initial=0):>8.0e}")


if __name__ == "__main__":
    with jax.enable_x64(True):
        main(tyro.cli(Settings))
