"""Iterations and penalties with which fixed ADMM steps solve most plans of closed loops.

One penalty for each kind of row (inputs, states, outputs, ...): they are moved one after the other
by factors of two and of its root, as long as more plans are solved along closed loops from random
states; all values of a penalty are tried in one batch. The number of steps is doubled until that
suffices.
"""

import warnings
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxmpc.arrays import Reals, host_array
from jaxmpc.checks import number, require_kind, require_untraced, whole
from jaxmpc.export.c_files import GIVE_PROBLEM
from jaxmpc.export.c_solver import (
    LOOPS,
    check_fixed_steps,
    require_box,
    solved_by_code,
    starting_states,
)
from jaxmpc.mpc.controller import Controller
from jaxmpc.mpc.plan import References, constant_references
from jaxmpc.mpc.policy_rows import PolicyCondensed
from jaxmpc.mpc.problem import MPC
from jaxmpc.qp.admm import ADMM
from jaxmpc.recursion.time_budget import Budget

# Factors by which a penalty is moved at once, and how often each is.
FACTORS = 2.0 ** np.array([0.0, -2, -1, -0.5, 0.5, 1, 2])
ROUNDS = 4
# Steps to begin with, and at most.
FIRST_STEPS, MOST_STEPS = 60, 1920
# Over-relaxation of plans under affine policies and tubes, which begin cold: with 1.9 two thirds of
# the first hundred steps go to what each of them turns around.
ALPHA_OF_POLICIES = 1.6


def choose_steps(
    mpc: MPC,
    lower: Reals,
    upper: Reals,
    *,
    iterations: int | None = None,
    share: float = 0.99,
    plans: int = 1000,
    tolerance: float = 1e-6,
    seed: int = 1,
    progress: bool = False,
    reference: Reals | None = None,
    input_reference: Reals | None = None,
) -> ADMM:
    """Return the solver for `export_c` whose fixed steps solve most plans of closed loops.

    lower, upper: corners (n,) of the box of initial states. iterations: the number of steps, where
    that is given; None: the least of 60, 120, 240, ... that will do, 1,920 at most, with a
    UserWarning where these do not. Under affine
    policies and tubes, whose QPs take long to try, all penalties are moved at once, one time.
    share: of the plans that have a solution, which should be solved. plans: of the closed loops
    that are looked at. tolerance: as in `export_c`. seed: of the initial states; those by which
    `check_fixed_steps` then measures the result are others. progress: print each number of
    iterations that is tried on stderr, with the share that it solves. Each is another program,
    which compiles for half a minute on two cores. reference (n,), input_reference (m,): state and
    input that the loops track, such as those of `equilibrium`; None: zero.

    The penalties are local optima of a coarse search: `tune_solver` finds better ones. Raises
    ValueError as `check_fixed_steps` does.
    """
    require_kind("mpc", mpc, MPC, cure=GIVE_PROBLEM)
    require_untraced("mpc", mpc)
    number("share", share, 0.0, "Give a fraction from 0 to 1")
    require_box(mpc, lower, upper)
    whole("plans", plans, 1)
    if iterations is not None:
        whole("iterations", iterations, 1)
    with jax.enable_x64(True):
        precise = Controller(mpc, ADMM())
        corners = host_array("lower", lower), host_array("upper", upper)
        target = constant_references(mpc, reference, input_reference)
        starts = starting_states(precise, *corners, seed, target)
        layout = precise.condensed.layout
        kinds = np.repeat(np.arange(len(layout)), [len(ks) * size for _, ks, size in layout])
        rho, alpha = np.asarray(precise.factor.rho)[0], ADMM().alpha
        if isinstance(precise.condensed, PolicyCondensed):
            kinds, alpha = np.zeros(len(rho), int), ALPHA_OF_POLICIES
        steps = FIRST_STEPS if iterations is None else iterations
        say = Budget.of(np.inf, progress).say
        while True:
            say(f"{steps:,} iterations")
            make = lambda rho, steps=steps: Controller(
                mpc, ADMM(steps, rho, alpha, newton_steps=0, eps=tolerance)
            )
            rho, reached = _improved(make, starts, target, -(-plans // LOOPS), rho, kinds)
            solver = ADMM(steps, rho, alpha, newton_steps=0)
            say(f"{steps:,} iterations solve {reached:.1%} of the plans, if all have a solution")
            if iterations is not None or reached >= share:
                return solver
            # Not every plan need have a solution: then precise plans say how many have.
            found = check_fixed_steps(mpc, solver, lower, upper, plans, tolerance, seed, **target)
            say(f"and {found.reached:,} of the {found.solvable:,} that have a solution")
            if found.reached >= share * found.solvable:
                return solver
            if steps >= MOST_STEPS:
                text = f"{steps:,} iterations solve {found.reached:,} of {found.solvable:,} plans"
                cure = "Give more iterations=, accept less (share=), or see tune_solver"
                warnings.warn(f"choose_steps: {text}, not {share:.0%}. {cure}", stacklevel=2)
                return solver
            steps *= 2


def _improved(
    make: Callable[[Any], Controller],
    starts: Any,
    target: References,
    length: int,
    rho: np.ndarray,
    kinds: np.ndarray,
) -> tuple[np.ndarray, float]:
    """Return better penalties (rows,) than rho, and the share of plans that they solve.

    make: penalties to controller. length: of the closed loops from `starts` to the target. kinds:
    of the rows.
    """

    @jax.jit
    @jax.vmap
    def solved(controller: Controller) -> Any:
        system = controller.mpc.system

        def step(state: Any, _: Any) -> Any:
            x, before = state
            control = controller(x, before, **target)
            solved = solved_by_code(controller, control.plan, controller.solver.eps)
            return (system.step(x, control.u), control), solved

        loop = lambda x: jax.lax.scan(step, (x, controller.start(x)), length=length)[1]
        return jnp.mean(jax.vmap(loop)(jnp.asarray(starts)).astype(float))

    share = 0.0
    for _ in range(ROUNDS if kinds.max(initial=0) else 1):
        before = rho
        for kind in range(kinds.max(initial=-1) + 1):
            tried = np.where(kinds == kind, FACTORS[:, None], 1.0) * rho
            made = [make(jnp.asarray(each)) for each in tried]
            shares = np.asarray(solved(jax.tree.map(lambda *parts: jnp.stack(parts), *made)))
            rho, share = tried[int(np.argmax(shares))], float(shares.max())
        if np.array_equal(rho, before) or share == 1:
            break
    return rho, share
