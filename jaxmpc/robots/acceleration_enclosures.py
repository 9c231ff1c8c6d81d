"""Enclosures of the accelerations of a robot, and of their derivatives, on cells.

Forces of rigid bodies, dampers and motors are quadratic in speeds and affine in inputs, which the
degrees of their program show (`polynomial_degrees.py`). So only the mass matrix and the
coefficients, functions of the positions, are enclosed by their programs; then M a = f is solved by
elimination.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.checks import fail
from jaxmpc.robots.intervals import (
    Interval,
    add,
    guarded,
    matrix_product,
    multiply,
    point,
    square,
)
from jaxmpc.robots.polynomial_degrees import polynomial_degrees
from jaxmpc.robots.robot import Robot
from jaxmpc.robots.taylor_enclosures import Taylor, TaylorProgram, variables

# States and inputs at which accelerations are computed: to fit a model, and to judge bounds.
SAMPLES = 4000


class Accelerations:
    """The accelerations a (nv,) as functions of z = (q, v, u) on cells of a box."""

    def __init__(self, robot: Robot, z: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> None:
        self.robot, self.z, self.lower, self.upper = robot, z, lower, upper
        self.nv, self.d = robot.mujoco.nv, len(z)
        self.ends = [0, self.nv, 2 * self.nv, self.d]
        self.program = TaylorProgram(self._coefficients, (self.nv,))

    def _balance(self, q: Array, v: Array, u: Array) -> tuple[Array, Array]:
        return self.robot.predictor.balance(jnp.concatenate([q, v]), u)

    def _coefficients(self, q: Array) -> tuple[Array, Array, Array, Array, Array]:
        """Return M and the coefficients of the force f = f_0 + F_v v + F_u u + v'F_vv v / 2: rigid
        bodies, dampers and motors have no other, so that only q remains to be cut into cells."""
        rest = jnp.zeros(self.nv), jnp.zeros(self.robot.m)

        def force(v: Array, u: Array) -> tuple[Array, tuple[Array, Array]]:
            M, f = self._balance(q, v, u)
            return f, (M, f)

        (F_v, F_u), (M, f) = jax.jacfwd(force, (0, 1), has_aux=True)(*rest)
        F_vv = jax.jacfwd(jax.jacfwd(lambda v: force(v, rest[1])[0]))(rest[0])
        return M, f, F_v, F_u, F_vv

    def require_quadratic(self) -> None:
        """Raise ValueError unless M depends on q alone and f has no other terms than these: by the
        degrees in v of all that the program computes, where inputs count as two speeds."""
        M, f = polynomial_degrees(self._balance, (self.nv, self.nv, self.robot.m), (0, 1, 2))
        if M.max() > 0 or f.max() > 2:
            problem = "has forces that are not quadratic in speeds and affine in inputs"
            fail("robot", problem, "Take motors and linear dampers")

    def samples(self, slope: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return points (SAMPLES, d) of the box, half of their coordinates at an end, and the
        accelerations (SAMPLES, nv) there. Points that leave `states` within a period of the model
        with these slopes are moved toward the set-point until they do not."""
        rng = np.random.default_rng(0)
        part = rng.uniform(size=(SAMPLES, self.d))
        part = np.where(rng.uniform(size=part.shape) < 0.5, np.round(part), part)
        points = self.lower + part * (self.upper - self.lower)
        n = self.robot.n
        A, B, *_ = powers(self.robot, slope)
        room = np.array([self.lower[:n], self.upper[:n]]) - self.z[:n]
        moved = (points - self.z) @ np.hstack([A.upper, B.upper]).T
        with np.errstate(divide="ignore", invalid="ignore"):
            over = np.maximum(moved / room[1], moved / room[0])
        over = np.nanmax(np.where(moved == 0, 0.0, over), axis=1)
        points = self.z + (points - self.z) / np.maximum(over, 1.0)[:, None]
        solved = lambda z: jnp.linalg.solve(*self._balance(*jnp.split(z, self.ends[1:-1])))
        with jax.enable_x64(True):
            values = np.asarray(jax.jit(jax.vmap(solved))(points))
        return points, values

    def tangent(self) -> np.ndarray:
        """Return ∂a/∂z (nv, d) at the set-point."""
        found, _ = self.on_cells(point(self.z[None]), self.z[None])
        k = 1 + np.arange(self.d)
        return np.array([(a.of.lower[k, 0] + a.of.upper[k, 0]) / 2 for a in found])

    def bent(self) -> np.ndarray:
        """Return in which coordinates (nv, d) each acceleration has second derivatives."""
        points = np.random.default_rng(1).uniform(self.lower, self.upper, (20, self.d))
        found, _ = self.on_cells(point(points), points)
        i, j = np.triu_indices(self.d)
        half = (self.upper - self.lower) / 2
        bent = []
        for a in found:
            size = np.abs(a.of.upper[1 + self.d :]).max(axis=1) * half[i] * half[j]
            most = [size[(i == k) | (j == k)].max() for k in range(self.d)]
            bent.append(np.array(most) > 1e-9 * np.abs(a.of.upper[0]).max())
        return np.array(bent)

    def on_cells(self, box: Interval, points: np.ndarray) -> tuple[list[Taylor], np.ndarray]:
        """Return the nv accelerations with derivatives in all of z on cells (cells, d) and at
        points in them, and which cells (cells,) are so large that the mass matrix is not seen to
        be regular: nothing is known there."""
        nv, m, boxes = self.nv, self.robot.m, len(points)
        q = slice(0, nv)
        M, *force = self.program(box[:, q], points[:, q])
        M = [[_entry(M, (i, j)) for j in range(nv)] for i in range(nv)]
        # The coefficients of 1, v, u and v v, of each equation.
        f, F_v, F_u, F_vv = force
        right = [
            [
                _entry(f, i),
                *(_entry(F_v, (i, j)) for j in range(nv)),
                *(_entry(F_u, (i, j)) for j in range(m)),
                *(_entry(F_vv, (i, j, k)) for j in range(nv) for k in range(j, nv)),
            ]
            for i in range(nv)
        ]
        lost = np.zeros(boxes, bool)
        everything = [*sum(M, []), *sum(right, [])]
        like = next((v for v in everything if isinstance(v, Taylor)), None)
        z = variables(box, points, range(self.d))
        like = like or _entry(z, 0)
        with guarded():
            for k in range(nv):  # elimination, down and up: pivots of a mass matrix are positive
                inverse, bad = _inverted(M[k][k], like)
                lost |= bad
                M[k] = [_times(entry, inverse) for entry in M[k]]
                right[k] = [_times(entry, inverse) for entry in right[k]]
                for i in range(nv):
                    if i != k:
                        factor = M[i][k]
                        M[i] = [_less(a, factor, b) for a, b in zip(M[i], M[k], strict=True)]
                        pairs = zip(right[i], right[k], strict=True)
                        right[i] = [_less(a, factor, b) for a, b in pairs]
            v = [_entry(z, nv + j) for j in range(nv)]
            u = [_entry(z, 2 * nv + j) for j in range(m)]
            squares = [
                v[j] * v[k] * (0.5 if j == k else 1.0) for j in range(nv) for k in range(j, nv)
            ]
            found = []
            for constant, *row in right:
                a = _entry(z, 0) * 0.0 + _on(constant, z)
                for coefficient, term in zip(row, [*v, *u, *squares], strict=True):
                    if isinstance(coefficient, Taylor) or coefficient != 0:
                        a = a + term * _on(coefficient, z)
                found.append(a.on(tuple(range(self.d))))
        return found, lost


