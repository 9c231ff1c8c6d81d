"""The pipeline: every point once and in order, the last programs, its limits and its errors.

The problem is x⁺ = x + u with |x| ≤ 1 from k = 1 on and |u| ≤ 0.3: feasible for |x_0| ≤ 1.3.
"""

import functools
import itertools
import time
from dataclasses import replace

import numpy as np
import problems
import pytest

from jaxmpc.feasible import pipeline
from jaxmpc.feasible.candidate_search import compiled_check
from jaxmpc.feasible.map import label_chunks
from jaxmpc.feasible.pipeline import last_programs
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.qp.status import Status

LIMIT = 1.3
GAIN = np.array([[-0.4, -0.1], [0.1, -0.5]])


@functools.cache
def scalar():
    mpc = problems.scalar(horizon=4, terminal=1.0, constrain_initial=False)
    return FeasibilityProblem.of(mpc)


def labelled(points, **settings):
    """The slices and labels of all chunks, labels and status in one array each."""
    problem = scalar()
    problem.memory.pop("pipeline", None)  # one of a test that had other constants
    found = list(label_chunks(problem, np.reshape(points, (-1, 1)), **settings))
    slices, parts = [part.place for part in found], [part.result for part in found]
    return slices, parts, *(np.concatenate([getattr(p, k) for p in parts])
                            for k in ("label", "status"))  # fmt: skip


def expected(points):
    return np.where(np.abs(points) <= LIMIT, 1, -1)


def require_proofs(points, parts):
    """Plans rolled out keep all limits; half-spaces hold at both ends of the set."""
    i = 0
    for part in parts:
        for j, label in enumerate(part.label):
            x = points[i + j]
            if label == 1:
                assert part.start[j] == x
                u = part.plan[j, :, 0]
                assert np.abs(u).max() <= 0.3 and np.abs(x + np.cumsum(u)).max() <= 1
            elif label == -1:
                normal, offset = part.cut_normal[j, 0], part.cut_offset[j]
                assert abs(normal) * LIMIT * (1 - 1e-15) <= offset < normal * x
            else:
                assert np.isnan(part.plan[j]).all() and np.isnan(part.cut_offset[j])
        i += len(part.label)
    assert i == len(points)


class TestChunks:
    POINTS = np.random.default_rng(0).uniform(-2, 2, 60)

    @pytest.mark.parametrize(("chunk", "ends"), [(25, [25, 50, 60]), (60, [60]),
                                                 (9999, [60]), (None, [60])])  # fmt: skip
    def test_all_points_in_order(self, chunk, ends):
        slices, parts, label, status = labelled(self.POINTS, chunk=chunk)
        assert [(s.start, s.stop) for s in slices] == list(zip([0, *ends], ends, strict=False))
        assert [len(p.label) for p in parts] == [s.stop - s.start for s in slices]
        np.testing.assert_array_equal(label, expected(self.POINTS))
        np.testing.assert_array_equal(
            status, np.where(label == 1, Status.SOLVED, Status.PRIMAL_INFEASIBLE)
        )
        require_proofs(self.POINTS, parts)

    def test_one_at_a_time(self):
        _, parts, label, _ = labelled(self.POINTS[:4], chunk=1)
        np.testing.assert_array_equal(label, expected(self.POINTS[:4]))
        assert [len(part.label) for part in parts] == [1, 1, 1, 1]

    def test_points_that_are_decided_go_no_further(self, monkeypatch):
        """The first stage runs once a chunk; others only where it leaves points, as
        the slow tests show."""
        run, calls = pipeline._run, []
        monkeypatch.setattr(pipeline, "_run", lambda *args: calls.append(args[0]) or run(*args))
        easy = np.array([0.0, 2.0, -0.1, -3.0])
        label = labelled(np.append(easy, np.nan))[2]
        np.testing.assert_array_equal(label[:4], expected(easy))
        assert len(calls) == 1

    @pytest.mark.slow
    def test_points_that_are_left_go_through_other_stages(self, monkeypatch):
        run, calls = pipeline._run, []
        monkeypatch.setattr(pipeline, "_run", lambda *args: calls.append(args[0]) or run(*args))
        hard = np.array([0.0, 2.0, 1.3 - 1e-9, 1.3 + 1e-9])
        np.testing.assert_array_equal(labelled(hard, iterations=1)[2], expected(hard))
        assert len(set(calls)) >= 2

    def test_points_that_are_not_finite(self):
        points = np.tile(self.POINTS, 2)
        bad = np.isin(np.arange(120), [0, 64, 77, 119])
        points[bad] = [np.nan, np.inf, -np.inf, np.nan]
        _, parts, label, status = labelled(points, chunk=64)
        np.testing.assert_array_equal(label[~bad], expected(points[~bad]))
        assert np.all(label[bad] == 0) and np.all(status[bad] == Status.NON_FINITE)
        require_proofs(points, parts)

    def test_times(self):
        """Compiling and running apart; what the caller does between two chunks is neither."""
        pause, problem = 0.05, FeasibilityProblem.of(problems.scalar(horizon=2))
        for again in (False, True):
            begun, spent, compiled = time.perf_counter(), 0.0, 0.0
            for part in (p.result for p in label_chunks(problem, self.POINTS[:, None], chunk=20)):
                assert part.run_seconds > 0 and part.compile_seconds >= 0
                spent += part.run_seconds + part.compile_seconds
                compiled += part.compile_seconds
                time.sleep(pause)
            assert spent <= time.perf_counter() - begun - 3 * pause
            assert (compiled == 0) == again

    def test_proofs_are_copied_where_they_are_many(self, monkeypatch):
        monkeypatch.setattr(pipeline, "ON_DEVICE", 0)
        _, parts, label, _ = labelled(self.POINTS, chunk=25)
        np.testing.assert_array_equal(label, expected(self.POINTS))
        assert all(proof._fetch is None for part in parts for proof in part.proofs.values())
        require_proofs(self.POINTS, parts)


