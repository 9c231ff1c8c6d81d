"""Several processes write one store, each its blocks, beside each other."""

import gc
import os
import warnings

import pytest
import xarray as xr
import zarr
from test_store import AXES, CONFIG, FIELDS, array_files, bounds, rows

from jaxmpc import files, store
from jaxmpc.app.options.shared import chosen_shard
from jaxmpc.store import Store
from jaxmpc.store.reading import zarr_place
from jaxmpc.store.writing import Lock


def open_shard(path, shard=None, config=CONFIG):
    """Open the store of 3 blocks, of 8, 8 and 4 samples."""
    return Store(path, AXES, FIELDS, config, 8, shard=shard)


def fill(kept):
    for block in kept.pending():
        kept.commit(block, **rows(len(kept.samples(block)), 1 - 2 * (block % 2)))


@pytest.fixture
def path(tmp_path):
    return tmp_path / "sweep.zarr"


class TestBlocks:
    @pytest.mark.parametrize("n", [1, 2, 3, 5])
    def test_belong_to_one_shard_each(self, path, n):
        found = []
        for i in range(n):
            with open_shard(path, (i, n)) as kept:
                assert kept.pending() == list(kept.own)
                found += kept.own
                fill(kept)
        assert sorted(found) == [0, 1, 2]
        whole = path.with_name("whole.zarr")
        with open_shard(whole) as kept:
            fill(kept)
        xr.testing.assert_identical(xr.open_zarr(path).load(), xr.open_zarr(whole).load())

    @pytest.mark.parametrize("shard", [(2, 2), (-1, 2), (0, 0)])
    def test_no_such_shard(self, path, shard):
        with pytest.raises(ValueError, match="shard: (.* from 0 to n - 1|-1. Give a whole)"):
            open_shard(path, shard)
        assert not path.exists()


class TestLocks:
    def test_of_a_shard_of_all_and_of_the_end(self, path):
        with open_shard(path, (0, 2)) as first, open_shard(path, (1, 2)):
            with pytest.raises(ValueError, match=r"another process computes shard 0/2\. Wait"):
                open_shard(path, (0, 2))
            with pytest.raises(ValueError, match="another process writes there"):
                open_shard(path)
            with pytest.raises(ValueError, match="another process writes there"):
                store.remove(path)
            fill(first)
        with open_shard(path), pytest.raises(ValueError, match="another process writes there"):
            open_shard(path, (1, 2))
        with open_shard(path, (0, 2)) as first, open_shard(path, (1, 2)) as second:
            assert first.unfinished() == "1 of 3 blocks are missing, of other shards"
            fill(second)
            assert second.unfinished() == ""
            assert "another process concludes" in first.unfinished()
        assert [v.name for v in path.parent.iterdir()] == ["sweep.zarr"]
        with open_shard(path, (0, 2)) as first:
            assert first.unfinished() == ""

    def test_a_lock_file_that_its_holder_removed(self, path, monkeypatch):
        """It is made again: a lock of a file without a name locks out nobody."""
        first = Lock(path.parent, file=".lock")
        opened, open_ = [], os.open

        def late(*arguments):
            opened.append(open_(*arguments))
            if len(opened) == 1:
                first.release()
            return opened[-1]

        monkeypatch.setattr(os, "open", late)
        second = Lock(path.parent, file=".lock")
        assert len(opened) == 2
        with pytest.raises(ValueError, match="another process"):
            Lock(path.parent, file=".lock")
        second.release()


