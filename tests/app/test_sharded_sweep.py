"""jaxmpc sweep --shard: whatever the split, whoever is killed, the arrays are those of one run."""

import json
import os
import signal
import subprocess
import sys
import textwrap
import time

import numpy as np
import pytest
import xarray as xr
from command_line import run

from jaxmpc import batches, store
from jaxmpc.app import cli
from jaxmpc.feasible import stored
from jaxmpc.store.writing import Lock


@pytest.fixture(autouse=True)
def _prepared(in_empty_folder, monkeypatch):
    monkeypatch.setattr(stored, "CHUNK", 64)


LINE = "sweep --grid 40 10 --horizon 6"  # 7 blocks of up to 6 rows


def assert_same(first, second):
    xr.testing.assert_identical(xr.open_zarr(first).load(), xr.open_zarr(second).load())


def assert_same_arrays(first, second):
    """Of stores whose blocks may be of other sizes."""
    found, expected = (xr.open_zarr(v).drop_vars("checksum").load() for v in (first, second))
    xr.testing.assert_identical(found.drop_attrs(deep=False), expected.drop_attrs(deep=False))


@pytest.fixture
def whole(tmp_path, capsys):
    assert run(f"{LINE} --output whole") == 0
    capsys.readouterr()
    return tmp_path / "whole"


@pytest.mark.long
@pytest.mark.parametrize(
    ("first", "rest"),
    [(["3/9", "5/9"], ["0/2", "1/2"]), (["2/3", "0/3"], ["1/3"]), (["0/2"], ["1/2"])],
)
@pytest.mark.first(1)
def test_shards_of_any_split_make_what_one_process_makes(whole, tmp_path, capsys, first, rest):
    out = tmp_path / "out"
    for shard in first:
        assert run(f"{LINE} --output {out} --shard {shard}") == 0
        text = capsys.readouterr().out
        assert f"shard {shard} with" in text and "blocks are missing, of other shards" in text
    assert [path.name for path in out.iterdir()] == ["sweep.zarr"]
    for shard in rest:
        assert run(f"{LINE} --output {out} --shard {shard} --resume") == 0
    assert "area from" in capsys.readouterr().out
    assert {path.name for path in out.iterdir()} == {p.name for p in whole.iterdir()}
    assert_same(out / "sweep.zarr", whole / "sweep.zarr")
    summaries = [json.loads((v / "summary.json").read_text()) for v in (out, whole)]
    assert summaries[0]["counts"] == summaries[1]["counts"]
    assert summaries[0]["volume"] == summaries[1]["volume"]
    assert (out / "map.png").read_bytes() == (whole / "map.png").read_bytes()
    assert run("verify out") == 0


@pytest.mark.long
def test_shards_have_smaller_blocks_of_the_same_parts(tmp_path, monkeypatch, capsys):
    """So that each has some to do; one process goes on with them as they are."""
    monkeypatch.setattr(batches, "CHUNK", 30)
    monkeypatch.setattr(stored, "CHUNK", 30)
    assert run("sweep --grid 100 10 --horizon 6 --output whole") == 0
    assert run("sweep --grid 100 10 --horizon 6 --output out --shard 2/3") == 0
    assert "shard 2/3 with 11 of 34 blocks" in capsys.readouterr().out
    assert run("sweep --grid 100 10 --horizon 6 --output out --resume") == 0
    assert len(xr.open_zarr("whole/sweep.zarr")["checksum"]) == 9
    assert len(xr.open_zarr("out/sweep.zarr")["checksum"]) == 34
    assert_same_arrays("out/sweep.zarr", "whole/sweep.zarr")
    assert run("verify out") == run("verify whole") == 0


def test_refusals_and_resume(tmp_path, monkeypatch, capsys):
    assert run(f"{LINE} --output out --shard 1/2") == 0
    capsys.readouterr()
    for line, answer in (
        (f"{LINE} --shard 1/2", "holds 3 blocks of shard 1/2. Add --resume"),
        (f"{LINE} --shard 0/2 --overwrite", "overwrite: given beside shard"),
        (f"{LINE} --shard 2/2", "--shard 2/2: shard 2 of 2. Give i/n"),
        (f"{LINE} --shard auto", "--shard auto: SLURM_ARRAY_TASK_ID, _MIN and _COUNT"),
        ("sweep --grid 40 10 --horizon 4 --shard 0/2", "mpc.horizon: 6 there, 4 here"),
        (LINE, "exists. Add --resume"),
        ("sweep --robot pendulum --shard 0/2", "--shard: given beside --robot"),
    ):
        assert run(f"{line} --output out") == 2
        err = capsys.readouterr().err
        assert answer in err and err.count("\n") == 1
    held = Lock(tmp_path / "out", file=".sweep.zarr.1-of-2.lock")
    assert run(f"{LINE} --output out --shard 1/2 --resume") == 2
    assert "another process computes shard 1/2" in capsys.readouterr().err
    held.release()
    # One process goes on with what shards have left.
    assert run(f"{LINE} --output out --resume") == 0
    assert "for 220 QPs" in capsys.readouterr().out


