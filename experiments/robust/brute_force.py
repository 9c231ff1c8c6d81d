"""Labels of robust problems against all vertex sequences and a linear program of another kind.

    python experiments/robust/brute_force.py [systems] [states]

Ten random systems, n ≤ 3, N ≤ 5, 10,000 states each, once under affine policies and once with
tightened rows. Of each state labelled feasible the policy is simulated under every sequence of
vertices of the disturbances. Of the states labelled infeasible, those nearest to the boundary are
given to a program with a row for each sequence and limit (SciPy), which looks for a policy.
"""

import itertools
import sys
import time
from dataclasses import replace

import numpy as np
from scipy.optimize import linprog

import jaxmpc as jm
from jaxmpc.feasible.policy_hull import policy_hull
from jaxmpc.feasible.policy_problem import problem_of
from jaxmpc.mpc.tightening import feedback_gain

# States labelled infeasible that get a program, of each system.
NEAREST = 40


def random_problem(seed: int) -> jm.MPC:
    """Return a problem with one or two disturbances, off centre, and unequal limits."""
    rng = np.random.default_rng(seed)
    n, m = 1 + seed % 3, 1 + seed % 2
    N, p = 2 + seed % 4, 1 + (seed // 2) % 2
    A, B, c = 0.7 * rng.normal(size=(n, n)), rng.normal(size=(n, m)), 0.03 * rng.normal(size=n)
    return jm.MPC(
        jm.LinearSystem(A, B, c), np.eye(n), np.eye(m), N,
        states=jm.Box(-rng.uniform(1, 2, n), rng.uniform(1, 2, n)),
        inputs=jm.Box(-rng.uniform(0.5, 1, m), rng.uniform(0.5, 1, m)), policy="affine",
        disturbance=jm.Box(-rng.uniform(0, 0.12, p), rng.uniform(0.01, 0.12, p)),
        disturbance_matrix=rng.normal(size=(n, p)), terminal_set=jm.Box(-np.ones(n), np.ones(n)),
    )  # fmt: skip


class Simulated:
    """A problem's limits along all sequences of vertices."""

    def __init__(self, mpc: jm.MPC) -> None:
        self.mpc, self.N = mpc, mpc.horizon
        self.A, self.B = np.asarray(mpc.system.A), np.asarray(mpc.system.B)
        self.c, self.E = np.asarray(mpc.system.c), np.asarray(mpc.disturbance_matrix)
        low, high = np.asarray(mpc.disturbance.lower), np.asarray(mpc.disturbance.upper)
        p = len(low)
        self.signs = np.array(list(itertools.product([-1.0, 1.0], repeat=self.N * p)))
        self.w = (low + high) / 2 + self.signs.reshape(-1, self.N, p) * (high - low) / 2
        self.X, self.U = mpc.states.half_spaces(), mpc.inputs.half_spaces()
        self.last = mpc.terminal_set.half_spaces()

    def worst(self, x0: np.ndarray, v: np.ndarray, M: np.ndarray) -> float:
        """Return the largest violation under u = v + M ω."""
        u = (v + self.signs @ M.T).reshape(len(self.w), self.N, -1)
        x, worst = np.tile(x0, (len(self.w), 1)), -np.inf
        for k in range(self.N + 1):
            H, h = self.X if k < self.N else self.last
            worst = max(worst, np.max(x @ H.T - h))
            if k < self.N:
                H, h = self.U
                worst = max(worst, np.max(u[:, k] @ H.T - h))
                x = x @ self.A.T + u[:, k] @ self.B.T + self.c + self.w[:, k] @ self.E.T
        return worst

    def worst_tightened(self, x0: np.ndarray, v: np.ndarray, K: np.ndarray) -> float:
        """Return the largest violation under u = v + K (x − z)."""
        z, x, worst = x0, np.tile(x0, (len(self.w), 1)), -np.inf
        for k in range(self.N + 1):
            H, h = self.X if k < self.N else self.last
            worst = max(worst, np.max(x @ H.T - h))
            if k < self.N:
                u = v[k] + (x - z) @ K.T
                worst = max(worst, np.max(u @ self.U[0].T - self.U[1]))
                x = x @ self.A.T + u @ self.B.T + self.c + self.w[:, k] @ self.E.T
                z = self.A @ z + self.B @ v[k] + self.c
        return worst

    def least(self, x0: np.ndarray, K: np.ndarray | None = None) -> float:
        """Return the least violation over all affine policies, or over plans v with the gain K."""
        n, m, N = len(self.A), self.B.shape[1], self.N
        entries = [] if K is not None else [(k, j) for k in range(N) for j in range(k)]
        p = self.E.shape[1]
        total, rows, bounds = N * m + len(entries) * m * p, [], []
        for w in self.w:
            gain, x, z, dz = np.zeros((n, total)), x0.copy(), x0.copy(), np.zeros((n, total))
            for k in range(N + 1):
                H, h = self.X if k < N else self.last
                rows.append(H @ gain)
                bounds.append(h - H @ x)
                if k == N:
                    break
                u, fixed = np.zeros((m, total)), np.zeros(m)
                u[:, k * m : (k + 1) * m] = np.eye(m)
                for e, (i, j) in enumerate(entries):
                    if i == k:
                        at = N * m + e * m * p
                        u[:, at : at + m * p] = np.kron(np.eye(m), w[j])
                own = u.copy()
                if K is not None:
                    u, fixed = u + K @ (gain - dz), K @ (x - z)
                H, h = self.U
                rows.append(H @ u)
                bounds.append(h - H @ fixed)
                gain = self.A @ gain + self.B @ u
                x = self.A @ x + self.B @ fixed + self.c + self.E @ w[k]
                dz, z = self.A @ dz + self.B @ own, self.A @ z + self.c
        G, g = np.vstack(rows), np.concatenate(bounds)
        G = np.column_stack([G, -np.ones(len(g))])
        found = linprog(np.eye(total + 1)[-1], G, g, bounds=(None, None))
        return found.fun


def main(systems: int, states: int) -> None:
    """Print one line a system and policy, and how many labels are wrong."""
    wrong, worst, seed, done = 0, -np.inf, 0, 0
    while done < systems:
        mpc = random_problem(seed)
        seed += 1
        try:
            hull = policy_hull(problem_of(mpc))
        except ValueError:
            continue  # empty
        done += 1
        n, plant = mpc.system.n, Simulated(mpc)
        points = np.random.default_rng(seed).uniform(-2, 2, (states, n))
        # Half of them close to the boundary.
        ends = hull.bounds.points
        weights = np.random.default_rng(seed).dirichlet(np.full(len(ends), 0.05), states // 2)
        points[: states // 2] = (
            weights @ ends * np.random.default_rng(1).uniform(0.97, 1.03, (states // 2, 1))
        )
        for policy in ("affine", "tightened"):
            began = time.perf_counter()
            problem, K = problem_of(replace(mpc, policy=policy)), None
            try:
                found = jm.map_feasible_set(problem, points)
            except ValueError as error:
                print(f"{policy}: {error}")
                continue
            took = time.perf_counter() - began
            inside = np.flatnonzero(found.label == 1)
            if policy == "affine":
                policies = zip(points[inside], *hull.policies(points[inside]), strict=True)
                violation = [plant.worst(*each) for each in policies]
            else:
                K = np.asarray(feedback_gain(problem.mpc))
                plans = zip(points[inside], found.labels.plan[inside], strict=True)
                violation = [plant.worst_tightened(x, v, K) for x, v in plans]
            outside = np.flatnonzero((found.label == -1) & np.isfinite(found.labels.cut_offset))
            normal, offset = found.labels.cut_normal[outside], found.labels.cut_offset[outside]
            beyond = np.sum(normal * points[outside], axis=1) - offset
            near = outside[np.argsort(beyond / np.linalg.norm(normal, axis=1))][:NEAREST]
            least = [plant.least(points[i], K) for i in near]
            bad = int(np.sum(np.array(violation) > 1e-9)) + int(np.sum(np.array(least) < -1e-9))
            wrong, worst = wrong + bad, max(worst, *violation, -np.inf)
            print(
                f"seed {seed - 1}: n = {n}, m = {mpc.system.m}, N = {mpc.horizon}, "
                f"{len(plant.w):,} sequences, {policy}: {found.counts()}, worst violation "
                f"{max(violation, default=np.nan):.1e}, least violation of {len(near)} nearest "
                f"infeasible {min(least, default=np.nan):.1e}, wrong {bad}, labels {took:.1f} s",
                flush=True,
            )
    print(f"{done} systems, wrong labels {wrong}, worst violation {worst:.1e}")


if __name__ == "__main__":
    main(*([int(v) for v in sys.argv[1:]] or (10, 10_000)))
