"""Searches without gradients, for comparison: random, CMA-ES, Bayesian optimisation.

Each is a generator of settings θ (P, k), P ≤ `candidates`, that is sent their losses (P,).
"""

import importlib.util
import time
from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import Any

import numpy as np

Searcher = Generator[np.ndarray, np.ndarray, None]


@dataclass(frozen=True)
class Space:
    """start (k,): where to begin. width: how far each number may move, up or down. sigma: of the
    first steps. candidates: settings judged at once."""

    start: np.ndarray
    width: float
    sigma: float
    candidates: int
    seed: int


def random_search(space: Space) -> Searcher:
    """The start, then a normal distribution about it."""
    rng = np.random.default_rng(space.seed)
    moves = np.zeros((space.candidates, len(space.start)))
    while True:
        yield space.start + np.clip(moves, -space.width, space.width)
        moves = space.sigma * rng.normal(size=moves.shape)


def cma_es(space: Space) -> Searcher:
    """CMA-ES with its default population (at least `candidates`); once it has converged, again
    with twice as many."""
    import cma

    size = max(space.candidates, 4 + int(3 * np.log(len(space.start))))
    while True:
        ends = [list(space.start - space.width), list(space.start + space.width)]
        options = {"bounds": ends, "popsize": size, "seed": space.seed + size, "verbose": -9}
        strategy = cma.CMAEvolutionStrategy(space.start, space.sigma, options)
        while not strategy.stop():
            asked, found = np.array(strategy.ask()), []
            for i in range(0, size, space.candidates):
                found.extend((yield asked[i : i + space.candidates]))
            strategy.tell(asked, found)
        size *= 2


def bayes(space: Space) -> Searcher:
    """Bayesian optimisation, the start first: Gaussian processes, or TPE without torch."""
    import optuna

    optuna.logging.set_verbosity(optuna.logging.ERROR)
    if gaussian():
        sampler: Any = optuna.samplers.GPSampler(seed=space.seed)
    else:
        sampler = optuna.samplers.TPESampler(seed=space.seed, multivariate=True, constant_liar=True)
    study = optuna.create_study(sampler=sampler)
    study.enqueue_trial({f"{i}": float(v) for i, v in enumerate(space.start)})
    while True:
        trials = [study.ask() for _ in range(space.candidates)]
        number = lambda trial, i, v: trial.suggest_float(f"{i}", v - space.width, v + space.width)
        losses = yield np.array(
            [[number(t, i, float(v)) for i, v in enumerate(space.start)] for t in trials]
        )
        for trial, value in zip(trials, losses, strict=True):
            study.tell(trial, float(value))


def gaussian() -> bool:
    """Whether optuna's Gaussian processes can run."""
    return importlib.util.find_spec("torch") is not None


SEARCHERS = {"random": random_search, "cma": cma_es, "bayes": bayes}


def search(searcher: Searcher, oracle: Callable, seconds: float) -> list[tuple]:
    """(seconds, evaluations, least loss so far, its θ) after each call of the oracle."""
    begun, least, best, count = time.perf_counter(), np.inf, np.zeros(0), 0
    trace: list[tuple] = []
    asked = next(searcher)
    while True:
        losses = oracle(asked)
        count += len(asked)
        if losses.min() < least:
            least, best = float(losses.min()), asked[int(np.argmin(losses))]
        trace.append((time.perf_counter() - begun, count, least, best))
        if trace[-1][0] >= seconds:
            return trace
        asked = searcher.send(losses)


def within(trace: list[tuple], seconds: float) -> tuple:
    """The last entry of a trace that was there by then (the first, if none was)."""
    return next((row for row in reversed(trace) if row[0] <= seconds), trace[0])
