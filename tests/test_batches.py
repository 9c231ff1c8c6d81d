"""Programs that are compiled ahead, once for each shape; batches that go through them in parts."""

import time
from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np

from jaxmpc.batches import Compiled, each_part, joined, side_by_side, slices, work_off


def test_threads_compile_a_program_once():
    lowered = []

    class Counted:
        def lower(self, *args):
            lowered.append(args)
            return jax.jit(lambda x: x + 1).lower(*args)

    program = Compiled(Counted())
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(program, [np.full(3, float(k)) for k in range(8)]))
    np.testing.assert_array_equal(found, np.arange(1.0, 9.0)[:, None] * np.ones(3))
    assert len(lowered) == 1 and program(np.zeros(2)).shape == (2,) and len(lowered) == 2


def test_parts_go_through_one_program_into_a_sink():
    """The last part is filled up, the sink sees none of that; a deadline ends after a part."""
    rows = {"x": np.arange(7.0), "y": np.arange(14.0).reshape(7, 2)}
    program = Compiled(jax.jit(lambda part: part["x"] + part["y"].sum(axis=1)))
    expected, found = rows["x"] + rows["y"].sum(axis=1), np.full(7, np.nan)

    def sink(part):
        assert part.size == len(part.result)
        found[part.place] = part.result

    timing = work_off(each_part(program, rows, 3), sink, 7, unit="rows")
    np.testing.assert_array_equal(found, expected)
    assert len(program.programs) == 1 and timing.count == 7
    assert timing.compile_seconds > 0 and timing.run_seconds > 0
    assert slices(7, 3) == [slice(0, 3), slice(3, 6), slice(6, 7)] and slices(0, 3) == []
    found[:] = np.nan
    parts = each_part(program, rows, 3)
    timing = work_off(parts, sink, 7, unit="rows", deadline=time.monotonic())
    np.testing.assert_array_equal(np.isnan(found), np.arange(7) >= 3)
    assert (timing.count, timing.compile_seconds) == (3, 0.0)


def test_bar_counts_rows_and_shows_notes(capsys):
    work_off(each_part(np.sin, np.ones(5), 2), lambda part: "a note", 5, unit="rows", progress=True)
    assert "5/5" in (shown := capsys.readouterr().err) and "a note" in shown and " rows" in shown
    work_off(each_part(np.sin, np.ones(5), 2), lambda part: None, 5, unit="rows")
    assert capsys.readouterr().err == ""


def test_parts_are_joined_leaf_by_leaf():
    parts = [{"each": np.arange(3.0) + i, "mean": np.full((1, 2), i)} for i in range(3)]
    found = joined(parts)
    np.testing.assert_array_equal(found["each"], np.concatenate([p["each"] for p in parts]))
    np.testing.assert_array_equal(found["mean"], [[0, 0], [1, 1], [2, 2]])


def test_threads_see_the_64_bit_mode_of_the_caller():
    import jax
    import jax.numpy as jnp

    for mode in (False, True):
        with jax.enable_x64(mode):
            kinds = side_by_side(lambda i: jnp.asarray(float(i)).dtype, range(3), 3)
        assert set(kinds) == {np.dtype("float64" if mode else "float32")}