class TestCreation:
    def race(self, monkeypatch, path, config):
        """Let another process make the store just before this one renames its own."""
        rename = os.rename

        def late(source, target):
            monkeypatch.undo()
            open_shard(path, (1, 2), config).close()
            rename(source, target)

        monkeypatch.setattr(os, "rename", late)

    def test_the_loser_opens_the_store_of_the_winner(self, path, monkeypatch):
        self.race(monkeypatch, path, CONFIG)
        with open_shard(path, (0, 2)) as kept:
            assert kept.pending() == [0, 2]
        assert [v.name for v in path.parent.iterdir()] == ["sweep.zarr"]

    def test_of_another_configuration(self, path, monkeypatch):
        self.race(monkeypatch, path, {**CONFIG, "mpc": {"horizon": 4}})
        with pytest.raises(ValueError, match="mpc.horizon: 4 there, 3 here"):
            open_shard(path, (0, 2))
        assert [v.name for v in path.parent.iterdir()] == ["sweep.zarr"]


class TestDamage:
    def test_a_shard_leaves_alone_what_is_not_its_own(self, path):
        for i in range(2):
            with open_shard(path, (i, 2)) as kept:
                fill(kept)
        making = files.side_path(path)
        making.mkdir()
        writing = path / "label" / "c" / "0" / "0.123.partial"
        writing.touch()
        array_files(path, "checksum/c")[1].write_bytes(b"garbled")
        array_files(path, "plan/c")[2].unlink()
        with open_shard(path, (0, 2)) as kept:
            assert making.exists() and writing.exists()
            assert kept.pending() == [2] and kept.damaged == 1
            fill(kept)
            assert kept.unfinished() == "1 of 3 blocks are missing, of other shards"
        with open_shard(path, (1, 2)) as kept:
            assert kept.pending() == [1] and kept.damaged == 1
            fill(kept)
            assert kept.unfinished() == ""
        assert not making.exists() and not writing.exists()
        assert not store.read(path).problems

    def test_of_another_shard_is_found_at_the_end(self, path):
        for i in range(2):
            with open_shard(path, (i, 2)) as kept:
                fill(kept)
        array_files(path, "plan/c")[1].unlink()
        with open_shard(path, (0, 2)) as kept:
            assert kept.pending() == []
            assert kept.unfinished() == "1 of 3 blocks are missing, of other shards"

    def test_of_a_variable_needs_a_process_of_its_own(self, path):
        open_shard(path, (0, 2)).close()
        (path / "label" / "zarr.json").write_text("{")
        with pytest.raises(ValueError, match="label: missing or damaged. Stop all shards"):
            open_shard(path, (0, 2))
        with open_shard(path) as kept:
            fill(kept)
        assert not store.read(path).problems


