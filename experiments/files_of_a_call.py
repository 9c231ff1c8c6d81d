"""Count the files of jaxmpc in which functions run during a plan, a map and a sweep.

    python experiments/files_of_a_call.py

What a reader has to open to follow a call from its arguments to its result.
"""

import os
import sys
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from types import FrameType

import numpy as np

import jaxmpc as jm
from jaxmpc.app.cli import main

ROOT = str(Path(jm.__file__).parent)


def files_of(call: Callable[[], object]) -> list[str]:
    """Return the files, relative to the package, of the functions that a call runs."""
    seen = set()

    def note(frame: FrameType, event: str, _: object) -> None:
        path = frame.f_code.co_filename
        if event == "call" and path.startswith(ROOT) and frame.f_code.co_name != "<module>":
            seen.add(os.path.relpath(path, ROOT))

    threading.setprofile(note)
    sys.setprofile(note)
    try:
        call()
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    return sorted(seen)


if __name__ == "__main__":
    box = jm.Box([-1, -1], [1, 1])
    mpc, unstable = (
        jm.MPC(
            jm.LinearSystem([[a, 0.1], [0, b]], [[0.005], [0.1]], dt=0.1),
            np.eye(2), 0.1 * np.eye(1), horizon=8, states=box, inputs=jm.Box([-1], [1]),
        )
        for a, b in ((1, 1), (1.2, 1.1))
    )  # fmt: skip
    points = np.random.default_rng(0).uniform(-1, 1, (4000, 2))
    [getattr(jm, name) for name in jm.__all__]
    os.chdir(tempfile.mkdtemp())
    calls = {
        "jm.solve": lambda: jm.solve(mpc, [0.3, 0.2]),
        "jm.map_feasible_set": lambda: jm.map_feasible_set(unstable, points),
        "jaxmpc sweep": lambda: main(["sweep"]),
    }
    counted = {name: files_of(call) for name, call in calls.items()}
    for name, files in counted.items():
        print(f"{name}: {len(files)} files\n    {' '.join(files)}")
