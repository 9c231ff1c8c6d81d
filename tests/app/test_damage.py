"""Damaged and forged results: `jaxmpc verify` names each, without a traceback, time or memory."""

import json
import os
import resource
import shutil
import time
from importlib import resources

import numpy as np
import pytest
import zarr

from jaxmpc.app import cli
from jaxmpc.files import fingerprint, read_arrays, write_arrays
from jaxmpc.store.reading import checksum, determining, digest_of, regions, store_fingerprint

SECONDS, BYTES = 30.0, 2**30


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    """A refined sweep of 8 × 8 states."""
    path = tmp_path_factory.mktemp("sweep") / "out"
    assert cli.main(["sweep", "--grid", "8", "8", "--horizon", "6", "--output", str(path)]) == 0
    return path


@pytest.fixture
def report(capsys):
    """Verify a folder that must not pass, and return what is said."""

    def run(folder):
        capsys.readouterr()
        begun, before = time.process_time(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        code = cli.main(["verify", str(folder)])
        out, err = capsys.readouterr()
        text = out + err
        after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        assert code in (1, 2), text
        assert "Traceback" not in text and len(max(text.splitlines(), key=len)) < 1500
        assert time.process_time() - begun < SECONDS and 1024 * (after - before) < BYTES
        lines = [line for line in text.splitlines() if line.strip()]
        assert len(lines) == 1 or "FAILS: " in text, text
        return text

    return run


def damages(folder, count, seed):
    """Damage one file of a folder at a time, of each kind in turn; yield what was done, and make
    the file whole again."""
    random = np.random.default_rng(seed)
    files = sorted(v for v in folder.rglob("*") if v.is_file() and v.suffix != ".png")
    byte = lambda content: int(random.integers(len(content)))

    def flip(content):
        content[byte(content)] ^= 1 << int(random.integers(8))

    def replace(content):
        """By another byte; one white space for another changes nothing in JSON."""
        at = byte(content)
        spaces = b" \n\t\r"
        content[at] = next(
            v
            for v in random.permutation(256).tolist()
            if v != content[at] and not (v in spaces and content[at] in spaces)
        )

    def truncate(content):
        del content[byte(content) :]

    def append(content):
        content.extend(random.bytes(int(random.integers(1, 50))) + b"?")

    def empty(content):
        content.clear()

    def zeros(content):
        at = byte(content)
        content[at : at + 8] = bytes(len(content[at : at + 8]))
        content.extend(b"\0")

    def garble(content):
        content[:] = random.bytes(len(content))

    kinds = [flip, replace, truncate, append, empty, zeros, garble, None]
    for k in range(count):
        file, kind = files[random.integers(len(files))], kinds[k % len(kinds)]
        good = file.read_bytes()
        bad = bytearray(good)
        if kind is None:
            file.unlink()
        else:
            kind(bad)
            file.write_bytes(bad)
        yield f"{kind and kind.__name__} {file.relative_to(folder)}"
        file.write_bytes(good)


@pytest.mark.long
@pytest.mark.parametrize(
    ("count", "seed"), [(40, 0), pytest.param(1000, 1, marks=pytest.mark.slow)]
)
def test_random_damage(sound, report, count, seed):
    worst = 0.0
    for done in damages(sound, count, seed):
        begun = time.monotonic()
        try:
            report(sound)
        except AssertionError as error:
            raise AssertionError(done) from error
        worst = max(worst, time.monotonic() - begun)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"{count} damages: {worst:.2f} s at most, process {peak:.0f} MB")
    assert cli.main(["verify", str(sound)]) == 0


def edited(folder, change, sign=False):
    """Change the metadata of the group; sign: with hashes to match, as a forger would."""
    (there,) = folder.glob("*.zarr")
    file = there / "zarr.json"
    root = json.loads(file.read_text())
    change(root)
    if sign:
        known, names = root["attributes"], root["attributes"]["variables"]
        group = zarr.open_group(there, mode="r", use_consolidated=False)
        data = {k: np.asarray(group[k][...]) for k in [*names["axes"], *names["constants"]]}
        known["fingerprint"] = store_fingerprint(determining(known), data)
        known["digest"] = digest_of(known)
    file.write_text(json.dumps(root))