# Of s3fs, which leaves connections to the garbage collector.
@pytest.mark.filterwarnings("ignore:Unclosed", "ignore:Exception ignored in")
class TestObjects:
    """A store at a URL: no locks, no rename, and the same blocks."""

    @pytest.fixture(params=["memory", "s3"])
    def url(self, request, monkeypatch):
        """Return the URL of a place without a store, in memory or at an S3 server of our own."""
        fsspec = pytest.importorskip("fsspec")
        if request.param == "memory":
            yield "memory://bucket/sweep.zarr"
            fsspec.filesystem("memory").store.clear()
            return
        pytest.importorskip("s3fs")
        server = pytest.importorskip("moto.server").ThreadedMotoServer("127.0.0.1", port=0)
        server.start()
        monkeypatch.setenv("AWS_ENDPOINT_URL", "http://{}:{}".format(*server.get_host_and_port()))
        for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
            monkeypatch.setenv(name, "nobody")
        fsspec.get_filesystem_class("s3").clear_instance_cache()
        files = fsspec.filesystem("s3")
        files.mkdir("bucket")
        yield "s3://bucket/sweep.zarr"
        files.rm("bucket", recursive=True)
        server.stop()
        del files
        fsspec.get_filesystem_class("s3").clear_instance_cache()
        gc.collect()

    def test_shards_resume_and_read(self, url, path):
        with open_shard(url, (0, 2)) as kept:
            fill(kept)
            with open_shard(url, (1, 2)) as other:
                assert kept.unfinished() == "1 of 3 blocks are missing, of other shards"
                fill(other)
            assert kept.unfinished() == ""
            kept.save(bounds(3))
        with open_shard(path) as kept:
            fill(kept)
            kept.save(bounds(3))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            there = xr.open_zarr(url).load()
        xr.testing.assert_identical(there, xr.open_zarr(path).load())
        found = store.read(url)
        assert found.done == found.blocks == 3 and not found.problems
        xr.testing.assert_identical(store.open_dataset(url).load(), there)

    def test_damage(self, url):
        with open_shard(url) as kept:
            fill(kept)
        group = zarr.open_group(zarr_place(url), mode="r+", use_consolidated=False)
        group["label"][0, 1] = -group["label"][0, 1]
        assert store.read(url).problems
        with open_shard(url) as kept:
            assert kept.pending() == [0] and kept.damaged == 1
            fill(kept)
        del group["plan"]
        with open_shard(url) as kept:
            assert kept.pending() == [0, 1, 2]

    def test_a_killed_creation(self, url, monkeypatch):
        write, count = Store._create_array, iter(range(4))

        def until(*arguments, **settings):
            if next(count, None) is None:
                raise KeyboardInterrupt
            write(*arguments, **settings)

        monkeypatch.setattr(Store, "_create_array", until)
        with pytest.raises(KeyboardInterrupt):
            open_shard(url)
        monkeypatch.undo()
        with pytest.raises(ValueError, match="no sweep store"):
            store.read(url)
        with pytest.raises(ValueError, match="no sweep store"):
            open_shard(url, config={**CONFIG, "mpc": {"horizon": 4}})
        with open_shard(url) as kept:
            fill(kept)
        assert not store.read(url).problems

    def test_refusals(self, url, tmp_path):
        zarr.open_group(zarr_place(url), mode="w", attributes={"mine": 1})
        with pytest.raises(ValueError, match="no sweep store"):
            open_shard(url)
        with pytest.raises(ValueError, match="Delete it with the tools of that store"):
            store.remove(url)
        with pytest.raises(ValueError, match="Install fsspec and what it needs"):
            open_shard("nosuch://bucket/sweep.zarr")
        open_shard(f"file://{tmp_path}/a.zarr").close()
        assert (tmp_path / "a.zarr").is_dir()


class TestChosenShard:
    SLURM = {f"SLURM_ARRAY_TASK_{k}": v for k, v in {
        "ID": "9", "MIN": "5", "MAX": "11", "COUNT": "4", "STEP": "2"}.items()}  # fmt: skip

    def test_by_number_and_environment(self):
        assert chosen_shard("2/7", {}) == (2, 7)
        assert chosen_shard("auto", self.SLURM) == (2, 4)
        plain = {k: v for k, v in self.SLURM.items() if k[-4:] in ("K_ID", "_MIN", "OUNT")}
        assert chosen_shard("auto", {**plain, "SLURM_ARRAY_TASK_ID": "6"}) == (1, 4)
        assert chosen_shard("auto/16", self.SLURM) == (9, 16)
        assert chosen_shard("auto/16", {"JOB_COMPLETION_INDEX": "15"}) == (15, 16)

    @pytest.mark.parametrize(
        ("text", "change", "answer"),
        [
            ("4/4", {}, "shard 4 of 4"),
            ("a/4", {}, "i/n"),
            ("3", {}, "i/n"),
            ("-1/4", {}, "i/n"),
            ("1/4/2", {}, "i/n"),
            ("auto", {}, "SLURM_ARRAY_TASK_ID, _MIN and _COUNT are not set"),
            ("auto/4", {}, "neither SLURM_ARRAY_TASK_ID nor JOB_COMPLETION_INDEX"),
            ("auto", {**SLURM, "SLURM_ARRAY_TASK_MAX": "12"}, "not evenly spaced"),
            ("auto/4", {"JOB_COMPLETION_INDEX": "4"}, "shard 4 of 4"),
        ],
    )
    def test_refusals(self, text, change, answer):
        with pytest.raises(ValueError, match=f"--shard {text}: .*{answer}"):
            chosen_shard(text, change)
