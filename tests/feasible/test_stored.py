"""A map read block by block says what the map of all points says."""

import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import problems
import pytest
import xarray as xr

import jaxmpc as jm
from jaxmpc import store
from jaxmpc.feasible import stored
from jaxmpc.feasible.map import FeasibleSetMap
from jaxmpc.feasible.pipeline import Scope, label_parts
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.feasible.stored import (
    HalfSpaces,
    StoredMap,
    extreme,
    line_ends,
    open_labels,
    stored_labels,
    sweep_into,
)
from jaxmpc.grids import mesh
from jaxmpc.sets.geometry import hull_volume
from jaxmpc.verify import verify_map


def test_points_of_a_part_of_a_grid():
    lines = [np.linspace(-1, 1, 5), np.linspace(0, 3, 7), np.linspace(2, 5, 3)]
    whole = mesh(lines)
    for index in (np.arange(105), np.arange(20, 31), np.array([7, 3, 104])):
        np.testing.assert_array_equal(mesh(lines, index), whole[index])


def test_scope_of_a_grid_is_that_of_its_points():
    lines = [np.linspace(-3, 1, 8), np.linspace(0, 3, 7), np.linspace(-2, 5, 4)]
    found, expected = Scope.of_grid(lines, 3), Scope.of(mesh(lines), 3)
    np.testing.assert_array_equal(found.largest, expected.largest)
    np.testing.assert_array_equal(found.typical, expected.typical)


def labelled(path, problem, lines, chunk, **changes):
    """Return the open store of a labelled grid."""
    kept = open_labels(path, problem, lines, {}, chunk)
    parts = (mesh(lines, kept.samples(block)) for block in kept.pending())
    scope = Scope.of_grid(lines, len(kept.regions))
    for block, labels in enumerate(label_parts(problem, parts, scope, kept.size, **changes)):
        kept.commit(block, **labels.arrays())
    return kept


@pytest.mark.parametrize(
    ("name", "many"), [("lecture", 30), ("joint", 30), ("lecture", 10_000), ("scalar", 1)]
)
@pytest.mark.first(1)
def test_says_what_a_map_of_all_points_says(tmp_path, monkeypatch, name, many):
    """Also where points and half-spaces are reduced again and again."""
    monkeypatch.setattr(stored, "MANY_ROWS", many)
    monkeypatch.setattr(stored, "LINES", 10)
    problem = FeasibilityProblem.of(getattr(problems, name)())
    extent = 2.1 * np.ones(problem.dimension)
    lines = [np.linspace(-e, e, 24 + i) for i, e in enumerate(extent)]
    with labelled(tmp_path / "a.zarr", problem, lines, 64) as kept:
        found = StoredMap.read(problem, kept, lines)
        whole = FeasibleSetMap.of(problem, mesh(lines), stored_labels(kept))
        assert found.counts == whole.counts()
        assert found.counts["feasible"] and found.counts["infeasible"]
        np.testing.assert_allclose(
            found.bounds.volume_bounds(), whole.volume_bounds(), rtol=1e-9, atol=1e-12
        )
        assert len(found.bounds.bound_point) <= many + 200
        refined = found.refine()
        expected = whole.refine()
        assert refined.counts == expected.counts()
        written = np.asarray(kept.group["bound_point"])
        np.testing.assert_array_equal(written, expected.bound_point)
        np.testing.assert_allclose(
            refined.bounds.volume_bounds(), expected.volume_bounds(), rtol=1e-9
        )
        if problem.dimension == 2:
            points, label, counts = found.picture()
            assert counts == found.counts and len(points) == 8 * 9
            index = np.ravel_multi_index(
                np.meshgrid(np.arange(0, 24, 3), np.arange(0, 25, 3), indexing="ij"), (24, 25)
            )
            np.testing.assert_array_equal(points, mesh(lines)[index.ravel()])
            np.testing.assert_array_equal(label, whole.label[index.ravel()])


def test_undecided_states_that_rays_exclude_count_as_infeasible(tmp_path, monkeypatch):
    """As in `FeasibleSetMap.refine`, here block by block."""
    from jaxmpc.feasible import pipeline

    monkeypatch.setattr(pipeline, "MOST_PROGRAMS", 0)
    problem = FeasibilityProblem.of(problems.lecture())
    lines = [np.linspace(-1.2, 1.2, 20), np.linspace(-1.2, 1.2, 21)]
    with labelled(tmp_path / "a.zarr", problem, lines, 64) as kept:
        label = kept.read("label", 1)
        undecided = np.flatnonzero(label == -1)[::2]
        blank = kept.read("label", 1), kept.read("status", 1)
        blank[0][undecided], blank[1][undecided] = 0, jm.Status.ITERATION_LIMIT
        rows = {name: kept.read(name, 1) for name in kept.fields}
        kept.commit(1, **rows | {"label": blank[0], "status": blank[1]})
        found = StoredMap.read(problem, kept, lines)
        assert found.counts["undecided"] == len(undecided) > 5
        refined = found.refine()
        whole = FeasibleSetMap.of(problem, mesh(lines), stored_labels(kept)).refine()
        assert refined.counts == whole.counts()
        assert refined.counts["undecided"] < len(undecided)
        np.testing.assert_array_equal(refined.picture().label, whole.label)