def described(name, change):
    """Return a change of the metadata of a variable, in the group's and in its own file."""

    def both(folder):
        file = folder / "sweep.zarr" / name / "zarr.json"
        one = json.loads(file.read_text())
        change(one)
        file.write_text(json.dumps(one))
        place = lambda root: root["consolidated_metadata"]["metadata"].__setitem__(name, one)
        edited(folder, place)

    return both


def shape(name, at, size, chunk=False):
    """Return the change of one length of a variable, and of its chunks."""

    def change(one):
        one["shape"][at] = size
        if chunk:
            one["chunk_grid"]["configuration"]["chunk_shape"][at] = size

    return described(name, change)


def summary(**changes):
    """Return the change of keys of the summary, with a hash to match."""

    def change(folder):
        file = folder / "summary.json"
        document = json.loads(file.read_text())
        for name, value in changes.items():
            part = document.get(name)
            document[name] = part | value if isinstance(value, dict) else value
        document.pop("digest")
        file.write_text(json.dumps(document | {"digest": fingerprint(document)}))

    return change


def attributes(*keys, value, sign=True):
    """Return the change of one value among the attributes."""

    def change(root):
        part = root["attributes"]
        for key in keys[:-1]:
            part = part[key]
        part[keys[-1]] = value

    return lambda folder: edited(folder, change, sign)


def variable(name, change):
    """Return the change of the data of a variable, with checksums to match."""

    def apply(folder):
        group = zarr.open_group(folder / "sweep.zarr", mode="r+", use_consolidated=False)
        values = np.asarray(group[name][...])
        change(values)
        group[name][...] = values
        names = group.attrs["variables"]
        if name in names["fields"]:
            for k, part in enumerate(regions((8, 8), names["block"])):
                rows = {v: np.asarray(group[v][part]) for v in names["fields"]}
                group["checksum"][k] = checksum(rows)

    return apply


def longer_plans(folder):
    """A horizon of 10⁹ in the problem, the configuration and the metadata of plans."""
    shape("plan", 2, 10**9, chunk=True)(folder)

    def change(root):
        root["attributes"]["problem"]["horizon"] = 10**9
        root["attributes"]["config"]["mpc"]["horizon"] = 10**9

    edited(folder, change, sign=True)


def long_config(folder):
    def change(root):
        known = root["attributes"]
        known["config"]["mpc"]["horizon"] = known["problem"]["horizon"] = 1_000_000
        known["problem"]["moves"] = list(range(1_000_000))

    shape("plan", 2, 1_000_000, chunk=True)(folder)
    edited(folder, change, sign=True)


def replaced(name, content):
    return lambda folder: (folder / name).write_text(content)


def pipe(name):
    def change(folder):
        (folder / name).unlink()
        os.mkfifo(folder / name)

    return change


def set_to(index, value):
    return lambda values: values.__setitem__(index, value)


