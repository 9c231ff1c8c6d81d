"""Reachability of a robot on a line, forward and backward, written with operators on sets.

The example is the one with which pycvxset introduces reachability: a double integrator sampled at
0.1 s, |u| <= 1, forward from the unit square and backward from |p| <= 0.75, |v| <= 0.25 with a
disturbance of s times the input. Areas are compared with rational arithmetic, which knows nothing
of this package: convex polygons as lists of exact vertices.

    python experiments/reachable_sets.py [--picture FILE]
"""

import argparse
import time
from fractions import Fraction as F

import numpy as np

import jaxmpc as jm

A = np.array([[1, 0.1], [0, 1]])
B = np.array([[0.005], [0.1]])
U = jm.Box([-1], [1])
FORWARD, BACKWARD, SHARES = 5, 20, (0.0, 0.2, 0.4, 0.8)
Point = tuple[F, F]


def forward(X, U, steps):
    """X_{k+1} = A X_k + B U."""
    found = [X]
    for _ in range(steps):
        found.append(A @ found[-1] + B @ U)
    return found


def backward(X, U, W, steps):
    """X_k = ((X_{k+1} - B W) + (-B U)) A, as polytopes."""
    found = [X.to_polytope()]
    for _ in range(steps):
        found.append(((found[-1] - B @ W) + (-B) @ U) @ A)
    return found


def exact_areas(share):
    """Areas of the backward sets in rational arithmetic.

    With z = A^k x the sets X_k become sums and differences of segments along A^-j B alone. A
    difference of a polygon and a segment is the intersection of two shifted copies, a sum the hull
    of two shifted copies.
    """
    b = (F(1, 200), F(1, 10))
    polygon = [(F(x, 4), F(y, 4)) for x, y in ((-3, -1), (3, -1), (3, 1), (-3, 1))]
    s, found = F(share).limit_denominator(10), []
    for _ in range(BACKWARD):
        w = (s * b[0], s * b[1])
        polygon = meet(moved(polygon, w, 1), moved(polygon, w, -1))
        polygon = hull(moved(polygon, b, 1) + moved(polygon, b, -1))
        polygon = [(x - y / 10, y) for x, y in polygon]  # A^-1
        found.append(area(polygon))
    return found


def moved(polygon: list[Point], by: Point, sign: int) -> list[Point]:
    return [(x + sign * by[0], y + sign * by[1]) for x, y in polygon]


def cross(o: Point, a: Point, b: Point) -> F:
    return (a[0] - o[0]) * (b[1] - o[1]) - (a[1] - o[1]) * (b[0] - o[0])


def hull(points: list[Point]) -> list[Point]:
    """Counter-clockwise (Andrew 1979)."""
    points, chains = sorted(set(points)), []
    for order in (points, points[::-1]):
        chain: list[Point] = []
        for p in order:
            while len(chain) > 1 and cross(chain[-2], chain[-1], p) <= 0:
                chain.pop()
            chain.append(p)
        chains += chain[:-1]
    return chains


def meet(polygon: list[Point], other: list[Point]) -> list[Point]:
    """The points of a polygon that lie in another one (Sutherland & Hodgman 1974)."""
    for start, end in zip(other, other[1:] + other[:1], strict=True):
        kept: list[Point] = []
        for p, q in zip(polygon, polygon[1:] + polygon[:1], strict=True):
            left, right = cross(start, end, p), cross(start, end, q)
            if left >= 0:
                kept.append(p)
            if left * right < 0:
                t = left / (left - right)
                kept.append((p[0] + t * (q[0] - p[0]), p[1] + t * (q[1] - p[1])))
        polygon = kept
    return hull(polygon)


def area(polygon: list[Point]) -> F:
    ends = zip(polygon, polygon[1:] + polygon[:1], strict=True)
    return sum((p[0] * q[1] - p[1] * q[0] for p, q in ends), F(0)) / 2


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--picture", help="file to draw the sets to")
    given = parser.parse_args()
    start = time.process_time()
    reached = forward(jm.Box([-0.5, -0.5], [0.5, 0.5]), U, FORWARD)
    took = time.process_time() - start
    print(f"forward: areas {[round(s.volume(), 12) for s in reached]}, {took * 1e3:.1f} ms of CPU")
    start = time.process_time()
    target = jm.Box([-0.75, -0.25], [0.75, 0.25])
    all_sets = {s: backward(target, U, s * U, BACKWARD) for s in SHARES}
    took = time.process_time() - start
    worst = 0.0
    for s, sets in all_sets.items():
        exact = exact_areas(s)
        errors = [abs(P.volume() / float(e) - 1) for P, e in zip(sets[1:], exact, strict=True)]
        worst = max(worst, *errors)
        last = f"area {sets[-1].volume():.12g}, exact {float(exact[-1]):.12g}"
        print(f"backward, disturbance {s}: {last}")
    print(f"worst relative error of {4 * BACKWARD} areas: {worst:.1e}; {took:.2f} s of CPU")
    if given.picture:
        draw(reached, all_sets, given.picture)


def draw(reached, all_sets, file):
    import matplotlib.pyplot as plt

    _, (left, right) = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    names = [f"k = {k}" for k in range(FORWARD, -1, -1)]
    jm.sets.plot(*reached[::-1], ax=left, label=names)
    left.set(title="Forward from the unit square", xlabel="position (m)", ylabel="velocity (m/s)")
    last = [sets[-1] for sets in all_sets.values()]
    jm.sets.plot(*last, ax=right, label=[f"w up to {s:g} u" for s in SHARES])
    right.set(title="Backward, 20 steps", xlabel="position (m)", ylabel="velocity (m/s)")
    plt.savefig(file, dpi=120)


if __name__ == "__main__":
    main()
