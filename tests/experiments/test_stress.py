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

FILE = Path(__file__).parents[2] / "experiments" / "stress.py"
spec = importlib.util.spec_from_file_location("stress", FILE)
stress = importlib.util.module_from_spec(spec)
sys.modules["stress"] = stress  # dataclasses look themselves up there
spec.loader.exec_module(stress)

# Driven from the host: their programs are not to be had from outside.
HOST = ("solve_many", "simulate_many", "map_feasible_set")
# Traced in the fast tests, for it has most of such calls; the others are made of the same parts.
FAST = ("solve_qp, own matrices",)


def spread_calls(text: str) -> list[str]:
    """The LAPACK calls of a lowered program that old jaxlibs spread over the thread pool: those
    that take several matrices, unless that is little work. Eigenvectors are much for any."""
    found = []
    for line in text.splitlines():
        if "@lapack_" not in line:
            continue
        given = line.split(" : (")[1].split(") -> ")[0]
        shapes = [
            [int(size) for size in shape.split("x")[:-1]]
            for shape in re.findall(r"tensor<([^>]+)>", given)
        ]
        batches = [shape for shape in shapes if len(shape) > 2]
        many = max((shape[0] for shape in batches), default=1)
        work = many * shapes[0][-1] ** 2 * max(max(shape[-2:]) for shape in shapes if shape)
        if many > 1 and ("syev" in line or work > linalg.TOGETHER):
            found.append(line.strip())
    return found


@pytest.mark.long
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[] if name in FAST else [pytest.mark.slow])
        for name in stress.programs()
        if name not in HOST
    ],
)
def test_no_spread_lapack_call(name, monkeypatch):
    """Where such calls wait for each other, no program of the package may hold one."""
    monkeypatch.setattr(linalg, "WAITS", True)
    jax.clear_caches()
    call = stress.programs()[name](100)
    assert isinstance(call, partial)
    text = call.func.lower(*call.args).as_text()
    assert spread_calls(text) == []


def test_spread_calls_are_seen():
    """The search above finds what it looks for."""
    cholesky = jax.jit(jax.vmap(jax.numpy.linalg.cholesky))
    lowered = lambda *shape: cholesky.lower(jax.ShapeDtypeStruct(shape, "float32")).as_text()
    assert len(spread_calls(lowered(100, 20, 20))) == 1
    assert spread_calls(lowered(10, 20, 20)) == []
    eigh = jax.jit(jax.vmap(lambda K: jax.numpy.linalg.eigh(K)))
    text = eigh.lower(jax.ShapeDtypeStruct((2, 3, 3), "float32")).as_text()
    assert len(spread_calls(text)) == 1


@pytest.mark.slow
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
