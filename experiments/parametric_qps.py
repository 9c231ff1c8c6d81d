"""Critical regions beside PPOPT, on the same programs, one after the other on one machine.

    python experiments/parametric_qps.py --peer PYTHON [--seconds 120]

PYTHON: an interpreter in whose environment PPOPT is installed (`pip install ppopt`), which needs
other packages. Each solver gets the same arrays (P, q, F, G, h, S and the box of parameters).
Counted are regions, CPU seconds of the search alone (`time.process_time`, so that loading and other
work do not count), and at 1,000 random parameters how many have an optimum, and by how much the
optima differ.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

ALGORITHMS = ("graph", "geometric", "combinatorial")


def programs() -> dict:
    """Return programs by name: (ParametricQP, box of parameters)."""
    import jaxmpc as jm
    from jaxmpc.explicit import ParametricQP, parametric_qp

    double = jm.LinearSystem([[1, 1], [0, 1.0]], [0.5, 1])
    X, U = jm.Box([-5, -5], [5, 5]), jm.Box(-1, 1)
    found = {}
    for N in (3, 6, 10):
        mpc = jm.MPC(double, [1.0, 1], 0.1, N, X, U, terminal_set=X)
        found[f"double integrator, N = {N}"] = parametric_qp(mpc), X
    mpc = jm.MPC(double, [1.0, 1], 0.1, 4, X, U, terminal_set=X)
    box = jm.Box([-5, -5, -3], [5, 5, 3])
    found["the same, N = 4, with a reference"] = parametric_qp(mpc, reference=[[1.0], [0]]), box
    mpc = jm.MPC(double, [1.0, 1], 1.0, 5, X, U, terminal_set=jm.Box([0, 0], [0, 0]))
    found["the same, terminal point, N = 5"] = parametric_qp(mpc), X
    A = np.array([[0.9, 0.2, 0, 0], [-0.2, 0.9, 0.1, 0], [0, 0, 0.9, 0.2], [0.1, 0, -0.2, 0.9]])
    four = jm.LinearSystem(A, np.array([[0.0, 0], [0.5, 0], [0, 0], [0, 0.5]]))
    limits = jm.Box([-3.0] * 4, [3.0] * 4)
    mpc = jm.MPC(four, np.eye(4), np.eye(2), 2, limits, jm.Box([-1, -1], [1, 1]))
    found["four states, two inputs, N = 2"] = parametric_qp(mpc), limits
    random = np.random.default_rng(0)
    L = random.normal(size=(6, 6))
    qp = ParametricQP(L @ L.T + np.eye(6), random.normal(size=(14, 6)), random.uniform(0.5, 2, 14),
                      random.normal(size=6), random.normal(size=(6, 2)),
                      random.normal(size=(14, 2)))  # fmt: skip
    found["random, 6 variables, 14 rows"] = qp, jm.Box([-2, -2], [2, 2])
    rows = np.array([[1, 0, -1], [-1, 0, -1], [0, 1, -1], [0, -1, -1], [0.75, 0.64, -1],
                     [-0.75, -0.64, -1]])  # fmt: skip
    shift = np.array([[1, 0], [-1, 0], [0, -1], [0, 1], [1, 0], [-1, 0.0]])
    qp = ParametricQP(np.eye(3), rows, -np.ones(6), S=shift)
    found["not facet to facet"] = qp, jm.Box([-1.5, -1.5], [1.5, 1.5])
    return found


def solve_there(path: str) -> None:
    """Solve a stored program by PPOPT, in its own interpreter, and print what was found."""
    from ppopt.mp_solvers.solve_mpqp import mpqp_algorithm, solve_mpqp
    from ppopt.mpqp_program import MPQP_Program

    data = np.load(path)
    p = len(data["lower"])
    column = lambda v: np.asarray(v, float).reshape(-1, 1)
    A_t, b_t = np.vstack([np.eye(p), -np.eye(p)]), column(np.append(data["upper"], -data["lower"]))
    begun = time.process_time()
    program = MPQP_Program(
        data["G"].copy(), column(data["h"]), column(data["q"]), data["F"].copy(), data["P"].copy(),
        A_t, b_t, data["S"].copy(),
    )  # fmt: skip
    solution = solve_mpqp(program, getattr(mpqp_algorithm, str(data["algorithm"])))
    taken = time.process_time() - begun
    plans = [solution.evaluate(column(theta)) for theta in data["points"]]
    z = [None if v is None else np.ravel(v).tolist() for v in plans]
    print("FOUND" + json.dumps([len(solution.critical_regions), taken, z]))


def beside(peer: str, arrays: dict, seconds: float) -> str:
    """Return what PPOPT finds, by each algorithm, as a cell of the table."""
    cells, ours = [], arrays.pop("ours")
    for algorithm in ALGORITHMS:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "program.npz"
            np.savez(path, algorithm=algorithm, **arrays)
            try:
                done = subprocess.run([peer, __file__, "--solve", path], capture_output=True,
                                      text=True, timeout=seconds)  # fmt: skip
            except subprocess.TimeoutExpired:
                cells.append(f"{algorithm}: over {seconds:.0f} s")
                continue
        lines = [line for line in done.stdout.splitlines() if line.startswith("FOUND")]
        if not lines:
            why = done.stderr.strip().splitlines()[-1:] or ["no answer"]
            cells.append(f"{algorithm}: {why[0][:60]}")
            continue
        count, taken, z = json.loads(lines[0].removeprefix("FOUND"))
        known = np.isfinite(ours).all(axis=1)
        both = [i for i in range(len(z)) if z[i] is not None and known[i]]
        off = max((np.abs(np.array(z[i]) - ours[i]).max() for i in both), default=np.nan)
        cells.append(
            f"{algorithm}: {count}, {taken:.2f} s, optimum at {sum(v is not None for v in z)}, "
            f"differs by {off:.0e}"
        )
    return "; ".join(cells)


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--peer", default=sys.executable)
    options.add_argument("--seconds", type=float, default=120)
    options.add_argument("--solve")
    given = options.parse_args()
    if given.solve:
        solve_there(given.solve)
        return
    from jaxmpc.explicit import critical_regions
    from jaxmpc.explicit.parametric_program import in_numpy

    print("| program | jaxmpc: regions, complete, CPU time, optimum at | PPOPT |\n|---|---|---|")
    for name, (qp, box) in programs().items():
        begun = time.process_time()
        found = critical_regions(qp, box)
        taken = time.process_time() - begun
        points = np.random.default_rng(0).uniform(box.lower, box.upper, (1000, len(box.lower)))
        plans, q = found.plan(points), in_numpy(qp)
        arrays = {"P": q.P, "q": q.q, "F": q.F, "G": q.G, "h": q.h, "S": q.S, "ours": plans,
                  "lower": box.lower, "upper": box.upper, "points": points}  # fmt: skip
        known = int(np.isfinite(plans).all(axis=1).sum())
        cell = f"{len(found)}, {found.complete}, {taken:.2f} s, {known}"
        print(f"| {name} | {cell} | {beside(given.peer, arrays, given.seconds)} |", flush=True)


if __name__ == "__main__":
    main()