HUGE = 10**12
ROOT = "sweep.zarr/zarr.json"
FORGERIES = {
    "horizon": (attributes("problem", "horizon", value=10**9, sign=False), "attributes"),
    "horizon, signed": (attributes("problem", "horizon", value=10**9), "problem: its"),
    "horizon of all": (longer_plans, "problem: its"),
    "horizon with moves": (long_config, "needs 64 TB of memory"),
    "horizon that is text": (attributes("problem", "horizon", value="6"), "problem: its"),
    "horizon and plans that fit": (attributes("config", "mpc", "horizon", value=7), "horizon"),
    "a limit of the problem": (
        attributes("problem", "rows", 0, "upper", value=[9.0]),
        "problem.rows",
    ),
    "a limit of the configuration": (
        attributes("config", "limits", "u_max", value=[2.5]),
        "problem.rows",
    ),
    "a huge number": (attributes("config", "system", "dt", value=1e308), "its configuration is"),
    "a configuration that is none": (attributes("config", "cost", "Q", value=-1), "cost.Q"),
    "no configuration": (attributes("config", value=None), "no configuration"),
    "an unknown key": (attributes("config", "colour", value="red"), "unknown key 'colour'"),
    "a grid of others": (attributes("config", "sweep", "lower", value=[-9.0, -9.0]), "the points"),
    "A": (attributes("problem", "A", value=[[1.0, 0.01], [0.0, 1.5]]), "problem.A"),
    "A of text": (attributes("problem", "A", value=[["1", "0"], ["x", "1"]]), "problem"),
    "A of another shape": (attributes("problem", "A", value=[[1.0]]), "problem: its"),
    "moves": (attributes("problem", "moves", value=[0] * 6), "problem.moves"),
    "moves beyond": (attributes("problem", "moves", value=[0, 1, 2, 3, 4, 10**9]), "problem: its"),
    "steps": (attributes("problem", "rows", 0, "steps", value=[10**9]), "problem: its"),
    "axes": (attributes("problem", "axes", value=[1, 0]), "problem.axes"),
    "axes twice": (attributes("problem", "axes", value=[0, 0]), "problem: its"),
    "no problem": (attributes("problem", value=7), "no problem"),
    "block": (attributes("variables", "block", value=[1, 1]), "where axes and problem say"),
    "blocks of nothing": (attributes("variables", "block", value=[0, 8]), "attributes"),
    "blocks of one axis": (attributes("variables", "block", value=[8]), "attributes"),
    "fields": (attributes("variables", "fields", value=["label"], sign=False), "attributes"),
    "fields, signed": (attributes("variables", "fields", value=["label", "status"]), "data are"),
    "a field elsewhere": (attributes("variables", "fields", value=["../x"], sign=False), "attrib"),
    "a field that is none": (attributes("variables", "fields", value=[["label"]], sign=False), ""),
    "versions": (attributes("versions", value={}, sign=False), "attributes"),
    "the fingerprint": (attributes("fingerprint", value="0" * 32, sign=False), "attributes"),
    "no fingerprint": (
        lambda folder: edited(folder, lambda root: root["attributes"].pop("fingerprint")),
        "zarr",
    ),
    "a long axis": (shape("q", 0, HUGE), "blocks"),
    "a long axis in one block": (shape("q", 0, HUGE, chunk=True), "blocks"),
    "long plans": (shape("plan", 2, HUGE, chunk=True), "plan: shape"),
    "many labels": (shape("label", 0, HUGE), "label: shape"),
    "many checksums": (shape("checksum", 0, HUGE), "checksum: shape"),
    "many bounds": (shape("bound_normal", 0, HUGE), "files hold"),
    "a negative shape": (shape("label", 0, -8), "label"),
    "a type of objects": (described("plan", lambda v: v.update(data_type="O")), "plan"),
    "complex plans": (described("plan", lambda v: v.update(data_type="complex128")), "plan"),
    "other codecs": (described("plan", lambda v: v["codecs"].insert(1, {"name": "gzip"})), "plan"),
    "no codecs": (described("plan", lambda v: v.update(codecs=[])), "plan"),
    "no data of plans": (described("plan", lambda v: v.pop("chunk_grid")), "plan"),
    "deep metadata": (replaced(ROOT, "[" * 100_000), "metadata cannot be read"),
    "long metadata": (replaced(ROOT, " " * 2**25), "are more than the"),
    "metadata of a list": (replaced(ROOT, "[]"), "metadata cannot be read"),
    "bytes of no text": (
        lambda folder: (folder / "sweep.zarr/label/zarr.json").write_bytes(b"\xff\xfe" * 9),
        "label",
    ),
    "a pipe": (pipe("sweep.zarr/plan/c/0/0/0/0"), "is no file"),
    "labels": (variable("label", set_to((slice(0, 4), 3), 1)), "FAILS: state"),
    "a label of no meaning": (variable("label", set_to((0, 0), 7)), "means nothing"),
    "plans that are not finite": (variable("plan", set_to(slice(None), np.inf)), "FAILS: state"),
    "huge plans": (variable("plan", set_to(slice(None), 1e308)), "FAILS: state"),
    "half-spaces": (variable("cut_normal", set_to(slice(None), np.nan)), "FAILS: "),
    "an axis of others": (variable("q", set_to(0, -1.7)), "axes or constants"),
    "bounds": (variable("bound_offset", set_to(0, 0.0)), "bound_offset: data are"),
    "counts": (summary(counts={"feasible": 64, "infeasible": 0}), "summary.json: counts 64"),
    "counts that are none": (summary(counts="many"), "summary.json: cannot be read"),
    "counts of undecided states": (summary(counts={"undecided": 3}), "summary.json: counts"),
    "another configuration": (summary(config={"name": "other"}), "its configuration is not that"),
    "a summary of nothing": (replaced("summary.json", "[]"), "summary.json"),
    "a summary of infinity": (summary(counts={"feasible": 1e999}), "summary.json"),
    "a deep summary": (replaced("summary.json", "[" * 100_000), "summary.json"),
    "no summary": (lambda folder: (folder / "summary.json").unlink(), "summary.json: is missing"),
}


