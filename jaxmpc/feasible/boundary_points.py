"""Boundary points and facets of the feasible set of a problem, along rays that the user gives."""

import numpy as np

from jaxmpc.arrays import host_array
from jaxmpc.checks import fail
from jaxmpc.feasible.policy_hull import PolicyRays
from jaxmpc.feasible.policy_problem import PolicyProblem, problem_of
from jaxmpc.feasible.rays import Boundary, Rays, ray_directions
from jaxmpc.mpc.problem import MPC
from jaxmpc.qp.jax_transformations import on_host


@on_host
def boundary(
    mpc: MPC,
    directions: int | np.ndarray,
    *,
    center: np.ndarray | None = None,
    axes: tuple[int, ...] | None = None,
    fixed: np.ndarray | None = None,
) -> Boundary:
    """Compute exact boundary points and facets of the feasible set of `mpc` along rays.

    directions: a number of rays (equally spaced in 2-D, random in more dimensions) or an array
    (K, d). center: a feasible point (d,); None: the point with the largest margin. axes, fixed: a
    slice or projection as in `map_feasible_set`, whose feasible set this is. Raises ValueError
    where it is empty or flat, or the centre is not inside it.
    """
    problem = problem_of(mpc, axes, fixed)
    d = problem.dimension
    if isinstance(directions, int | np.integer):
        directions = ray_directions(max(int(directions), 0), d)
    directions = host_array("directions", directions)
    if directions.ndim != 2 or directions.shape[1] != d or not np.all(np.isfinite(directions)):
        fail("directions", f"shape {directions.shape}", f"Give finite rays (K, {d}) or a number")
    if not len(directions) or not np.all(np.any(directions != 0, axis=1)):
        fail("directions", "holds no ray, or a zero row", "Give at least one direction")
    if center is not None and (np.shape(center) != (d,) or not np.all(np.isfinite(center))):
        fail("center", f"{center}", f"Give one finite point ({d},)")
    if isinstance(problem, PolicyProblem):
        return PolicyRays.of(problem, center).cast(directions)
    return Rays.of(problem, center).cast(directions)