def _on(coefficient: Any, z: Taylor) -> Any:
    """Return a coefficient, a function of q or a constant, as a function of z."""
    return coefficient.on_steps(z) if isinstance(coefficient, Taylor) else coefficient


def _times(entry: Any, factor: Taylor) -> Any:
    """Return entry · factor, nothing where the entry is the constant 0."""
    if isinstance(entry, Taylor):
        return entry * factor
    return factor * entry if entry != 0 else entry


def _less(entry: Any, factor: Any, other: Any) -> Any:
    """Return entry − factor · other, whichever of them are constants."""
    if any(not isinstance(v, Taylor) and v == 0 for v in (factor, other)):
        return entry
    product = factor * other if isinstance(factor, Taylor) else other * factor
    if isinstance(entry, Taylor) or not isinstance(product, Taylor):
        return entry - product
    return -product + entry


def _entry(of: Any, index: Any) -> Any:
    """Return one entry of an array of functions, or of constants."""
    if not isinstance(of, Taylor):
        return np.asarray(of)[index]
    where = index if isinstance(index, tuple) else (index,)
    return of.mapped(lambda ends: ends[(slice(None), slice(None), *where)])


def _inverted(pivot: Any, like: Taylor) -> tuple[Taylor, np.ndarray]:
    """Return one over a pivot, and the cells where that is not known, 1 in its place."""
    if not isinstance(pivot, Taylor):
        pivot = like.mapped(np.zeros_like) + pivot
    bad = pivot.of.lower[0] <= 0
    if bad.any():
        ends = (pivot.of.lower.copy(), pivot.of.upper.copy())
        for end in ends:
            end[:, bad] = 0.0
            end[0, bad] = 1.0
        pivot = Taylor(pivot.variables, Interval(*ends), pivot.steps)
    return pivot.inverted(), bad[: pivot.boxes]


def powers(robot: Robot, slope: np.ndarray) -> tuple[Interval, Interval, list[Interval], Interval]:
    """Return enclosures of A (n, n) and B (n, m) of the period in deviations, the matrices
    A₁^j E (n, nv), and A₁ itself, for accelerations with these slopes (nv, d)."""
    nv, n = robot.mujoco.nv, robot.n
    h = point(float(robot.plant.model.opt.timestep))
    identity = np.eye(nv)
    E = Interval(np.zeros((n, nv)), np.zeros((n, nv)))
    E[:nv] = multiply(square(h), point(identity))
    E[nv:] = multiply(h, point(identity))
    one = matrix_product(E, point(slope))
    A1, B1 = one[:, :n], one[:, n:]
    free = Interval(np.eye(n), np.eye(n))
    free[:nv, nv:] = multiply(h, point(identity))
    A1 = add(A1, free)
    A, B, ways = point(np.eye(n)), point(np.zeros(B1.lower.shape)), []
    for _ in range(robot.substeps):
        ways.append(matrix_product(A, E))
        B = add(B, matrix_product(A, B1))
        A = matrix_product(A1, A)
    return A, B, ways, A1
