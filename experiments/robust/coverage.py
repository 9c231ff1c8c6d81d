"""Coverage of the maximal robust control invariant set of an uncertain plant, by three controllers.

    python experiments/robust/coverage.py [loops] [steps] [ε, 0 for all]

A = [1 .15; .1 1] ± ε e₁e₁', B = [.1; 1.1] ± .1 e₂, |x| ≤ 8, |u| ≤ 4, |w| ≤ .1, N = 3 (Chen,
Preciado & Morari 2024, whose numbers for system level synthesis, a tube and a lumped disturbance
are beside ours). The set C comes from `maximal_control_invariant_set`. Affine feedback and
tightened rows take what the plant may differ by as a disturbance and end in C; the controller by
its first step covers C by construction: closed loops from random states of C, with a random vertex
of the plant and of the disturbance at each step, count what breaks.
"""

import sys
import time

import numpy as np
from jax import enable_x64

import jaxmpc as jm
from jaxmpc.feasible import feasible_polytope
from jaxmpc.mpc import first_step_in
from jaxmpc.sets import maximal_control_invariant_set

A, B = np.array([[1, 0.15], [0.1, 1]]), np.array([[0.1], [1.1]])
X, U, W = jm.Box([-8.0, -8.0], [8.0, 8.0]), jm.Box([-4.0], [4.0]), jm.Box([-0.1, -0.1], [0.1, 0.1])
PUBLISHED = {  # ε: SLS, tube, lumped
    0.05: (1, 1, 0.886), 0.10: (1, 1, 0.756), 0.15: (0.972, 0.972, 0.583), 0.20: (0.971, 0.943, 0),
    0.25: (0.969, 0.969, 0), 0.30: (0.969, 0.875, 0), 0.35: (0.968, 0.774, 0),
    0.40: (0.931, 0.724, 0), 0.45: (0.964, 0.464, 0),
}  # fmt: skip


def vertices(eps: float) -> list[jm.LinearSystem]:
    """Return the four vertices of the plant."""
    return [
        jm.LinearSystem(A + s * eps * np.diag([1.0, 0.0]), B + t * np.array([[0.0], [0.1]]))
        for s in (-1, 1)
        for t in (-1, 1)
    ]


def share(policy: str, eps: float, C: jm.Polytope) -> float:
    """Return the share of C from which a policy for the lumped disturbance is feasible."""
    reach = np.array([0.1 + 8 * eps, 0.1 + 0.1 * 4])
    nominal = jm.LinearSystem(A, B)
    mpc = jm.MPC(
        nominal, np.eye(2), np.eye(1), 3, X, U, terminal_set=jm.Polytope(C.H, C.h),
        disturbance=jm.Box(-reach, reach), policy=policy,
    )  # fmt: skip
    try:
        return feasible_polytope(mpc).volume() / C.volume()
    except ValueError:
        return 0.0


def closed_loops(eps: float, C: jm.Polytope, loops: int, steps: int) -> str:
    """Return what closed loops from random states of C come to."""
    rng = np.random.default_rng(0)
    plants, corners = vertices(eps), W.vertices()
    mpc = jm.MPC(jm.LinearSystem(A, B), np.eye(2), np.eye(1), 3, X, U)
    mpc = first_step_in(mpc, C, systems=plants, disturbance=W)
    hull = C.vertices()
    x = rng.dirichlet(np.full(len(hull), 0.3), loops) @ hull
    H, h = np.asarray(C.H), np.asarray(C.h)
    As, Bs = (np.array([getattr(p, name) for p in plants]) for name in "AB")
    unsolved, beyond, began = 0, -np.inf, time.perf_counter()
    with enable_x64():
        controller = jm.Controller(mpc)
    for _ in range(steps):
        plans = jm.solve_many(controller, x)
        unsolved += int(np.sum(plans.status != jm.Status.SOLVED))
        pick = rng.integers(len(plants), size=loops)
        u = np.clip(plans.inputs[:, 0], -4.0, 4.0)
        x = np.einsum("bij,bj->bi", As[pick], x) + np.einsum("bij,bj->bi", Bs[pick], u)
        x = x + corners[rng.integers(len(corners), size=loops)]
        beyond = max(beyond, float(np.max(x @ H.T - h)))
    seconds = time.perf_counter() - began
    return (
        f"{loops:,} loops of {steps} steps: {unsolved} not solved, largest violation of C "
        f"{beyond:.1e}, {seconds:.0f} s"
    )


def main(loops: int, steps: int, followed: float) -> None:
    """Print a line for each ε, with closed loops of one of them (0: of all)."""
    for eps, published in PUBLISHED.items():
        began = time.perf_counter()
        C = maximal_control_invariant_set(vertices(eps), X, U, disturbance=W)
        took = time.perf_counter() - began
        shares = [share(policy, eps, C) for policy in ("affine", "tightened")]
        print(
            f"eps {eps:.2f}: C area {C.volume():.4f} (gap {C.gap:.0e}, {took:.1f} s); affine "
            f"{shares[0]:.3f}, tightened {shares[1]:.3f}; published {published}",
            flush=True,
        )
        if followed in (0, eps):
            print(f"  first step, coverage 1: {closed_loops(eps, C, loops, steps)}", flush=True)


if __name__ == "__main__":
    loops, steps, followed, *_ = *sys.argv[1:], *("100000", "10", "0.45")[len(sys.argv) - 1 :]
    main(int(loops), int(steps), float(followed))
