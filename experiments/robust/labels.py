"""2²⁰ labels of the double integrator under disturbances, with proofs, by three policies.

    python experiments/robust/labels.py

Prints the area of each feasible set beside that of any causal policy (35.7903, by dynamic
programming), the rays and seconds that its hull takes, and the time of 2²⁰ labels after that.
"""

import time
from dataclasses import replace

import numpy as np

import jaxmpc as jm
from jaxmpc.feasible.policy_hull import policy_hull
from jaxmpc.feasible.policy_problem import problem_of

COUNT = 2**20


def main() -> None:
    """Print one line a policy."""
    system = jm.LinearSystem([[1, 1], [0, 1]], [0.5, 1])
    states, inputs = jm.Box([-5.0, -2.0], [5.0, 2.0]), jm.Box(-1.0, 1.0)
    W = jm.Box([-0.2, -0.2], [0.2, 0.2])
    K = jm.lqr(system, np.eye(2), [[0.1]]).K
    last = jm.maximal_invariant_set(system, K, states, inputs.spread(1), disturbance=W)
    exact = last
    for _ in range(5):
        exact = jm.sets.predecessor(system, exact, states, inputs.spread(1), W)
    area = exact.volume()
    print(f"any causal policy: area {area:.5f}")
    base = jm.MPC(system, np.eye(2), 0.1, 5, states, inputs, terminal_set=last, disturbance=W)
    rng = np.random.default_rng(0)
    for policy in ("tightened", "tube", "affine"):
        problem, text = problem_of(replace(base, policy=policy)), ""
        try:
            if policy != "tightened":
                began = time.perf_counter()
                hull = policy_hull(problem)
                rays = len(hull.bounds.points)
                took = time.perf_counter() - began
                text = f"{rays} proved triples, gap {hull.gap:.0e}, {took:.2f} s; "
            times = []
            for _ in range(4):
                points = rng.uniform([-5, -2], [5, 2], (COUNT, 2))
                began = time.perf_counter()
                found = jm.map_feasible_set(problem, points)
                times.append(time.perf_counter() - began)
            low, high = found.refine().volume_bounds()
        except ValueError as error:
            print(f"{policy}: {error}")
            continue
        each = min(times[1:]) / COUNT * 1e9
        print(
            f"{policy}: area {low:.5f} to {high:.5f}, {low / area:.5f} of it; {text}2^20 labels "
            f"{each:.0f} ns a state (first call {times[0]:.1f} s with compiling and rays), "
            f"{found.counts()['undecided']} undecided"
        )


if __name__ == "__main__":
    main()
