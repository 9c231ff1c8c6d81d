"""`python experiments/bench`: answers are judged by residuals of its own, nothing is lost."""

import json
import shlex
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from bench import cases, command, rivals
from bench.cases import Case, Row, measure
from bench.growth import Growth, Point, exponents
from bench.rivals import RIVALS, Batch, Rival, residuals
from bench.roofline import Ceilings, Work

from jaxmpc.qp.status import Status

PLANS = "--what plans --families joint --horizons 3 --batches 8 --tolerances 1e-6 --rounds 1"


@pytest.fixture(autouse=True)
def _prepared(in_empty_folder, monkeypatch):
    monkeypatch.setattr(Ceilings, "measure", lambda rounds=3: Ceilings(1.0, 1.0, 1.0))


@pytest.fixture
def without(monkeypatch):
    """Return a function that makes packages look as if they were not installed."""
    find = rivals.find_spec
    return lambda *names: monkeypatch.setattr(
        rivals, "find_spec", lambda name: None if name in names else find(name)
    )


def run(line):
    return command.main(shlex.split(line))


def known_qps(count=20, n=6, rows=9, seed=0):
    """QPs built from their answers: z and y (count, …) are drawn first, then q, l and u."""
    random = np.random.default_rng(seed)
    L, A = random.standard_normal((n, n)), random.standard_normal((rows, n))
    P = L @ L.T + np.eye(n)
    z, y = random.standard_normal((count, n)), random.standard_normal((count, rows))
    y[:, rows // 2 :] = 0.0
    room = random.uniform(0.1, 1, (2, count, rows))
    l = z @ A.T - np.where(y < 0, 0, room[0])
    u = z @ A.T + np.where(y > 0, 0, room[1])
    return Batch(P, A, -z @ P - y @ A, l, u), z, y


def test_residuals_of_a_known_answer_and_of_others():
    qps, z, y = known_qps()
    assert residuals(qps, z, y).max() < 1e-12
    off = z.copy()
    off[3] += 1e-5 * qps.A[0] / np.linalg.norm(qps.A[0]) * np.sign(y[3, 0])
    worst = residuals(qps, off, y)
    step = 1e-5 * np.linalg.norm(qps.A[0])  # beyond the row that is active
    assert worst[0, 3] >= step * (1 - 1e-9) and np.delete(worst, 3, axis=1).max() < 1e-12
    # A multiplier of the wrong size shows in the dual residual, one at a bound that is not active
    # in the gap, and one at a bound that is not there as if it were zero.
    wrong = y.copy()
    wrong[5, 0] *= 2
    np.testing.assert_allclose(residuals(qps, z, wrong)[1, 5], np.abs(y[5, 0] * qps.A[0]).max())
    free = replace(qps, u=np.where(y > 0, np.inf, qps.u), l=np.where(y < 0, -np.inf, qps.l))
    np.testing.assert_allclose(residuals(free, z, y)[1], np.abs(y @ qps.A).max(axis=1), rtol=1e-9)
    assert np.all(np.isinf(residuals(qps, np.full_like(z, np.nan), y)))


@pytest.mark.parametrize("name", [n for n, r in RIVALS.items() if not r.in_jax])
def test_rivals_find_known_answers(name):
    rival = RIVALS[name]
    if not rival.installed:
        pytest.skip(f"{name} is not installed")
    qps, z, y = known_qps()
    found = rival.make(qps, 1e-8)()
    np.testing.assert_allclose(found[0], z, atol=1e-5)
    np.testing.assert_allclose(found[1], y, atol=1e-4)
    assert np.all(found[2] == Status.SOLVED)
    nowhere = replace(
        qps,
        A=np.vstack([qps.A, qps.A[:1]]),
        l=np.c_[qps.l, qps.u[:, 0] + 1],
        u=np.c_[qps.u, qps.u[:, 0] + 2],
    )
    status = rival.make(nowhere, 1e-8)()[2]
    assert np.all(status != Status.SOLVED)
    # ProxQP ends at its limit of steps on most of these.
    assert name == "proxqp" or np.all(status == Status.PRIMAL_INFEASIBLE)


@pytest.mark.slow
def test_a_solver_that_lies_is_found_out(monkeypatch):
    """It says solved with answers that are 1e-5 off: counted as not solved, each status as false,
    and never as the best rival."""
    honest = RIVALS["osqp"]

    def make(qps, tolerance):
        call = honest.make(qps, 1e-9)

        def answers():
            z, y, _ = call()
            return z + 1e-5, y, np.full(len(z), Status.SOLVED)

        return answers

    monkeypatch.setitem(rivals.RIVALS, "osqp", Rival("osqp", make))
    with jax.enable_x64(True):
        case = Case("plans", "joint", 8, 1e-6, 3, ("jaxmpc", "osqp", "clarabel"), rounds=1)
        rows = {row.solver: row for row in list(measure(case))[-1]}
    assert rows["osqp"].solved == 0 and rows["osqp"].false == 8
    for name in ("jaxmpc", "clarabel"):
        assert rows[name].solved == 1 and rows[name].false == 0
    assert rows["clarabel"].speedup == 1
    assert rows["jaxmpc"].speedup == rows["clarabel"].microseconds / rows["jaxmpc"].microseconds


@pytest.mark.slow
def test_command_writes_table_json_and_plot(tmp_path, capsys, without):
    without("daqp")
    assert run(f"{PLANS} --rivals osqp clarabel daqp --loop 4") == 0
    out = capsys.readouterr().out
    assert "skipped" in out and "not installed: daqp" in out
    assert "plans: joint, N = 3, 8 states" in out and "over 4 of the states, extrapolated" in out
    folder = tmp_path / "jaxmpc-bench"
    assert {path.name for path in folder.iterdir()} == {"bench.json", "bench.png"}
    document = json.loads((folder / "bench.json").read_text())
    assert set(document) == {
        "command",
        "date",
        "complete",
        "settings",
        "versions",
        "machine",
        "ceilings",
        "skipped",
        "notes",
        "rows",
        "growth",
        "exponents",
    }
    assert document["complete"] and document["skipped"] == ["daqp"]
    assert {"jax", "osqp", "clarabel"} <= set(document["versions"])
    assert document["machine"]["cpu"] and document["machine"]["cores"] >= 1
    rows = {row["solver"]: row for row in document["rows"]}
    assert set(rows) == {"jaxmpc", "jaxmpc vmap", "osqp", "clarabel"}
    for name, row in rows.items():
        assert row["solved"] == 1 and row["false"] == 0 and row["batch"] == 8, name
        assert row["extrapolated"] == (name in ("osqp", "clarabel"))
        assert 0 < row["warm_seconds"] and row["microseconds"] == pytest.approx(
            1e6 * row["warm_seconds"] / row["states"]
        )
        assert row["cold_seconds"] >= row["compile_seconds"] >= 0
    assert rows["jaxmpc vmap"]["work"]["xla_flops"] > 0 and rows["jaxmpc vmap"]["ceiling"] > 0


def test_ctrl_c_keeps_what_was_measured(tmp_path, capsys, monkeypatch):
    row = Row(
        "plans", "joint", 3, 3, 12, 8, 1e-6, "jaxmpc", "1", 8, False, 2.0, 1.0, 0, 1.0, 0.5, 2e-6
    )

    def interrupted(*_):
        yield [row]
        raise KeyboardInterrupt

    monkeypatch.setattr(command, "measure", interrupted)
    assert run(f"{PLANS} --rivals none") == 130
    document = json.loads((tmp_path / "jaxmpc-bench" / "bench.json").read_text())
    assert [r["solver"] for r in document["rows"]] == ["jaxmpc"] and not document["complete"]
    assert (tmp_path / "jaxmpc-bench" / "bench.png").stat().st_size > 1000
    out = capsys.readouterr().out
    assert "stopped; what was measured is kept" in out and "plans: joint" in out


@pytest.mark.parametrize(
    "options, words",
    [
        ("--batches 0", ("--batches", "0")),
        ("--batches 2000000", ("--batches", "2000000")),
        ("--batches", ("--batches",)),
        ("--families jont", ("jont", "Did you mean joint")),
        ("--rivals dapq", ("dapq", "Did you mean daqp")),
        ("--rivals none osqp", ("--rivals", "none")),
        ("--what none", ("--what", "--growth")),
        ("--what everything", ("--what", "labels")),
        ("--tolerances 0", ("--tolerances",)),
        ("--horizons 0", ("--horizons",)),
        ("--rounds 0", ("--rounds",)),
        ("--loop 0", ("--loop",)),
        ("--growth --what none --horizons 3", ("--horizons",)),
        ("--output /proc/nowhere/x", ("--output",)),
    ],
)
def test_bad_options_are_refused_in_a_line(options, words, capsys, monkeypatch):
    monkeypatch.setattr(command.Record, "run", lambda self: pytest.fail("it started"))
    assert run(options) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and all(word in error for word in words), error


def test_quick_gives_way_to_other_options():
    chosen = command.Bench(quick=True, batches=(7,)).settled()
    assert chosen.batches == (7,) and chosen.families == ("joint",) and chosen.rounds == 3


def test_labels_of_a_family_without_state_limits_are_left_out(tmp_path, capsys):
    assert run("--what labels --families turbompc --batches 4 --rivals none") == 0
    assert "no state limits" in capsys.readouterr().out
    assert json.loads((tmp_path / "jaxmpc-bench/bench.json").read_text())["rows"] == []


def test_labels_agree_with_an_independent_solver(without):
    with jax.enable_x64(True):
        case = Case("labels", "joint", 64, 1e-6, 3, ("jaxmpc", "clarabel"), rounds=1)
        rows = {row.solver: row for row in list(measure(case))[-1]}
        labels = rows["jaxmpc"], rows["clarabel"]
        assert [row.solved for row in labels] == [1, 1] and [row.false for row in labels] == [0, 0]
        # Proofs of the negated labels are no proofs.
        own = next(cases._own_labels(case))
        answer = own.prepare()()
        flipped = replace(answer, labels=replace(answer.labels, label=-answer.labels.label))
        assert own.judge(answer) == (1.0, 0) and own.judge(flipped) == (0.0, 64)


def test_work_counts_products_times_loops():
    A = jnp.ones((20, 30), jnp.float32)

    def program(x):
        step = lambda c, _: (A @ (A.T @ c), None)
        return jax.lax.scan(step, x, length=7)[0]

    work = Work.of(program, jnp.ones((20, 5), jnp.float32))
    assert work.flops32 == 7 * 2 * (2 * 20 * 30 * 5) and work.flops64 == 0
    assert work.bytes == 7 * 2 * 4 * (20 * 30 + 20 * 5 + 30 * 5)
    ceilings = Ceilings(1.0, 2.0, 1e9)
    assert ceilings.share(work, 1.0) == (work.flops32 / 1e9, "flops")


def test_exponents_of_the_upper_half():
    """Flat below, quadratic above: where it bends does not count."""
    point = lambda n, seconds: Point("n", n, "springs", 1, 1, n, n, 3 * n, 0.0, seconds, 1.0)
    points = [point(n, max(n, 16) ** 2 / 1e6) for n in (1, 2, 4, 8, 16, 32, 64, 128)]
    found = exponents([*points, replace(points[-1], value=256, seconds=None)])
    assert found["n"]["seconds"] == pytest.approx(2)


@pytest.mark.slow
def test_growth_ends_where_memory_does(monkeypatch, tmp_path):
    from bench import growth
    from bench.plots import plot_growth

    sizes = Growth(batches=(2, 4), horizons=(), states=(), rounds=1)
    with jax.enable_x64(True):
        points = list(sizes.run())
        assert [p.value for p in points] == [2, 4] and all(p.seconds > 0 for p in points)
        assert points[0].memory < points[1].memory and points[1].solved == 1
        monkeypatch.setattr(growth, "free_memory", lambda: points[0].memory - 1.0)
        ended = list(sizes.run())
    assert len(ended) == 1 and ended[0].seconds is None and "memory" in ended[0].note
    plot_growth([*points, *ended]).savefig(tmp_path / "growth.png")


@pytest.mark.slow
@pytest.mark.parametrize("what, family", [("gradients", "joint"), ("loops", "turbompc")])
def test_gradients_and_loops(what, family):
    with jax.enable_x64(True):
        case = Case(what, family, 8, 1e-6, 5, ("jaxmpc vmap", "moreau"), rounds=1)
        for row in list(measure(case))[-1]:
            assert row.solved == 1 and row.false == 0
            assert row.forward_microseconds > 0 and row.forward_microseconds < 3 * row.microseconds
            assert what == "loops" or row.gradient_error < 1e-4
