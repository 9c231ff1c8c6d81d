"""The store keeps every committed block, whatever happens to the writer, and trusts none that is
not as it was written."""

import shutil
import signal
import subprocess
import sys
import textwrap
import threading
import time
import warnings

import numpy as np
import pytest
import xarray as xr
import zarr
from damage import turned_bits

from jaxmpc import files, store
from jaxmpc.feasible.map import BOUNDS
from jaxmpc.feasible.stored import dimension_names, label_fields, stored_labels
from jaxmpc.store import BlockWriter, Constant, Store, block_writer
from jaxmpc.store.reading import regions
from jaxmpc.store.writing import block_shape, default_block

AXES = {
    "q": Constant(np.linspace(-1, 1, 5), ("q",), {"units": "rad", "long_name": "q"}),
    "dq": Constant(np.linspace(0, 3, 4), ("dq",), {"units": "rad/s", "long_name": "dq"}),
}
CONFIG = {"mpc": {"horizon": 3}, "limits": {"x_min": ["-Infinity", 0.0]}}
FIELDS = label_fields(2, 3, 1, 2)


def rows(count, value):
    return {
        "label": np.full(count, value, np.int8),
        "status": np.full(count, 1, np.int8),
        "start": np.full((count, 2), float(value)),
        "plan": np.full((count, 3, 1), float(value)),
        "cut_normal": np.full((count, 2), np.nan),
        "cut_offset": np.full(count, 2.0),
    }


def bounds(count):
    """What refinement saves: so many points, and four half-spaces."""
    values = np.ones((count, 2)), np.ones((4, 2)), np.arange(4.0)
    return {name: Constant(v, BOUNDS[name]) for name, v in zip(BOUNDS, values, strict=True)}


def open_store(path, config=CONFIG, axes=AXES, chunk=8, **how):
    names = {"state": Constant(np.array(["q [rad]", "dq [rad/s]"]), ("state",))}
    return Store(path, axes, FIELDS, config, chunk, constants=names, **how)


@pytest.fixture
def full(tmp_path):
    """Return the path of a store with all blocks done."""
    path = tmp_path / "sweep.zarr"
    with open_store(path) as kept:
        for block in kept.pending():
            here = kept.rows(block)
            kept.commit(block, **rows(here.stop - here.start, 1 - 2 * (block % 2)))
        kept.save(bounds(3))
    return path


