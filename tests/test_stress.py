"""Programs that several batched LAPACK calls at once would bring to a stop on old jaxlibs.

`experiments/stress.py` holds the programs. What each of them compiles to is looked at, on every
JAX; a few run beside busy loops here, all of them in the slow tests.
"""

import importlib.util
import re
import sys
from functools import partial
from pathlib import Path

import jax
import pytest

from jaxmpc.qp import linalg

FILE = Path(__file__).parents[1] / "experiments" / "stress.py"
spec = importlib.util.spec_from_file_location("stress", FILE)
stress = importlib.util.module_from_spec(spec)
sys.modules["stress"] = stress  # dataclasses look themselves up there
spec.loader.exec_module(stress)

# Driven from the host: their programs are not to be had from outside.
HOST = ("solve_many", "simulate_many", "map_feasible_set")
# Of the others the few whose tracing takes long.
LONG = ("RobotController of arm2", "simulate, gradient", "plan, defaults", "plan, nested vmap")


def batched_calls(text: str) -> list[str]:
    """The LAPACK calls of a lowered program that take more than one matrix."""
    found = []
    for line in text.splitlines():
        if "@lapack_" in line:
            shape = re.search(r"\(tensor<([0-9x]+)x[a-z]", line).group(1).split("x")
            if len(shape) > 2 and shape[0] != "1":
                found.append(line.strip())
    return found


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.slow] if name in LONG else [])
        for name in stress.programs()
        if name not in HOST
    ],
)
def test_no_batched_lapack_call(name, monkeypatch):
    """Where such calls wait for each other, no program of the package may hold one."""
    monkeypatch.setattr(linalg, "WAITS", True)
    jax.clear_caches()
    call = stress.programs()[name](100)
    assert isinstance(call, partial)
    text = call.func.lower(*call.args).as_text()
    assert batched_calls(text) == []


def test_batched_calls_are_seen():
    """The search above finds what it looks for."""
    program = jax.jit(jax.vmap(jax.numpy.linalg.cholesky))
    text = program.lower(jax.ShapeDtypeStruct((100, 20, 20), "float32")).as_text()
    assert len(batched_calls(text)) == 1


@pytest.mark.timeout(600)
def test_beside_busy_loops(tmp_path):
    """A short form of the stress test."""
    rows = stress.run(
        stress.Settings(
            programs=("plan", "solve_qp, own matrices"), batches=(300,), calls=10,
            output=tmp_path / "rows.json",
        )
    )  # fmt: skip
    assert [row["calls"] for row in rows] == [10, 10]
    assert not any(row["hung"] for row in rows)


@pytest.mark.slow
@pytest.mark.timeout(36_000)
def test_everything_beside_busy_loops(tmp_path):
    """All programs, sixty calls each."""
    rows = stress.run(stress.Settings(output=tmp_path / "rows.json"))
    assert not any(row["hung"] for row in rows)
    assert all(row["calls"] == 60 for row in rows)
