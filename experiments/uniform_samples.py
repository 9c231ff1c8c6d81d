"""Uniform samples of feasible sets of 2 to 12 states: time, proofs, and tests of their law.

    python experiments/uniform_samples.py [--count 1000000] [--states 2 3 4 6 8 10 12] [--seed 1]

The sets are products of joints (and, for an odd n, of a scalar plant) behind a
unimodular change of coordinates that hides the product from the sampler. So the law is known: in
the coordinates of each joint the samples are uniform on its own polygon, which geometry gives,
and the joints are independent of each other. Tested are, each by a chi-square statistic: cells of
equal area of every polygon (strips between quantiles of the first coordinate, then of the second),
and pairs of blocks in a table of such cells. With one set of chains the counts are a little more
alike, or less, than independent ones where chains remember: p-values tell.

The comparison is hit and run with linear programs: two of HiGHS for both ends of a chord, each from
the last basis, as many steps, measured over 200 steps.
"""

import argparse
import time

import numpy as np
from scipy.stats import chi2

import jaxmpc as jm
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.feasible.rays import of_length_one

CELLS = 12


def blocks(n: int, horizon: int) -> list[jm.MPC]:
    """Return joints of unlike inertia and limits, and a scalar plant first for an odd n."""
    found = []
    if n % 2:
        found.append(
            jm.MPC(
                jm.LinearSystem([[1.2]], [[1.0]]), 1.0, 1.0, horizon, jm.Box([-2], [3]),
                jm.Box([-0.4], [0.3]), terminal_set=jm.Box([-0.5], [1]),
            )
        )  # fmt: skip
    for i in range(n // 2):
        limits = jm.Box([-1.5 + 0.1 * i, -2.0], [1.5, 2.0 - 0.2 * i])
        found.append(
            jm.MPC(
                jm.LinearSystem([[1, 0.3], [0, 1.0]], [[0.0], [0.5 - 0.05 * i]]), np.eye(2), 1.0,
                horizon, limits, jm.Box([-1], [1]), terminal_set=limits,
            )
        )  # fmt: skip
    return found


def block_diagonal(parts: list[np.ndarray]) -> np.ndarray:
    rows, columns = (sum(p.shape[i] for p in parts) for i in (0, 1))
    whole, i, j = np.zeros((rows, columns)), 0, 0
    for part in parts:
        whole[i : i + len(part), j : j + part.shape[1]] = part
        i, j = i + len(part), j + part.shape[1]
    return whole


def hidden(parts: list[jm.MPC], seed: int) -> tuple[jm.MPC, np.ndarray]:
    """Return the problem of all parts in coordinates x = T (parts), and T: whole numbers, det 1."""
    random, n = np.random.default_rng(seed), sum(part.system.n for part in parts)
    T = np.eye(n)
    for _ in range(n if n > 2 else 0):
        i, j = random.choice(n, 2, replace=False)
        T[i] += random.choice([-1, 1]) * T[j]
    back = np.round(np.linalg.inv(T))
    A = block_diagonal([np.asarray(p.system.A) for p in parts])
    B = block_diagonal([np.asarray(p.system.B) for p in parts])
    sets = []
    for name in ("states", "terminal_set"):
        each = [getattr(p, name).half_spaces() for p in parts]
        H = block_diagonal([H for H, _ in each])
        sets.append(jm.Polytope(H @ back, np.concatenate([h for _, h in each])))
    ends = [np.concatenate([getattr(p.inputs, side) for p in parts]) for side in ("lower", "upper")]
    system = jm.LinearSystem(T @ A @ back, T @ B)
    m = system.m
    whole = jm.MPC(system, np.eye(n), np.eye(m), parts[0].horizon, sets[0], jm.Box(*ends),
                   terminal_set=sets[1])  # fmt: skip
    return whole, back


def cells(body: jm.Polytope, points: np.ndarray) -> np.ndarray:
    """Return for points of a polygon or interval which of its cells of equal area they lie in:
    uniform numbers by the transform of Rosenblatt, F_1(x_1) and F_2(x_2 | x_1), both exact."""
    vertices = body.vertices()
    if vertices.shape[1] == 1:
        low, high = vertices.min(), vertices.max()
        return np.minimum(
            ((points[:, 0] - low) / (high - low) * CELLS**2).astype(int), CELLS**2 - 1
        )
    H, h = np.asarray(body.H), np.asarray(body.h)
    corners = np.unique(vertices[:, 0])

    def section(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        room = (h - np.outer(x, H[:, 0])) / np.where(H[:, 1] == 0, 1, H[:, 1])
        up = np.where(H[:, 1] > 0, room, np.inf).min(axis=1)
        return np.where(H[:, 1] < 0, room, -np.inf).max(axis=1), up

    lengths = np.subtract(*section(corners)[::-1])
    areas = np.append(0, np.cumsum(np.diff(corners) * (lengths[1:] + lengths[:-1]) / 2))
    x = points[:, 0]
    part = np.clip(np.searchsorted(corners, x, side="right") - 1, 0, len(corners) - 2)
    low, high = section(x)
    # The section's length is linear between corners.
    area = areas[part] + (x - corners[part]) * (lengths[part] + (high - low)) / 2
    first = np.clip((area / areas[-1] * CELLS).astype(int), 0, CELLS - 1)
    second = np.clip(((points[:, 1] - low) / (high - low) * CELLS).astype(int), 0, CELLS - 1)
    return first * CELLS + second


def p_value(counts: np.ndarray) -> float:
    """Return the p-value of equal expected counts."""
    expected = counts.sum() / counts.size
    return float(chi2.sf(((counts - expected) ** 2 / expected).sum(), counts.size - 1))


def tests(parts: list[jm.MPC], x: np.ndarray) -> list[float]:
    """Return the p-values of all blocks and of all pairs of neighbours."""
    found, begin, numbers = [], 0, []
    for part in parts:
        size = part.system.n
        numbers.append(cells(jm.feasible_polytope(part), x[:, begin : begin + size]))
        found.append(p_value(np.bincount(numbers[-1], minlength=CELLS**2)))
        begin += size
    for i in range(len(parts) - 1):
        coarse = [numbers[k] // CELLS for k in (i, i + 1)]  # strips
        found.append(p_value(np.bincount(coarse[0] * CELLS + coarse[1], minlength=CELLS**2)))
        fine = [numbers[k] % CELLS for k in (i, i + 1)]
        found.append(p_value(np.bincount(fine[0] * CELLS + fine[1], minlength=CELLS**2)))
    return found


def program_seconds(mpc: jm.MPC, steps: int = 200) -> float:
    """Return the time of one step of hit and run by two linear programs."""
    programs, random = FeasibilityProblem.of(mpc).programs, np.random.default_rng(0)
    x, _ = programs.center()
    begun = time.process_time()
    for direction in of_length_one(random.standard_normal((steps, len(x)))):
        ends = [sign * programs.ray(x, sign * direction)[0] for sign in (-1, 1)]
        x = x + random.uniform(*ends) * direction * (1 - 1e-9)
    return (time.process_time() - begun) / steps


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--count", type=int, default=1_000_000)
    options.add_argument("--states", type=int, nargs="+", default=[2, 3, 4, 6, 8, 10, 12])
    options.add_argument("--horizon", type=int, default=5)
    options.add_argument("--method", default="auto")
    options.add_argument("--seed", type=int, default=1)
    options.add_argument("--no-programs", action="store_true")
    given = options.parse_args()
    print(
        "n  method         half-spaces accepted steps  compile s  CPU s  us a state"
        "  LP step us  ratio a step  ratio a state  least p of"
    )
    for n in given.states:
        parts = blocks(n, given.horizon)
        mpc, back = hidden(parts, n)
        one = lambda count, of=mpc: jm.feasible.sample_feasible_set(
            of, count, seed=given.seed, method=given.method
        )
        begun = time.process_time()
        one(given.count if given.count < 2**17 else 2**17)  # compiles
        first = time.process_time() - begun
        begun = time.process_time()
        samples = one(given.count)
        taken = time.process_time() - begun
        assert np.all(samples.labels.label == 1)
        p = tests(parts, samples.x0s @ back.T)
        step = np.nan if given.no_programs else program_seconds(mpc)
        each = taken / given.count
        steps = samples.steps or 6 * n
        print(
            f"{n:<2} {samples.method:14} {samples.half_spaces:<11} {samples.accepted:<8.4f} "
            f"{samples.steps:<6} {first:<10.1f} {taken:<6.1f} {1e6 * each:<10.2f}  "
            f"{1e6 * step:<10.0f}  {step / (each / steps):<12.0f}  {step * steps / each:<13.3g}  "
            f"{min(p):.3f} of {len(p)}",
            flush=True,
        )


if __name__ == "__main__":
    main()
