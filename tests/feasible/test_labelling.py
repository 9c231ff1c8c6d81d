"""Labels made by an executor are those made without one, whatever becomes of its workers."""

import multiprocessing
import os
import pickle
import signal
import warnings
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool

import numpy as np
import problems
import pytest

import jaxmpc as jm
from jaxmpc.feasible import pipeline
from jaxmpc.feasible.map import label_chunks
from jaxmpc.feasible.pipeline import PROOFS, Scope, label_parts
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.sets.convex_sets import Ellipsoid

POINTS = jm.grid([-1.2, -1.2], [1.2, 1.2], (20, 20))


def same(found, expected):
    np.testing.assert_array_equal(found.label, expected.label)
    np.testing.assert_array_equal(found.status, expected.status)
    for name in PROOFS:
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


@pytest.fixture(scope="module")
def expected():
    fmap = jm.map_feasible_set(problems.lecture(), POINTS, chunk=64)
    assert fmap.counts()["feasible"] and fmap.counts()["infeasible"]
    return fmap.labels


class Inline:
    """An executor that works when asked for a result, from pickled arguments, last one first.

    fails: how many of the first results fail as if a worker had died.
    """

    def __init__(self, fails=0):
        self.fails, self.open, self.most, self.submitted = fails, 0, 0, 0

    def submit(self, function, *arguments):
        call = pickle.dumps((function, arguments))
        self.open, self.submitted = self.open + 1, self.submitted + 1
        self.most = max(self.most, self.open)
        outer = self

        class Later:
            def result(self):
                outer.open -= 1
                if outer.fails:
                    outer.fails -= 1
                    raise BrokenProcessPool("a worker died")
                function, arguments = pickle.loads(call)
                return pickle.loads(pickle.dumps(function(*arguments)))

        return Later()


@pytest.mark.parametrize("threads", [1, 3])
def test_threads(expected, threads):
    with ThreadPoolExecutor(threads) as pool:
        same(
            jm.map_feasible_set(problems.lecture(), POINTS, chunk=64, executor=pool).labels,
            expected,
        )


def test_what_is_sent_is_enough_and_few_are_in_flight(expected, monkeypatch):
    monkeypatch.setattr(pipeline, "IN_FLIGHT", 3)
    executor = Inline()
    same(
        jm.map_feasible_set(problems.lecture(), POINTS, chunk=64, executor=executor).labels,
        expected,
    )
    assert executor.most == 3 and executor.submitted == 7


def test_a_part_whose_worker_died_is_submitted_again(expected):
    executor = Inline(fails=3)
    with pytest.warns(UserWarning, match=r"64 points came back \(BrokenProcessPool\)") as warned:
        found = jm.map_feasible_set(problems.lecture(), POINTS, chunk=64, executor=executor)
    same(found.labels, expected)
    assert len(warned) == 3 and executor.submitted == 10
    with pytest.warns(UserWarning), pytest.raises(BrokenProcessPool):
        jm.map_feasible_set(problems.lecture(), POINTS, chunk=64, executor=Inline(fails=4))


def test_errors_of_the_labels_are_raised_at_once():
    executor = Inline()
    one_part = {"chunk": len(POINTS), "executor": executor}
    with pytest.raises(ValueError, match="^devices: 999 where this process has"):
        jm.map_feasible_set(problems.lecture(), POINTS, devices=999, **one_part)
    assert executor.submitted == 1
    with pytest.raises(ValueError, match="executor: is an int without submit"):
        jm.map_feasible_set(problems.lecture(), POINTS, executor=3)


def test_what_is_left_is_cancelled():
    made = []

    class Never:
        def submit(self, function, *arguments):
            made.append(Future())
            if len(made) == 1:
                made[0].set_result(ValueError("first"))
            return made[-1]

    with pytest.raises(ValueError, match="first"):
        jm.map_feasible_set(problems.lecture(), POINTS, chunk=64, executor=Never())
    assert len(made) == 7 and all(future.cancelled() for future in made[1:])


CASES = {
    "joint": (lambda: problems.joint(horizon=5), (1.7, 2.2), {}),
    "terminal ellipsoid": (
        lambda: problems.joint(5, Ellipsoid(np.array(problems.P_JOINT), 300.0)), (1.7, 2.2), {},
    ),
    "short of steps": (lambda: problems.lecture(), (1.2, 1.2), {"iterations": 1}),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
@pytest.mark.slow
def test_labels_of_a_part_do_not_depend_on_the_others(case, monkeypatch):
    """Linear programs, whose tangents to a ball are kept, and whose number is bounded, included:
    no stage before them decides a point here."""
    from jaxmpc.feasible import pipeline
    from jaxmpc.feasible.candidate_search import compiled_check

    make, ends, settings = CASES[case]
    run = pipeline._run

    def undecided(program, *arguments):
        found = run(program, *arguments)
        if program is compiled_check(None) or case == "joint":
            return found
        verdict, *w = found if isinstance(found, tuple) else (found,)
        verdict = pipeline.replace(verdict, label=0 * verdict.label)
        return (verdict, *w) if w else verdict

    monkeypatch.setattr(pipeline, "_run", undecided)
    monkeypatch.setattr(pipeline, "MOST_PROGRAMS", 8)
    problem = FeasibilityProblem.of(make())
    lines = [np.linspace(-end, end, 10) for end in ends]
    points = pipeline.np.stack(np.meshgrid(*lines, indexing="ij"), -1).reshape(-1, 2)
    scope = Scope.of_grid(lines, 4)
    whole = dict(label_chunks_of(problem, points, scope, settings))
    assert len(whole) == 4
    for k in (2, 0, 3, 1):
        alone = FeasibilityProblem.of(make())
        alone.programs.center()  # an earlier question
        (found,) = label_parts(alone, [points[25 * k : 25 * k + 25]], scope, 25, **settings)
        same(found, whole[k])
    if case != "joint":
        counts = [np.count_nonzero(whole[k].label) for k in range(4)]
        assert max(counts) == 2  # an equal share of the programs


def label_chunks_of(problem, points, scope, settings):
    for part in label_chunks(problem, points, chunk=25, scope=scope, **settings):
        yield part.place.start // 25, part.result


@pytest.mark.slow
def test_processes_and_one_that_is_killed(expected):
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(2, mp_context=spawn) as pool:
        found = jm.map_feasible_set(problems.lecture(), POINTS, chunk=64, executor=pool)
        same(found.labels, expected)
        pool.submit(os.kill, next(iter(pool._processes)), signal.SIGKILL)
        # With a warning where a part was under way, at once where the pool broke before.
        with warnings.catch_warnings(), pytest.raises(BrokenProcessPool):
            warnings.filterwarnings("ignore", "executor: no labels")
            for _ in range(20):
                jm.map_feasible_set(problems.lecture(), POINTS, chunk=64, executor=pool)