@pytest.fixture
def hide(monkeypatch):
    """hide(of): only linear programs decide the points x (B, 1) with of(x) (B,)."""
    run = pipeline._run

    def hide(of):
        def without_verdict(program, *args):
            found = run(program, *args)
            if program is compiled_check(None):
                return found
            verdict, *rest = found if isinstance(found, tuple) else (found,)
            label = np.where(of(np.asarray(args[2])), 0, verdict.label).astype(np.int8)
            verdict = replace(verdict, label=label)
            return (verdict, *rest) if rest else verdict

        monkeypatch.setattr(pipeline, "_run", without_verdict)

    return hide


class TestLastPrograms:
    POINTS = np.array([-2.0, -1.31, -1.29, -0.5, 0.0, 0.7, 1.2999, 1.3001, 1.5])

    @pytest.mark.slow
    def test_they_decide_what_is_left(self, hide):
        hide(lambda x: x[:, 0] < 9)
        _, parts, label, _ = labelled(self.POINTS, chunk=4)
        np.testing.assert_array_equal(label, expected(self.POINTS))
        require_proofs(self.POINTS, parts)

    @pytest.mark.parametrize(("chunk", "most", "entries"), [(9, 6, 2), (4, 2, 1)])
    @pytest.mark.slow
    def test_no_more_than_may_run(self, hide, monkeypatch, chunk, most, entries):
        """The first points of each chunk, which have equal shares."""
        hide(lambda x: x[:, 0] < 9)
        monkeypatch.setattr(pipeline, "MOST_PROGRAMS", 6)
        first = lambda count: np.arange(len(self.POINTS)) % chunk < count
        _, _, label, status = labelled(self.POINTS, chunk=chunk)
        np.testing.assert_array_equal(label, np.where(first(most), expected(self.POINTS), 0))
        assert np.all(status[~first(most)] == Status.ITERATION_LIMIT)
        monkeypatch.setattr(pipeline, "MOST_ENTRIES", 3 * scalar().rows.U.size - 1)
        label = labelled(self.POINTS, chunk=chunk)[2]
        np.testing.assert_array_equal(label != 0, first(entries))

    @pytest.mark.slow
    def test_only_what_is_left_counts(self, hide, monkeypatch):
        """Decided points before and after two others are no reason not to run their programs."""
        hide(lambda x: np.isin(x[:, 0], self.POINTS[4:6]))
        monkeypatch.setattr(pipeline, "MOST_PROGRAMS", 2)
        label = labelled(self.POINTS)[2]
        np.testing.assert_array_equal(label, expected(self.POINTS))

    @pytest.mark.slow
    def test_a_longer_run_before(self, hide, monkeypatch):
        """Of what the first two stages leave, in as many batches as it takes, without any
        program."""
        points, calls = np.random.default_rng(6).uniform(-2, 2, 100), itertools.count()
        hide(lambda x: np.full(len(x), next(calls) < 2))
        monkeypatch.setattr(pipeline, "MOST_PROGRAMS", 0)
        _, parts, label, _ = labelled(points, chunk=100)
        np.testing.assert_array_equal(label, expected(points))
        require_proofs(points, parts)
        assert next(calls) >= 4  # both, and the longer run of two batches

    def test_ray_from_the_centre(self):
        """Inside: a plan between those of the centre and of the ray's end, so that it keeps all
        rows; outside and inside: multipliers of the end, which are its half-space."""
        problem = FeasibilityProblem.of(replace(problems.drifting(), prestabilise=GAIN))
        rows, programs = problem.rows, list(last_programs(problem, np.ones(len(problem.rows.U))))
        assert programs[0][0] is rows and programs[-1][0] is rows
        center, w_center = problem.programs.center()
        margin = lambda theta, w: np.minimum(
            rows.upper - rows.U @ w - rows.D @ theta, rows.U @ w + rows.D @ theta - rows.lower
        ).min()
        best = margin(center, w_center)
        assert best > 0
        for direction in np.random.default_rng(1).normal(size=(5, 2)):
            end, w_end, _ = problem.programs.ray(center, direction)
            for t in (0.25, 0.9, 1 - 1e-6):
                theta = center + t * end * direction
                w, y = programs[0][1](theta)
                assert margin(theta, w) >= (1 - t) * best * 0.999 - 1e-12
                np.testing.assert_allclose(w, w_center + t * (w_end - w_center), atol=1e-6)
            for t in (0.5, 1.5):  # y'(Uw + D θ) ≤ y'(D end + …) at the end with equality
                theta = center + t * end * direction
                w, y = programs[0][1](theta)
                reach = np.sum(np.where(y > 0, rows.upper, np.where(y < 0, rows.lower, 0)) * y)
                value = y @ rows.D @ (center + end * direction)
                assert value == pytest.approx(reach, rel=1e-7, abs=1e-9)
                np.testing.assert_allclose(rows.U.T @ y, 0, atol=1e-7 * np.abs(y).max())
            # Outside the plan is that of the end.
            np.testing.assert_allclose(w, w_end, atol=1e-6)

    def test_flat_sets(self):
        """Without a centre the margin alone is left."""
        flat = FeasibilityProblem.of(problems.scalar(horizon=4, x_max=0.0, terminal=0.0))
        assert len(list(last_programs(flat, np.ones(len(flat.rows.U))))) == 1
        (part,) = label_chunks(flat, np.array([[0.0], [0.1]]))
        labels = part.result
        assert labels.label[0] >= 0 and labels.label[1] == -1

    def test_growth(self):
        """Rays once more in the units of an unstable mode, with the same ends."""
        problem = FeasibilityProblem.of(problems.unstable(6))
        programs = list(last_programs(problem, np.ones(len(problem.rows.U))))
        assert [rows is problem.rows for rows, _ in programs] == [True, False, True]
        center, _ = problem.programs.center()
        rows, end = programs[1]
        for direction in np.random.default_rng(2).normal(size=(3, 2)):
            t, w_ray, _ = problem.programs.ray(center, direction)
            theta = center + 2 * t * direction
            w, y = end(theta)
            reach = np.sum(np.where(y > 0, rows.upper, np.where(y < 0, rows.lower, 0)) * y)
            assert y @ rows.D @ (center + t * direction) == pytest.approx(reach, rel=1e-6)
            value = rows.U @ w + rows.D @ (center + t * direction)
            assert np.all(value <= rows.upper + 1e-6 * (1 + np.abs(rows.upper)))


@pytest.mark.parametrize(
    ("points", "settings", "words"),
    [(np.zeros(1), {}, "x0s"), (np.zeros((1, 2)), {}, "x0s"), (np.zeros((1, 1, 1)), {}, "x0s"),
     (np.zeros((1, 1)), dict(iterations=0), "iterations"),
     (np.zeros((1, 1)), dict(chunk=0), "chunk"), (np.zeros((1, 1)), dict(chunk=-1), "chunk"),
     (np.zeros((1, 1)), dict(dtype="int32"), "dtype")],
)  # fmt: skip
def test_errors(points, settings, words):
    with pytest.raises(ValueError, match=words):
        next(label_chunks(scalar(), points, **settings))


def test_no_points():
    assert list(label_chunks(scalar(), np.zeros((0, 1)))) == []
