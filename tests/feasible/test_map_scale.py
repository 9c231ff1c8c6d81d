"""A million states on a small machine."""

import json
import resource
import subprocess
import sys

import pytest


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_million_states_within_four_gigabytes(tmp_path):
    command = [sys.executable, "-m", "jaxmpc", "sweep", "--grid", "1024", "1024"]
    subprocess.run([*command, "--output", str(tmp_path / "map")], check=True, capture_output=True)
    counts = json.loads((tmp_path / "map" / "summary.json").read_text())["counts"]
    assert sum(counts.values()) == 2**20
    assert counts["feasible"] + counts["infeasible"] >= 2**20 - 100
    assert resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss < 4 * 2**20  # kB