class TestBlocks:
    @pytest.mark.parametrize(
        ("shape", "most"),
        [((5, 4), 8), ((7,), 3), ((3, 5, 7), 14), ((3, 5, 7), 8), ((4, 4), 1), ((2, 3), 100)],
    )
    def test_are_consecutive_and_cover_the_grid(self, shape, most):
        block = block_shape(shape, most)
        whole, found = np.arange(np.prod(shape)).reshape(shape), []
        for region in regions(shape, block):
            part = whole[region].ravel()
            assert len(part) <= most
            np.testing.assert_array_equal(np.diff(part), 1)
            found.append(part)
        np.testing.assert_array_equal(np.concatenate(found), whole.ravel())

    @pytest.mark.parametrize(
        ("shape", "part", "processes", "expected"),
        [
            ((1024, 1024), 8192, 1, (128, 1024)),
            ((1024, 1024), 8192, 16, (8, 1024)),
            ((1000, 1000), 8192, 1, (120, 1000)),
            ((256, 256), 8192, 1, (32, 256)),
            ((4, 100_000), 8192, 1, (1, 46_158)),
            ((50, 50, 50), 1000, 1, (6, 50, 50)),
            ((30,), 7, 1, (6,)),
            ((3, 5), 100, 1, (3, 5)),
        ],
    )
    def test_consist_of_whole_parts(self, tmp_path, shape, part, processes, expected):
        """The parts are those of a store with one part a block, whatever its number of blocks."""
        block = default_block(shape, part, 200, processes)
        assert block == expected
        axes = {f"x{i}": Constant(np.arange(n), (f"x{i}",)) for i, n in enumerate(shape)}
        found = []
        for name, chunk in (("large.zarr", None), ("small.zarr", part)):
            with Store(
                tmp_path / name, axes, FIELDS, {}, chunk, part=part, shard=(0, processes)
            ) as kept:
                parts = [kept.parts(block, part) for block in range(len(kept.regions))]
                for block, inside in enumerate(parts):
                    assert (inside[0].start, inside[-1].stop) == (
                        kept.rows(block).start,
                        kept.rows(block).stop,
                    )
                found.append([each for inside in parts for each in inside])
                sizes = [each.stop - each.start for each in found[-1]]
                assert kept.part_size(part) == max(sizes)
        assert found[0] == found[1]

    def test_of_large_samples_are_smaller(self):
        assert default_block((2**13, 2**13), 2**13, 100, 1) == (16, 2**13)
        assert default_block((2**13, 2**13), 2**13, 1000, 1) == (4, 2**13)
        assert default_block((2**13, 2**13), 2**13, 10**6, 1) == (1, 2**13)

    def test_without_a_size_are_those_of_the_store_there(self, tmp_path):
        path = tmp_path / "sweep.zarr"
        with open_store(path, chunk=8) as kept:
            kept.commit(1, **rows(8, 1))
        with open_store(path, chunk=None, part=20) as kept:
            assert kept.pending() == [0, 2] and kept.block_shape == (2, 4)
        with open_store(path, chunk=None, part=20, overwrite=True) as kept:
            assert kept.block_shape == (5, 4)
            kept.commit(0, **rows(20, 1))
        assert store.read(path).attributes["chunk"] == 20

    def test_resume(self, tmp_path):
        path = tmp_path / "sweep.zarr"
        with open_store(path) as kept:
            assert kept.pending() == [0, 1, 2]
            assert [kept.rows(k) for k in range(3)] == [slice(0, 8), slice(8, 16), slice(16, 20)]
            kept.commit(2, **rows(4, -1))
        with open_store(path) as kept:
            assert kept.pending() == [0, 1] and kept.damaged == 0
            kept.commit(0, **rows(8, 1))
            np.testing.assert_array_equal(kept.read("label"), [1] * 8 + [0] * 8 + [-1] * 4)
            labels = stored_labels(kept)
        assert labels.plan.shape == (20, 3, 1) and np.isnan(labels.cut_offset[8:16]).all()

    def test_a_block_counts_once_its_rows_are_written(self, tmp_path, monkeypatch):
        """Killed before any of its writes, a block is not done; after the last it is."""
        path, written = tmp_path / "sweep.zarr", []
        with open_store(path) as kept:
            write = zarr.Array.__setitem__
            for stop in range(len(FIELDS) + 1):
                count = iter(range(stop))

                def until(array, where, value, count=count):
                    if next(count, None) is None:
                        raise KeyboardInterrupt
                    written.append(array.name)
                    write(array, where, value)

                monkeypatch.setattr(zarr.Array, "__setitem__", until)
                with pytest.raises(KeyboardInterrupt):
                    kept.commit(1, **rows(8, 1))
                monkeypatch.undo()
                assert kept.pending() == [0, 1, 2]
            kept.commit(1, **rows(8, 1))
            assert kept.pending() == [0, 2]