@pytest.mark.parametrize("name", FORGERIES)
def test_forgery(sound, tmp_path, report, name):
    change, said = FORGERIES[name]
    shutil.copytree(sound, tmp_path / "out")
    change(tmp_path / "out")
    assert said in report(tmp_path / "out")


@pytest.mark.slow
def test_forged_maps_of_a_robot(tmp_path, report, capsys):
    """The problem is built again from the robot; where its file is gone, that is said."""
    model = tmp_path / "mine.xml"
    model.write_text((resources.files("jaxmpc.robots") / "models/joint.xml").read_text())
    line = f"sweep --robot {model} --grid 4 4 --seconds 0.02 --horizon 4 --output"
    sound = tmp_path / "out"
    assert cli.main([*line.split(), str(sound)]) == 0
    assert cli.main(["verify", str(sound)]) == 0
    for change, said in (
        (attributes("problem", "A", value=[[1.0, 0.0], [0.0, 1.0]]), "problem.A"),
        (attributes("problem", "rows", 0, "upper", value=[9.0]), "problem.rows"),
        (attributes("config", "terminal", value="box"), "problem."),
        (attributes("config", "horizon", value=10**9), "horizon"),
        (attributes("config", "lower", value=[-9.0, -9.0]), "not the points"),
        (attributes("config", "axes", value=["nothing", "here"]), "makes no problem"),
        (attributes("config", "fixed", value=7), "makes no problem"),
        (attributes("config", "robot", value="quadrotor"), "makes no problem"),
        (attributes("config", "robot", value=3), "makes no problem"),
    ):
        forged = tmp_path / "forged"
        shutil.copytree(sound, forged, dirs_exist_ok=True)
        change(forged)
        assert said in report(forged)
        shutil.rmtree(forged)
    model.unlink()
    capsys.readouterr()
    assert cli.main(["verify", str(sound)]) == 0
    assert "mine.xml: is not here" in capsys.readouterr().err


@pytest.mark.slow
def test_damage_to_a_recursion_report(tmp_path, report):
    line = "recursion --horizon 4 --grid 9 9 --lower -1.5 -2 --upper 1.5 2 --output"
    path = tmp_path / "rec"
    assert cli.main([*line.split(), str(path)]) == 0
    for done in damages(path, 120, 3):
        try:
            report(path)
        except AssertionError as error:
            raise AssertionError(done) from error
    record, arrays = read_arrays(path / "recursion.npz")
    for name, value in arrays.items():
        write_arrays(path / "recursion.npz", record, **arrays | {name: value[:1]})
        report(path)
    for horizon in (3, 10**9):
        record["problem"]["horizon"] = horizon
        write_arrays(path / "recursion.npz", record, **arrays)
        report(path)
