"""The store keeps every committed chunk, whatever happens to the writer."""

import signal
import subprocess
import sys
import textwrap
import time

import numpy as np
import pytest
import xarray as xr

from jaxmpc.feasible import store

POINTS = np.arange(22.0).reshape(11, 2)
CONFIG = {"mpc": {"horizon": 3}, "limits": {"x_min": ["-Infinity", 0.0]}}


def rows(count, value):
    return {
        "label": np.full(count, value, np.int8),
        "status": np.full(count, 1, np.int8),
        "start": np.full((count, 2), float(value)),
        "plan": np.full((count, 3, 1), float(value)),
        "cut_normal": np.full((count, 2), np.nan),
        "cut_offset": np.full(count, 2.0),
    }


def open_store(path, config=CONFIG, points=POINTS, chunk=4):
    return store.open_sweep(path, points, (2, 3, 1), config, chunk)


def test_chunks_resume_and_open_in_xarray(tmp_path):
    path = tmp_path / "sweep.zarr"
    group = open_store(path)
    assert store.pending(group) == [0, 1, 2]
    assert store.chunk_rows(group, 2) == slice(8, 11)
    store.commit(group, 2, **rows(3, -1))
    group = open_store(path)
    assert store.pending(group) == [0, 1]
    store.commit(group, 0, **rows(4, 1))
    data = store.open_dataset(path)
    np.testing.assert_array_equal(data["label"], [1] * 4 + [0] * 4 + [-1] * 3)
    np.testing.assert_array_equal(data["points"], POINTS)
    assert data["plan"].dims == ("sample", "time", "input")
    assert np.isnan(data["cut_offset"][4:8]).all()
    plain = xr.open_zarr(path, consolidated=False)
    assert plain["label"].dtype == np.int8
    assert plain.attrs["config"] == CONFIG
    assert {"jax", "zarr"} <= set(plain.attrs["versions"])
    assert [child.name for child in tmp_path.iterdir()] == ["sweep.zarr"]


def test_bounds_are_kept_and_replaced(tmp_path):
    path = tmp_path / "sweep.zarr"
    group = open_store(path)
    for count in (3, 5):
        store.save_bounds(group, np.ones((count, 2)), np.ones((4, 2)), np.arange(4.0))
    data = store.open_dataset(path)
    assert data["bound_point"].shape == (5, 2)
    assert data["bound_normal"].dims == ("facet", "coordinate")
    np.testing.assert_array_equal(data["bound_offset"], np.arange(4.0))


def test_another_configuration_is_refused(tmp_path):
    path = tmp_path / "sweep.zarr"
    open_store(path)
    with pytest.raises(ValueError, match="mpc.horizon: 3 there, 4 here"):
        open_store(path, config={**CONFIG, "mpc": {"horizon": 4}})
    with pytest.raises(ValueError, match="chunk: 4 there, 5 here"):
        open_store(path, chunk=5)
    with pytest.raises(ValueError, match="other points"):
        open_store(path, points=POINTS + 1)


def test_what_is_no_store_is_refused_and_kept(tmp_path):
    folder = tmp_path / "photos"
    folder.mkdir()
    (folder / "precious").touch()
    for call in (store.open_dataset, store.remove, open_store):
        with pytest.raises(ValueError, match="is no sweep store"):
            call(folder)
    assert (folder / "precious").exists()


def test_remove(tmp_path):
    path = tmp_path / "sweep.zarr"
    open_store(path)
    store.remove(path)
    assert not path.exists()


WRITER = """
    import sys
    import numpy as np
    from jaxmpc.feasible import store
    count, chunk = 64_000, 1000
    points = np.arange(2.0 * count).reshape(count, 2)
    group = store.open_sweep(sys.argv[1], points, (2, 3, 1), {}, chunk)
    print("open", flush=True)
    random = np.random.default_rng(0)
    for index in store.pending(group):
        rows = store.chunk_rows(group, index)
        x = points[rows, 0]
        store.commit(
            group, index, label=np.ones(chunk, np.int8), status=np.ones(chunk, np.int8),
            start=points[rows], plan=np.repeat(x, 3).reshape(chunk, 3, 1),
            cut_normal=points[rows], cut_offset=x,
        )
"""


@pytest.mark.slow
def test_killed_writer_loses_no_committed_chunk(tmp_path):
    path = tmp_path / "sweep.zarr"
    command = [sys.executable, "-c", textwrap.dedent(WRITER), str(path)]
    left = 64
    for delay in (0.02, 0.05):
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as writer:
            assert writer.stdout is not None
            assert writer.stdout.readline() == "open\n"
            time.sleep(delay)
            writer.send_signal(signal.SIGKILL)
        assert writer.returncode == -signal.SIGKILL
        data = store.open_dataset(path).load()
        done = np.repeat(data["done"].values, 1000) == 1
        first = data["points"].values[:, 0]
        assert np.all(data["label"].values[done] == 1)
        assert np.all(data["plan"].values[done] == first[done, None, None])
        assert np.all(data["cut_offset"].values[done] == first[done])
        assert 0 < np.count_nonzero(data["done"] == 0) <= left
        left = np.count_nonzero(data["done"] == 0)
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    data = store.open_dataset(path).load()
    assert np.all(data["done"] == 1)
    np.testing.assert_array_equal(data["plan"][:, 2, 0], data["points"][:, 0])
