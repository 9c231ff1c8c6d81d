"""Files of runs are written whole or not at all, and tell to which run they belong."""

import json

import numpy as np
import pytest

from jaxmpc import files


def test_a_fingerprint_sees_data_shapes_types_and_structure():
    x = np.arange(6.0)
    known = [
        files.fingerprint({"a": 1}, x),
        files.fingerprint({"a": 2}, x),
        files.fingerprint({"a": 1}, x.reshape(2, 3)),
        files.fingerprint({"a": 1}, x.astype(np.float32)),
        files.fingerprint({"a": 1}, {"x": x}),
        files.fingerprint({"a": 1}, x + 1),
    ]
    assert len(set(known)) == len(known)
    assert files.fingerprint({"a": 1}, x[::-1][::-1]) == known[0]


def test_differences_name_the_key_and_both_values():
    there = {"mpc": {"horizon": 3, "terminal": "box"}, "name": "a"}
    here = {"mpc": {"horizon": 4, "terminal": "box"}, "name": "a", "rows": list(range(99))}
    first, second = files.differences(there, here)
    assert first == "mpc.horizon: 3 there, 4 here"
    assert second.startswith("rows: null there, [0, 1, 2") and second.endswith("... here")
    assert files.differences(here, here) == []


def test_json_holds_arrays_and_no_infinity(tmp_path):
    path = tmp_path / "new" / "summary.json"
    files.write_json(path, {"x": np.array([1.0, np.inf]), "n": np.int64(3), 4: (np.nan, "text")})
    assert json.loads(path.read_text()) == {"x": [1.0, None], "n": 3, "4": [None, "text"]}


def test_arrays_come_back_or_nothing_does(tmp_path):
    path = tmp_path / "run.npz"
    assert files.read_arrays(path) is None
    files.write_arrays(path, {"steps": 3}, x=np.arange(3))
    plain, arrays = files.read_arrays(path)
    assert plain == {"steps": 3}
    np.testing.assert_array_equal(arrays["x"], np.arange(3))
    path.write_bytes(path.read_bytes()[:-40])
    assert files.read_arrays(path) is None


def test_a_failed_write_leaves_the_old_file_alone(tmp_path):
    path = tmp_path / "run.npz"
    files.write_arrays(path, x=np.arange(3))
    with pytest.raises(TypeError, match="not JSON serializable"):
        files.write_arrays(path, {"no JSON": object()})
    assert files.read_arrays(path)[1]["x"].tolist() == [0, 1, 2]
    assert [child.name for child in tmp_path.iterdir()] == ["run.npz"]
    files.side_path(path).touch()
    others = [files.side_path(tmp_path / "other.npz").name, ".run.npz.backup"]
    for name in others:
        (tmp_path / name).touch()
    files.remove_partial(path)
    assert {child.name for child in tmp_path.iterdir()} == {*others, "run.npz"}
    files.side_path(tmp_path / "s1").touch()
    assert not files.side_paths(tmp_path / "s[1]")  # no pattern