class TestBlockWriter:
    """Blocks of parts, written in a thread."""

    def put(self, writer, block, parts=2):
        """Give the rows of a block in so many parts, the last one first."""
        place = writer.store.rows(block)
        samples = np.arange(place.start, place.stop)
        for part in reversed(np.array_split(samples, parts)):
            values = rows(len(part), 1) | {"cut_offset": part.astype(float)}
            writer.put(block, slice(part[0], part[-1] + 1), **values)

    def test_writes_what_it_is_given(self, tmp_path):
        path = tmp_path / "sweep.zarr"
        with open_store(path) as kept, BlockWriter(kept) as writer:
            for block, parts in ((1, 3), (0, 1), (2, 2)):
                self.put(writer, block, parts)
        found = store.read(path)
        assert found.done == 3 and not found.problems
        np.testing.assert_array_equal(found.arrays["cut_offset"], np.arange(20.0))
        assert found.arrays["plan"].shape == (20, 3, 1) and (found.arrays["plan"] == 1).all()

    @pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError])
    def test_an_interruption_loses_the_block_in_hand(self, tmp_path, error):
        path = tmp_path / "sweep.zarr"
        with open_store(path) as kept:
            with pytest.raises(error), BlockWriter(kept) as writer:
                self.put(writer, 0)
                writer.put(1, slice(8, 12), **rows(4, 1))
                raise error
            assert kept.pending() == [1, 2]
        assert not store.read(path).problems

    @pytest.mark.parametrize("overwrite", [False, True])
    def test_on_many_cores_several_blocks_are_written_at_once(
        self, tmp_path, monkeypatch, overwrite
    ):
        """But the first one of a store that replaces another is written alone."""
        path, together, running = tmp_path / "sweep.zarr", [], []
        monkeypatch.setattr(block_writer, "cores", lambda: 8)
        begun = threading.Barrier(3 - overwrite, timeout=30)
        commit = Store.commit

        def slow(kept, block, **rows):
            running.append(block)
            if block or not overwrite:
                begun.wait()  # for all that may be written at once
            together.append(len(running))
            commit(kept, block, **rows)
            running.remove(block)

        if overwrite:
            with open_store(path) as kept, BlockWriter(kept) as writer:
                self.put(writer, 0)
        monkeypatch.setattr(Store, "commit", slow)
        with open_store(path, overwrite=overwrite) as kept:
            with BlockWriter(kept) as writer:
                for block in range(3):
                    self.put(writer, block)
            assert not kept.pending()
        assert together[0] == (1 if overwrite else 3) and max(together) == 3 - overwrite
        assert store.read(path).done == 3 and not store.read(path).problems

    @pytest.mark.parametrize("more", [0, 1])
    def test_an_error_of_the_thread_reaches_the_caller(self, tmp_path, monkeypatch, more):
        """When the next block is whole, or at the end; and no block is marked as done by it."""
        monkeypatch.setattr(block_writer, "cores", lambda: 2)

        def full(array, where, value):
            raise OSError("No space left on device")

        with open_store(tmp_path / "sweep.zarr") as kept:
            monkeypatch.setattr(zarr.Array, "__setitem__", full)
            reached = []
            with pytest.raises(OSError, match="No space"), BlockWriter(kept) as writer:
                self.put(writer, 0)
                for block in range(1, 1 + more):
                    self.put(writer, block)
                reached.append("end")
            monkeypatch.undo()
            assert reached == ([] if more else ["end"]) and kept.pending() == [0, 1, 2]


class TestReadingByBlocks:
    def test_visits_each_block_and_keeps_what_is_asked(self, full):
        """The blocks, by threads in any order, hold what all of it holds."""
        seen, everything = {}, store.read(full).arrays

        def visit(found, first, arrays):
            assert set(found.arrays) == {"label", "state", *BOUNDS} and found.done == 3
            seen[first] = arrays

        found = store.read(full, keep=("label",), visit=visit)
        assert not found.problems and found.count == 20 and set(seen) == {0, 8, 16}
        np.testing.assert_array_equal(found.arrays["label"], everything["label"])
        np.testing.assert_array_equal(found.points_at(np.array([5, 19])), found.points[[5, 19]])
        for name in FIELDS:
            together = np.concatenate([seen[first][name] for first in sorted(seen)])
            np.testing.assert_array_equal(together, everything[name])

    def test_names_damaged_blocks(self, full):
        with open_store(full) as kept:
            for block in range(3):
                here = kept.rows(block)
                count = here.stop - here.start
                kept.commit(block, **rows(count, 1) | {"cut_normal": np.ones((count, 2))})
        zarr.open_group(full, mode="r+", use_consolidated=False)["plan"][3, 1] = 7.0
        assert store.read(full, keep=()).problems == ["block 1: data are not as they were written"]
        array_files(full, "start/c")[2].unlink()
        found = store.read(full, keep=())
        assert not found.whole and "block 2" in found.problems[-1] and "start" in found.problems[-1]