@pytest.mark.slow
def test_large_blocks_hold_the_same_bits(tmp_path, monkeypatch):
    """As blocks of one part, and as the blocks of shards; some states need linear programs."""
    from jaxmpc import batches

    monkeypatch.setattr(stored, "CHUNK", 48)
    monkeypatch.setattr(batches, "CHUNK", 48)
    lines = [np.linspace(-1.3, 1.3, 50), np.linspace(-1.3, 1.3, 23)]
    mpc, found = problems.lecture(), []
    for name, chunk, shards in (
        ("a", None, [None]),
        ("b", 48, [None]),
        ("c", None, [(0, 2), (1, 2)]),
    ):
        for shard in shards:
            sweep_into(tmp_path / name, mpc, lines, chunk=chunk, shard=shard, iterations=5)
        found.append(store.read(tmp_path / name))
        assert not found[-1].problems and found[-1].done == found[-1].blocks
    assert [each.blocks for each in found] == [9, 25, 25]
    for other in found[1:]:
        for name, value in found[0].arrays.items():
            np.testing.assert_array_equal(value, other.arrays[name], err_msg=name)


@pytest.mark.long
def test_a_store_of_small_blocks_is_read_verified_and_resumed(tmp_path):
    """The file was written when blocks were what a program takes at once, here 39 states."""
    shutil.unpack_archive(Path(__file__).with_name("small_blocks.tar.xz"), tmp_path, filter="data")
    path, lines = tmp_path / "small_blocks.zarr", [np.linspace(-2.1, 2.1, n) for n in (12, 13)]
    before = xr.open_zarr(path).load()
    assert int((before["label"] == 1).sum()) == 88 and not store.read(path).problems
    assert verify_map(path).passed
    (path / "plan" / "c" / "1" / "0" / "0" / "0").unlink()
    assert len(store.read(path).problems) == 1
    found = sweep_into(path, problems.joint(5), lines, resume=True)
    assert found.store.damaged == 1 and found.timing.count == 39
    assert found.store.block_shape == (3, 13)
    after = xr.open_zarr(path).load()
    np.testing.assert_array_equal(before["label"], after["label"])
    assert verify_map(path).passed


def test_ends_of_lines():
    flags = np.random.default_rng(0).random((5, 3, 7)) < 0.3
    expected = []
    for row, line in enumerate(flags.reshape(-1, 7)):
        there = np.flatnonzero(line)
        expected += [row * 7 + k for k in {there.min(), there.max()}] if len(there) else []
    np.testing.assert_array_equal(line_ends(flags.ravel(), slice(4, 11)), sorted(expected))
    assert len(line_ends(np.zeros(6, bool), slice(0, 3))) == 0


@pytest.mark.parametrize("d", [1, 2, 3, 5])
def test_extreme_points_span_the_hull(d):
    points = np.random.default_rng(d).standard_normal((200, d))
    found = extreme(points)
    assert hull_volume(found) == pytest.approx(hull_volume(points), rel=1e-12)
    assert len(found) < 200 or d > stored.MOST_REDUCED
    flat = np.column_stack([points, np.zeros(200)])
    assert len(extreme(flat)) == 200 or d == 1 and len(extreme(flat)) in (2, 200)


class TestHalfSpaces:
    def test_intersection_is_kept(self, monkeypatch):
        """Of a polytope with known facets, hidden among many half-spaces that do not matter."""
        monkeypatch.setattr(stored, "MANY_ROWS", 40)
        random = np.random.default_rng(0)
        facets = random.standard_normal((7, 2))
        facets = np.concatenate([facets, -facets])
        rows = np.concatenate([facets, random.standard_normal((500, 2))])
        body = jm.Polytope(facets, np.ones(14))
        offsets = np.array([body.support(row) * random.uniform(1, 2) for row in rows])
        offsets[:14] = 1.0
        order = random.permutation(len(rows))
        found = HalfSpaces.none(np.array([[-1.0, -1], [1, 1]]))
        for some in np.array_split(order, 20):
            scale = random.uniform(0.1, 10, (len(some), 1))
            found = found.add(rows[some] * scale, offsets[some] * scale[:, 0])
        assert len(found.offsets) < 100
        volume = jm.Polytope(found.normals, found.offsets).reduce().volume()
        assert volume == pytest.approx(body.reduce().volume(), rel=1e-9)

    def test_nothing_is_made_of_bad_rows(self):
        found = HalfSpaces.none(np.array([[-1.0, -1], [1, 1]])).add(
            np.array([[1.0, 0], [np.nan, 1], [0, 0], [1, 1]]), np.array([np.inf, 1, 1, 2])
        )
        np.testing.assert_array_equal(found.normals, [[1, 1]])

    def test_one_side_is_read_before_the_other(self, monkeypatch):
        """Unbounded at first: what bounds it on that side is kept all the same."""
        monkeypatch.setattr(stored, "MANY_ROWS", 40)
        found = HalfSpaces.none(np.array([[-2.0, -2], [2, 2]]))
        angle = np.linspace(0, 2 * np.pi, 401)[:-1]
        rows = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        offsets = 1 + 0.1 * (np.arange(400) % 10)
        for some in np.array_split(np.arange(400), 8):
            found = found.add(rows[some], offsets[some])
        body = jm.Polytope(rows[::10], np.ones(40)).reduce()
        bound = jm.Polytope(found.normals, found.offsets).reduce()
        assert bound.volume() == pytest.approx(body.volume(), rel=1e-9)

    @pytest.mark.parametrize("d", [2, 5])
    def test_empty_intersections(self, monkeypatch, d):
        monkeypatch.setattr(stored, "MANY_ROWS", 40)
        normals = np.random.default_rng(0).standard_normal((100, d))
        empty = HalfSpaces.none(np.array([-np.ones(d), np.ones(d)])).add(normals, -np.ones(100))
        assert len(empty.offsets) == (40 if d == 2 else 100) and empty.vertices is None


