"""A run that cannot succeed deletes nothing, and no name of a state breaks a store."""

import json
import shutil

import numpy as np
import pytest
import xarray as xr
from problems import MINIMAL_FILE

import jaxmpc as jm
from jaxmpc import store
from jaxmpc.app import cli
from jaxmpc.app.commands import recursion
from jaxmpc.feasible import pipeline, stored
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.feasible.stored import open_labels

LINE = ["sweep", "--grid", "6", "6", "--horizon", "6", "--no-refine", "--output"]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The files of a sweep."""
    path = tmp_path_factory.mktemp("sweep") / "out"
    assert cli.main([*LINE, str(path)]) == 0
    return path


@pytest.fixture
def folder(made, tmp_path):
    shutil.copytree(made, tmp_path / "out")
    return tmp_path / "out"


def contents(folder):
    return {v.relative_to(folder): v.read_bytes() for v in folder.rglob("*") if v.is_file()}


def test_a_run_that_fails_keeps_the_results(folder, monkeypatch, capsys):
    """While the problem is read, while it compiles, and in the first block."""
    before = contents(folder)

    def broken(*_, **__):
        raise MemoryError("no memory")
        yield

    for place, name, raises in (
        (pipeline, "label_parts", broken),
        (FeasibilityProblem, "of", _raises),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(place, name, raises)
            assert cli.main([*LINE, str(folder), "--overwrite"]) == 2
        assert contents(folder) == before
    assert cli.main([*LINE, str(folder), "--overwrite", "--lower", "5", "5"]) == 2
    assert contents(folder) == before
    assert "jaxmpc: error" in capsys.readouterr().err


def _raises(*_, **__):
    raise ValueError("no problem")


def test_a_run_that_is_stopped_after_a_block_keeps_that(folder, monkeypatch):
    monkeypatch.setattr(stored, "CHUNK", 12)
    real = pipeline.label_parts

    def one_block(*arguments, **settings):
        yield next(iter(real(*arguments, **settings)))
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(pipeline, "label_parts", one_block)
        assert cli.main([*LINE, str(folder), "--overwrite", "--upper", "1", "1"]) == 130
    found = store.read(folder / "sweep.zarr")
    assert found.done == 1 and found.blocks == 3 and not found.problems
    assert found.attributes["config"]["sweep"]["upper"] == [1, 1]
    assert [v.name for v in folder.iterdir()] == ["sweep.zarr"]
    assert cli.main([*LINE, str(folder), "--resume", "--upper", "1", "1"]) == 0
    assert cli.main(["verify", str(folder)]) == 0


def test_overwrite_of_damaged_results(folder):
    (folder / "sweep.zarr" / "zarr.json").write_text("{")
    assert cli.main([*LINE, str(folder), "--overwrite"]) == 0
    assert cli.main(["verify", str(folder)]) == 0
    names = {v.name for v in folder.iterdir()}
    assert names == {"sweep.zarr", "map.png", "summary.json"}


def test_a_linked_store_is_not_deleted(folder, tmp_path, capsys):
    shutil.move(folder / "sweep.zarr", tmp_path / "scratch.zarr")
    (folder / "sweep.zarr").symlink_to(tmp_path / "scratch.zarr")
    before = contents(tmp_path)
    assert cli.main([*LINE, str(folder), "--overwrite"]) == 2
    assert "is a link to" in capsys.readouterr().err
    assert contents(tmp_path) == before
    with pytest.raises(ValueError, match="is a link to"):
        store.remove(folder / "sweep.zarr")
    assert cli.main([*LINE, str(folder), "--resume"]) == 0
    shutil.rmtree(tmp_path / "scratch.zarr")
    assert cli.main([*LINE, str(folder), "--overwrite"]) == 2
    assert "is a link to" in capsys.readouterr().err


@pytest.mark.parametrize("where", ["sweep.zarr", "sweep.zarr/plan", "sweep.zarr/new/one"])
def test_nothing_is_written_into_a_store(folder, where, capsys):
    before = contents(folder)
    assert cli.main([*LINE, str(folder / where)]) == 2
    assert "lies in the store" in capsys.readouterr().err
    assert contents(folder) == before


@pytest.mark.parametrize("where", ["new/results.txt", "plan/notes.txt", "new/c/thesis.txt"])
def test_a_store_with_files_of_others_is_not_deleted(folder, where, capsys):
    other = folder / "sweep.zarr" / where
    other.parent.mkdir(parents=True, exist_ok=True)
    other.write_text("mine")
    before = contents(folder)
    assert cli.main([*LINE, str(folder), "--overwrite"]) == 2
    assert f"holds {where}, which is of no store" in capsys.readouterr().err
    assert contents(folder) == before


def test_resume_with_other_options_deletes_nothing(folder):
    before = contents(folder)
    assert cli.main([*LINE, str(folder), "--resume", "--horizon", "5"]) == 2
    assert contents(folder) == before


def test_recursion_keeps_its_files_until_it_has_others(tmp_path, monkeypatch):
    for name in recursion.FILES:
        (tmp_path / name).write_text("old")
    monkeypatch.setattr(recursion, "recursive_feasibility", _raises)
    line = ["recursion", "--overwrite", "--output", str(tmp_path)]
    assert cli.main(line) == 2
    assert all((tmp_path / name).read_text() == "old" for name in recursion.FILES)


NAMES = (
    "zarr.json",
    "ZARR.JSON",
    ".zgroup",
    "..",
    ".",
    "a/b",
    "/",
    "",
    "__init",
    "c",
    "label",
    "Plan",
    "x.partial",
    "checksum",
    "time",
    "q" * 300,
    "角" * 60,
    "a\\b",
    "q?",
    "-",
    "bound_point",
)


@pytest.mark.parametrize("names", list(zip(NAMES[::2], [*NAMES[1::2], "v"], strict=True)))
def test_names_of_states_do_not_break_a_store(tmp_path, names):
    system = jm.LinearSystem(
        np.eye(2), np.array([[0.1], [0.2]]), state_names=names, input_names=("u",)
    )
    box = jm.Box([-1.0, -1.0], [1.0, 1.0])
    mpc = jm.MPC(system, np.eye(2), np.eye(1), 2, states=box, inputs=jm.Box([-1.0], [1.0]))
    problem, along = FeasibilityProblem.of(mpc), [np.linspace(-1, 1, 3), np.linspace(-1, 1, 4)]
    path = tmp_path / "sweep.zarr"
    for _ in range(2):  # new, and once more
        with open_labels(path, problem, along, {}, 12) as kept:
            for block in kept.pending():
                kept.commit(
                    block,
                    label=np.ones(12),
                    status=np.ones(12),
                    start=np.ones((12, 2)),
                    plan=np.ones((12, 2, 1)),
                    cut_normal=np.ones((12, 2)),
                    cut_offset=np.ones(12),
                )
    found = store.read(path)
    assert found.whole and not found.problems and found.done == 1
    assert found.attributes["problem"]["horizon"] == 2
    with xr.open_zarr(path) as data:
        assert data["label"].shape == (3, 4)
        axes = [data[name].attrs["long_name"] for name in data["label"].dims]
        assert axes == list(problem.axis_names)
    assert [v.name for v in tmp_path.iterdir()] == ["sweep.zarr"]


@pytest.mark.parametrize("name", ["..", "zarr.json", "a/b"])
@pytest.mark.first(1)
def test_a_sweep_of_such_a_state(tmp_path, name):
    path = tmp_path / "case.toml"
    path.write_text("name = 'case'" + MINIMAL_FILE.replace('"p"', json.dumps(name)))
    line = ["sweep", "--config", str(path), "--grid", "4", "4", "--no-refine", "--output"]
    assert cli.main([*line, str(tmp_path / "out")]) == 0
    assert cli.main(["verify", str(tmp_path / "out")]) == 0