class TestDataSet:
    def test_opens_without_arguments(self, full):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            data = xr.open_zarr(full)
        assert data["label"].dims == ("q", "dq") and data["label"].dtype == np.int8
        assert data["plan"].dims == ("q", "dq", "time", "input")
        assert data["q"].attrs == {"units": "rad", "long_name": "q"}
        assert data["label"].attrs["flag_meanings"] == "infeasible undecided feasible"
        np.testing.assert_array_equal(data["label"].attrs["flag_values"], [-1, 0, 1])
        np.testing.assert_array_equal(data["q"], AXES["q"].data)
        assert list(data["state"].values) == ["q [rad]", "dq [rad/s]"]
        assert data.attrs["config"] == CONFIG and {"jax", "zarr"} <= set(data.attrs["versions"])
        assert data["bound_point"].dims == ("ray", "coordinate")
        assert float(data.sel(q=0, method="nearest").label[0]) == -1
        assert [child.name for child in full.parent.iterdir()] == ["sweep.zarr"]

    def test_draws(self, full):
        line = xr.open_zarr(full).sel(q=0, method="nearest").label.plot()
        assert len(line[0].get_xdata()) == 4

    def test_names_of_dimensions(self):
        assert dimension_names(["q", "dq"], FIELDS) == ["q", "dq"]
        assert dimension_names(["a/b", "dq"], FIELDS) == ["a_b", "dq"]
        for names in (["label", "q"], ["q", "q"], ["", "q"], ["..", "q"], ["time", "q"]):
            assert dimension_names(names, FIELDS) == ["x0", "x1"]

    def test_bounds_are_replaced(self, full):
        with open_store(full) as kept:
            kept.save(bounds(5))
        assert xr.open_zarr(full)["bound_point"].shape == (5, 2)
        assert not store.read(full).problems


class TestRefusals:
    def test_another_configuration(self, tmp_path):
        path = tmp_path / "sweep.zarr"
        open_store(path).close()
        with pytest.raises(ValueError, match="mpc.horizon: 3 there, 4 here"):
            open_store(path, config={**CONFIG, "mpc": {"horizon": 4}})
        with pytest.raises(ValueError, match="chunk: 8 there, 5 here"):
            open_store(path, chunk=5)
        with pytest.raises(ValueError, match="other points"):
            open_store(path, axes={**AXES, "q": AXES["q"]._replace(data=AXES["q"].data + 1)})

    def test_what_is_no_store_is_kept(self, tmp_path):
        folder = tmp_path / "photos"
        folder.mkdir()
        (folder / "precious").touch()
        for call in (store.open_dataset, store.remove, store.read, open_store):
            with pytest.raises(ValueError, match="is no sweep store"):
                call(folder)
        assert (folder / "precious").exists()
        (folder / "zarr.json").touch()
        with pytest.raises(ValueError, match="holds precious"):
            store.remove(folder)

    def test_a_second_process(self, full):
        with open_store(full):
            code = "from jaxmpc import store; import sys; store.remove(sys.argv[1])"
            command = [sys.executable, "-c", code, str(full)]
            second = subprocess.run(command, capture_output=True, text=True)
        assert second.returncode and "another process writes there" in second.stderr
        store.remove(full)
        assert not full.exists()


def array_files(path, name):
    return sorted(file for file in (path / name).rglob("*") if file.is_file())