def test_reads_one_block_at_a_time(tmp_path):
    """Nothing asks the store for a variable as a whole."""
    problem = FeasibilityProblem.of(problems.lecture())
    lines = [np.linspace(-1.2, 1.2, 20), np.linspace(-1.2, 1.2, 21)]
    with labelled(tmp_path / "a.zarr", problem, lines, 64) as kept:
        asked = []
        spy = SimpleNamespace(
            regions=kept.regions, samples=kept.samples, save=kept.save,
            read=lambda name, block: (asked.append(name), kept.read(name, block))[1],
        )  # fmt: skip
        StoredMap.read(problem, spy, lines).refine()
    assert asked and "plan" not in asked and "start" not in asked


LINES = [np.linspace(-1.2, 1.2, 20), np.linspace(-1.2, 1.2, 21)]


def test_sweep_into_a_store(tmp_path):
    """Labels and bounds are those of a map of all points; no run but the first has work to do."""
    mpc, path = problems.lecture(), tmp_path / "a.zarr"
    found = jm.feasible.sweep_into(path, mpc, LINES, chunk=64)
    whole = jm.map_feasible_set(mpc, mesh(LINES), gap=1e-6, chunk=64)
    assert found.counts == whole.counts() and found.left == "" and found.timing.count == 420
    np.testing.assert_allclose(found.bounds.volume_bounds(), whole.volume_bounds(), rtol=1e-9)
    there = store.read(path)
    assert not there.problems and there.done == there.blocks > 3
    np.testing.assert_array_equal(there.arrays["label"] == 1, whole.label == 1)
    with pytest.raises(ValueError, match="exists"):
        jm.feasible.sweep_into(path, mpc, LINES, chunk=64)
    with pytest.raises(ValueError, match="iterations: 50 there, 60 here"):
        jm.feasible.sweep_into(path, mpc, LINES, chunk=64, iterations=60, resume=True)
    again = jm.feasible.sweep_into(path, mpc, LINES, chunk=64, resume=True)
    assert again.timing.count == 0 and again.counts == found.counts


def test_shards_sweep_into_one_store(tmp_path):
    concluded = []
    how = {"chunk": 64, "gap": None, "concluded": concluded.append}
    path = tmp_path / "a.zarr"
    first = jm.feasible.sweep_into(path, problems.lecture(), LINES, shard=(1, 2), **how)
    assert "are missing, of other shards" in first.left and not first.counts and not concluded
    last = jm.feasible.sweep_into(path, problems.lecture(), LINES, shard=(0, 2), **how)
    assert last.left == "" and concluded == [last]
    assert first.timing.count + last.timing.count == sum(last.counts.values()) == 420
    with pytest.raises(ValueError, match="overwrite: given beside shard"):
        jm.feasible.sweep_into(path, None, LINES, shard=(0, 2), overwrite=True)


def test_results_print_in_a_few_lines(tmp_path):
    mpc, points = problems.lecture(), mesh(LINES)
    fmap = jm.map_feasible_set(mpc, points, gap=1e-6, chunk=64)
    swept = jm.feasible.sweep_into(tmp_path / "a.zarr", mpc, LINES, chunk=64)
    edges, growth = jm.feasible.boundary(mpc, 8), jm.feasible.feasible_growth(mpc, (2, 3))
    verified = jm.verify.verify_map(tmp_path / "a.zarr")
    for found in (fmap, fmap.labels, swept, edges, growth, verified):
        text = repr(found)
        assert text.startswith(type(found).__name__)
        assert text.count("\n") < 5 and max(map(len, text.split("\n"))) <= 200
    assert f"{int(np.sum(fmap.label == 1))} feasible" in repr(fmap)
