"""Maps at any scale: a million states on a small machine, rows in any units, many shapes."""

import gc
import json
import resource
import subprocess
import sys

import jax
import numpy as np
import pytest

import jaxmpc as jm
from jaxmpc.batches import clear_programs


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_million_states_within_four_gigabytes(tmp_path):
    command = [sys.executable, "-m", "jaxmpc", "sweep", "--grid", "1024", "1024"]
    subprocess.run([*command, "--output", str(tmp_path / "map")], check=True, capture_output=True)
    counts = json.loads((tmp_path / "map" / "summary.json").read_text())["counts"]
    assert sum(counts.values()) == 2**20
    assert counts["feasible"] + counts["infeasible"] >= 2**20 - 100
    assert resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss < 4 * 2**20  # kB


@pytest.mark.long
def test_labels_do_not_depend_on_the_scale_of_rows():
    """Times powers of two no bit of a proof changes; times powers of ten no label."""
    random = np.random.default_rng(3)
    H = np.vstack([np.eye(2), -np.eye(2), random.normal(size=(3, 2))])
    h = np.array([5.0, 5.0, 5.0, 5.0, 2.0, 3.0, 4.0])
    system = jm.LinearSystem(random.normal(size=(2, 2)), random.normal(size=(2, 1)))
    points = random.normal(size=(64, 2)) * np.exp(random.uniform(-1, 3, (64, 1)))

    def labelled(*scales):
        states, terminal = (jm.Polytope(H * v[:, None], h * v) for v in scales)
        mpc = jm.MPC(
            system, np.eye(2), np.eye(1), 4, states=states, terminal_set=terminal,
            inputs=jm.Box([-1.0], [1.0]),
        )  # fmt: skip
        return jm.map_feasible_set(mpc, points)

    unit = labelled(np.ones(7), np.ones(7))
    assert not np.any(unit.label == 0) and len(set(unit.label)) == 2
    powers = random.integers(-300, 301, (2, 7))
    twos, tens = labelled(*np.ldexp(1.0, powers)), labelled(*10.0 ** (powers / 50).round())
    np.testing.assert_array_equal(twos.label, unit.label)
    np.testing.assert_array_equal(tens.label, unit.label)
    np.testing.assert_array_equal(twos.labels.plan, unit.labels.plan)


@pytest.mark.slow
def test_programs_of_many_shapes_are_freed():
    """No program of a map outlives `clear_programs`."""
    system = jm.LinearSystem(np.eye(1), np.eye(1))
    live = lambda: len(jax.devices()[0].client.live_executables())
    clear_programs()
    gc.collect()
    before = live()
    for horizon in (2, 3):
        mpc = jm.MPC(
            system, np.eye(1), np.eye(1), horizon, states=jm.Box([-1.0], [1.0]),
            inputs=jm.Box([-1.0], [1.0]),
        )  # fmt: skip
        jm.map_feasible_set(mpc, np.linspace(-1.2, 1.2, 8)[:, None])
    assert live() > before
    clear_programs()
    gc.collect()
    assert live() <= before