@pytest.mark.slow
def test_a_job_array_and_an_indexed_job(whole, tmp_path, monkeypatch):
    monkeypatch.setenv("SLURM_ARRAY_TASK_MIN", "1")
    monkeypatch.setenv("SLURM_ARRAY_TASK_COUNT", "2")
    for task in ("1", "2"):
        monkeypatch.setenv("SLURM_ARRAY_TASK_ID", task)
        assert run(f"{LINE} --output slurm --shard auto") == 0
    monkeypatch.delenv("SLURM_ARRAY_TASK_ID")
    for task in ("1", "0"):
        monkeypatch.setenv("JOB_COMPLETION_INDEX", task)
        assert run(f"{LINE} --output kubernetes --shard auto/2 --resume") == 0
    for name in ("slurm", "kubernetes"):
        assert (tmp_path / name / "map.png").exists()
        assert_same(tmp_path / name / "sweep.zarr", whole / "sweep.zarr")


@pytest.mark.long
def test_a_url(whole, tmp_path, capsys):
    fsspec = pytest.importorskip("fsspec")
    try:
        for shard in ("0/2", "1/2"):
            line = f"{LINE} --output {shard[0]} --store memory://a/b.zarr --shard {shard}"
            assert run(line) == 0
        assert "memory://a/b.zarr" in capsys.readouterr().out
        assert not (tmp_path / "0" / "summary.json").exists()
        assert {v.name for v in (tmp_path / "1").iterdir()} == {"summary.json", "map.png"}
        assert_same("memory://a/b.zarr", whole / "sweep.zarr")
        assert run(f"{LINE} --output 2 --store memory://a/b.zarr") == 2
        assert "memory://a/b.zarr: exists" in capsys.readouterr().err
        assert run(f"{LINE} --output 2 --store memory://a/b.zarr --overwrite") == 2
        assert "Delete it with the tools" in capsys.readouterr().err
        assert run("verify memory://a/b.zarr") == 0
    finally:
        fsspec.filesystem("memory").store.clear()


# A process that notes each block that it is about to write, and then takes its time.
SHARD = """
    import os, sys, time, zarr
    from jaxmpc.app import cli
    from jaxmpc.feasible import stored
    from jaxmpc.store import Store
    stored.CHUNK = 200
    commit, log = Store.commit, os.open(sys.argv[1], os.O_WRONLY | os.O_APPEND | os.O_CREAT)
    write, delay = zarr.Array.__setitem__, float(sys.argv[2])

    def noted(self, block, **rows):
        os.write(log, f"{block}\\n".encode())
        commit(self, block, **rows)

    def slow(array, where, value):
        time.sleep(delay)
        write(array, where, value)

    Store.commit, zarr.Array.__setitem__ = noted, slow
    sys.exit(cli.main(sys.argv[3:]))
"""


@pytest.mark.timeout(900)
@pytest.mark.parametrize("kills", [3, pytest.param(50, marks=pytest.mark.slow)])
@pytest.mark.slow
def test_kills_at_random_moments(tmp_path, monkeypatch, kills):
    """Two shards side by side, one of them killed at a time: no array differs, and no block is
    computed twice but those in hand."""
    monkeypatch.setattr(stored, "CHUNK", 200)  # as in SHARD
    grid, delay = ((60, 100), "0.02") if kills == 3 else ((300, 100), "0.1")
    line = f"sweep --grid {grid[0]} {grid[1]} --horizon 4 --no-refine --output".split()
    assert cli.main([*line, "whole"]) == 0
    log, random = tmp_path / "log", np.random.default_rng(kills)

    def start(i):
        command = [sys.executable, "-c", textwrap.dedent(SHARD), str(log), delay, *line, "out"]
        return subprocess.Popen(
            [*command, "--shard", f"{i}/2", "--resume"],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def opened(process):
        """Wait until the process has said what it does; its store is open then."""
        return process.stdout.readline()

    processes, killed = [start(0), start(1)], 0
    while killed < kills:
        i = int(random.integers(2))
        if random.random() < 0.8:
            opened(processes[i])
            time.sleep(random.uniform(0, 2))
        if processes[i].poll() is not None and all(p.poll() is not None for p in processes):
            # All is done: take away some blocks, as a disk might lose them.
            for name in random.choice(sorted(os.listdir(tmp_path / "out/sweep.zarr/plan/c")), 3):
                os.rename(f"out/sweep.zarr/plan/c/{name}", f"lost{killed}{name}")
        processes[i].send_signal(signal.SIGKILL)
        processes[i].communicate()
        killed += 1
        processes[i] = start(i)
    said = [process.communicate() for process in processes]
    assert [process.returncode for process in processes] == [0, 0], said
    if not (tmp_path / "out" / "summary.json").exists():  # the one to conclude was killed
        assert cli.main([*line, "out", "--shard", "0/2", "--resume"]) == 0
    assert_same_arrays("out/sweep.zarr", "whole/sweep.zarr")
    assert not store.read("out/sweep.zarr").problems
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    whole = json.loads((tmp_path / "whole" / "summary.json").read_text())
    assert summary["counts"] == whole["counts"] and summary["volume"] == whole["volume"]
    blocks = log.read_text().split()
    lost = len(list(tmp_path.glob("lost*")))
    assert len(blocks) <= len(set(blocks)) + kills + lost
    assert kills == 3 or len(blocks) > len(set(blocks)) + lost  # some were in hand
    assert [v for v in os.listdir(tmp_path / "out") if v.startswith(".")] == []
