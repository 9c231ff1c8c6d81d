"""Wall time of `recursive_feasibility` against the seconds it was given, and what it then knows.

    python experiments/recursion_time.py --seconds 3 12 60

Each call runs in a process of its own, compiles included, imports left out. The exact worst
distances and areas are those of polygons in rational arithmetic and of all critical regions:
lecture N = 1: 0.546401, 0.785245; N = 3: 0.0474342, 0.02; joint N = 4: 0.0039968, 0.0016; double
integrator N = 3: 0.737865, 49/12; joint N = 6 and 20: proved.
"""

import argparse
import multiprocessing
import time
from typing import Any

import numpy as np

import jaxmpc as jm

CASES = ("lecture 1", "lecture 3", "double integrator 3", "joint 4", "joint 6", "joint 20")


def problem(name: str) -> jm.MPC:
    """Return the problem of a case: the state limits hold at the last step too."""
    kind, N = name.rsplit(" ", 1)
    A, B, Q, R, x, u = {
        "lecture": ([[1, 1], [0, 1]], [[0.4], [1]], np.eye(2), 10.0, [1, 1], 0.25),
        "double integrator": ([[1, 1], [0, 1]], [[1], [0.5]], np.eye(2), 1.0, [5, 5], 1.0),
        "joint": ([[1, 0.01], [0, 1]], [[0], [0.2]], np.diag([50.0, 1.0]), 0.1, [1.5, 2], 2.0),
    }[kind]
    limits = jm.Box(-np.array(x, float), np.array(x, float))
    return jm.MPC(
        jm.LinearSystem(np.array(A, float), np.array(B, float)), Q, np.array([[R]]), int(N), limits,
        jm.Box(np.array([-u]), np.array([u])), Q, limits,
    )  # fmt: skip


def measure(case: tuple[str, float, bool]) -> tuple[Any, ...]:
    """Return wall seconds, verdict, worst distance, area lost and number of samples."""
    name, seconds, search = case
    mpc, examine = problem(name), jm.recursive_feasibility  # imported before the clock starts
    begun = time.perf_counter()
    report = examine(mpc, seconds=seconds, search=search)
    wall, worst = time.perf_counter() - begun, report.counterexample
    distance = np.nan if worst is None else worst.distance
    return wall, report.law.holds, distance, report.lost_by_law, len(report.loops.x0s)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, nargs="+", default=[3.0, 12.0, 60.0])
    parser.add_argument("--cases", nargs="+", default=CASES, metavar="CASE")
    seconds, names = parser.parse_args().seconds, parser.parse_args().cases
    print("| case | seconds | search | wall s | law | worst distance | area lost | samples |")
    print("|---|---:|---|---:|---|---:|---:|---:|")
    cases = [(n, s, wish) for n in names for s in seconds for wish in (True, False)]
    with multiprocessing.get_context("spawn").Pool(1, maxtasksperchild=1) as pool:
        for (name, limit, search), found in zip(cases, pool.imap(measure, cases), strict=True):
            wall, law, distance, lost, samples = found
            print(
                f"| {name} | {limit:g} | {'yes' if search else 'no'} | {wall:.1f} | {law} | "
                f"{distance:.9g} | {lost:.9g} | {samples:,} |", flush=True
            )  # fmt: skip


if __name__ == "__main__":
    main()
