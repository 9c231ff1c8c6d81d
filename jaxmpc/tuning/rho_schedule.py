"""Penalties of ADMM by row and stage, as functions of few parameters: W of log rho = θ W'."""

from dataclasses import replace

import numpy as np

from jaxmpc.checks import fail
from jaxmpc.mpc.condense import condensed_in_float64
from jaxmpc.mpc.problem import MPC
from jaxmpc.qp.admm import ADMM
from jaxmpc.tuning.result import TuningRun

# Values of a group along the horizon, between which log rho is interpolated.
KNOTS = 5

# (kind, steps, rows a step) of each block of rows.
Blocks = tuple[tuple[str, tuple[int, ...], int], ...]


def interpolation(
    groups: str, blocks: Blocks, horizon: int, balls: tuple[int, ...] = (), knots: int = KNOTS
) -> np.ndarray:
    """Return W (rows, parameters): log rho = W θ.

    groups "row": one parameter a row. "step": for each row of a block `knots` values at k/N in
    [0, 1], linear between them; one value where a block has one step. The rows of a ball have the
    same values, so that it stays a ball; the last len(balls) blocks are balls.
    """
    columns: list[np.ndarray] = []
    for i, (_, steps, size) in enumerate(blocks):
        ball = i >= len(blocks) - len(balls)
        if groups == "row":
            along = np.eye(len(steps))
        elif len(steps) == 1:
            along = np.ones((1, 1))
        else:
            ends, at = np.linspace(0, 1, knots), np.array(steps) / horizon
            along = np.stack([np.interp(at, ends, hat) for hat in np.eye(knots)], axis=1)
        columns.append(np.kron(along, np.ones((size, 1)) if ball else np.eye(size)))
    rows, parameters = (sum(part.shape[k] for part in columns) for k in (0, 1))
    W, row, column = np.zeros((rows, parameters)), 0, 0
    for part in columns:
        W[row : row + part.shape[0], column : column + part.shape[1]] = part
        row, column = row + part.shape[0], column + part.shape[1]
    return W


def transfer_penalties(run: TuningRun, mpc: MPC, iterations: int | None = None) -> ADMM:
    """Return the solver that `tune_solver` found, for a problem with another horizon.

    run: of groups="step", unless mpc has the very rows of the problem tuned. Its penalties are
    interpolated at k/N. mpc: a problem with the same blocks of rows. iterations: None for those
    tuned with, divided evenly among the stages. How many states of the other problem it solves is
    not guaranteed; its status tells. Where nothing better was found the given solver is returned.
    Raises ValueError for a problem with other blocks.
    """
    mpc.validate()
    solver, settings = run.solver, run.settings
    rho = np.asarray(solver.rho)
    if run.improved:
        c = condensed_in_float64(mpc)
        blocks = tuple((kind, tuple(steps), size) for kind, steps, size in settings["blocks"])
        if settings["groups"] == "row" and c.layout != blocks:
            fail("mpc", "has other rows than the problem tuned", 'Use groups="step"')
        kinds = lambda blocks: [(kind, size) for kind, _, size in blocks]
        if kinds(c.layout) != kinds(blocks) or len(c.balls) != len(settings["balls"]):
            fail("mpc", f"blocks {kinds(c.layout)}", f"Needed: {kinds(blocks)}")
        if c.layout != blocks:
            shape = lambda blocks, N: interpolation("step", blocks, N, c.balls, settings["knots"])
            old, new = shape(blocks, settings["horizon"]), shape(c.layout, mpc.horizon)
            if old.shape[1] != new.shape[1]:
                fail("mpc", "has blocks of one step, or more where one was", "Tune it anew")
            # A parameter that no row depends on takes the mean of the others.
            mean = np.mean(np.log(rho), axis=1, keepdims=True)
            theta = np.linalg.lstsq(old, (np.log(rho) - mean).T, rcond=None)[0]
            rho = np.exp(mean + theta.T @ new.T)
    count = solver.admm_steps() if iterations is None else iterations
    solver = replace(solver, iterations=count, rho=rho)
    solver.validate(rho.shape[-1] if rho.ndim else 1)
    return solver