class TestDamage:
    """Each damage is found when it is read, and repaired when work goes on."""

    def repaired(self, path, blocks):
        """Assert that the damage is found, and that these blocks are computed again."""
        assert store.read(path).problems
        with open_store(path) as kept:
            assert kept.pending() == blocks
            assert kept.damaged == len(blocks)
            for block in blocks:
                here = kept.rows(block)
                kept.commit(block, **rows(here.stop - here.start, 1 - 2 * (block % 2)))
        assert not store.read(path).problems
        np.testing.assert_array_equal(
            xr.open_zarr(path)["label"].values.ravel(), [1] * 8 + [-1] * 8 + [1] * 4
        )

    def test_flipped_labels(self, full):
        label = zarr.open_group(full, mode="r+", use_consolidated=False)["label"]
        label[0, 1] = -label[0, 1]
        self.repaired(full, [0])

    def test_a_missing_chunk(self, full):
        array_files(full, "plan/c")[1].unlink()
        self.repaired(full, [1])

    def test_a_truncated_chunk(self, full):
        file = array_files(full, "start/c")[2]
        file.write_bytes(file.read_bytes()[:-5])
        self.repaired(full, [2])

    @pytest.mark.parametrize("name", ["start", "checksum"])
    def test_a_missing_array(self, full, name):
        shutil.rmtree(full / name)
        self.repaired(full, [0, 1, 2])

    def test_a_garbled_checksum(self, full):
        array_files(full, "checksum/c")[1].write_bytes(b"garbled")
        self.repaired(full, [1])

    def test_garbled_metadata_of_an_array(self, full):
        (full / "label" / "zarr.json").write_text("{")
        self.repaired(full, [0, 1, 2])

    def test_an_axis(self, full):
        zarr.open_group(full, mode="r+", use_consolidated=False)["q"][1] = 0.3
        self.repaired(full, [])

    def test_garbled_metadata_of_the_group(self, full):
        (full / "zarr.json").write_text("{")
        for call in (store.read, open_store):
            with pytest.raises(ValueError, match="metadata cannot be read"):
                call(full)
        store.remove(full)
        assert not full.exists()

    def test_what_killed_runs_leave(self, full):
        orphan = files.side_path(full)
        orphan.mkdir()
        (full.parent / ".sweep.zarr.end.lock").touch()
        others = [full.with_name(f".sweep.zarr.{name}") for name in ("backup", "my.lock")]
        others.append(full.with_name(".s1.zarr.keep"))
        for other in others:
            other.mkdir()
        partials = [full / "label/c/0/0.123.partial", full / "checksum/c/0.4e5f.partial"]
        for partial in partials:
            partial.touch()
        assert not store.read(full).problems  # they are no results, and no damage
        open_store(full).close()
        assert not any(left.exists() for left in (orphan, *partials))
        assert all(other.exists() for other in others)

    def test_one_bit(self, full):
        """Of any file of any array, data or metadata."""
        for file in turned_bits(full, 25):
            assert store.read(full).problems, file
        assert not store.read(full).problems


WRITER = """
    import sys
    import numpy as np
    from jaxmpc.store import BlockWriter, Constant, Field, Store
    count, chunk = 16_000, 1000
    points = np.arange(2.0 * count).reshape(count, 2)
    fields = {"label": Field((), "int8", 0, ()), "plan": Field((3,), "float64", np.nan, ("time",))}
    axes = {"sample": Constant(np.arange(count), ("sample",))}
    constants = {"points": Constant(points, ("sample", "coordinate"))}
    kept = Store(sys.argv[1], axes, fields, {}, chunk, constants=constants)
    print("open", flush=True)
    with BlockWriter(kept) as writer:
        for block in kept.pending():
            for part in kept.parts(block, 300):
                x = points[part, 0]
                label = np.ones(len(x), np.int8)
                writer.put(block, part, label=label, plan=np.stack([x, x, x], axis=1))
"""


@pytest.mark.parametrize("kills", [2, pytest.param(50, marks=pytest.mark.slow)])
@pytest.mark.slow
def test_killed_writer_loses_no_committed_block(tmp_path, kills):
    path = tmp_path / "sweep.zarr"
    command = [sys.executable, "-c", textwrap.dedent(WRITER), str(path)]
    random = np.random.default_rng(0)
    for _ in range(kills):
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as writer:
            assert writer.stdout is not None
            assert writer.stdout.readline() == "open\n"
            time.sleep(random.uniform(0, 0.05))
            writer.send_signal(signal.SIGKILL)
        found = store.read(path)
        assert not found.problems
        sums = np.asarray(zarr.open_group(path, mode="r")["checksum"])
        done = np.repeat(sums != 0, 1000)
        assert np.all(found.arrays["label"][done] == 1)
        np.testing.assert_array_equal(found.arrays["plan"][done, 2], found.points[done, 0])
        if found.done == found.blocks:
            shutil.rmtree(path)
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    found = store.read(path)
    assert found.done == found.blocks == 16 and not found.problems
    np.testing.assert_array_equal(found.arrays["plan"][:, 2], found.points[:, 0])
