"""Multi-parametric QPs: their linear cost and their limits are affine in parameters."""

from typing import Any, NamedTuple

import numpy as np

from jaxmpc.arrays import Reals, as_array, host_array
from jaxmpc.checks import (
    fail,
    require_finite,
    require_kind,
    require_names,
    require_real,
    require_shape,
    require_symmetric_psd,
)
from jaxmpc.mpc.condense import Condensed, Inequalities, condensed_in_float64
from jaxmpc.mpc.plan import checked_array, reference_shapes
from jaxmpc.mpc.problem import MPC
from jaxmpc.pytrees import record


class Output(NamedTuple):
    """What the law of a program gives: gain z + direct θ + constant (k,)."""

    gain: np.ndarray
    direct: np.ndarray
    constant: np.ndarray


class Quadratic(NamedTuple):
    """½ θ'Y θ + y'θ + c."""

    Y: np.ndarray
    y: np.ndarray
    c: float

    def along(self, shift: np.ndarray, basis: np.ndarray) -> "Quadratic":
        """Return the same function of x, θ = shift + basis x."""
        slope = self.Y @ shift + self.y
        constant = self.c + shift @ (self.Y @ shift / 2 + self.y)
        return Quadratic(basis.T @ self.Y @ basis, basis.T @ slope, float(constant))


class ProgramArrays(NamedTuple):
    """The fields of a `ParametricQP` as arrays; alone: what the cost has in θ alone."""

    P: np.ndarray
    q: np.ndarray
    F: np.ndarray
    G: np.ndarray
    h: np.ndarray
    S: np.ndarray
    alone: Quadratic
    output: Output


@record
class ParametricQP:
    """The multi-parametric QP

        V(θ) = min over z of  ½ z'P z + (q + F θ)'z + ½ θ'Y θ + y'θ + c   subject to  G z ≤ h + S θ.

    P (nz, nz) ≻ 0 in the directions that the rows leave free; q (nz,), F (nz, p); G (r, nz), h (r,)
    with inf for a row that does not bind, S (r, p). An equality is two opposite rows. q, F, S None:
    zero. Y (p, p), y (p,), c: what the cost has in θ alone, None for zero; it changes V and no
    optimum.

    output: (gain (k, nz), direct (k, p), constant (k,)) of gain z + direct θ + constant, what
    `CriticalRegions.law` returns, such as the first input of an MPC; None for z. names: of the p
    parameters, empty for none.
    """

    P: Reals
    G: Reals
    h: Reals
    q: Reals | None = None
    F: Reals | None = None
    S: Reals | None = None
    Y: Reals | None = None
    y: Reals | None = None
    c: float = 0.0
    output: Any = None
    names: tuple[str, ...] = ()

    @property
    def dimension(self) -> int:
        """Return p, the number of parameters."""
        return next((np.shape(as_array(v))[1] for v in (self.F, self.S) if v is not None), 0)

    @property
    def labels(self) -> tuple[str, ...]:
        """Return the names of the parameters, θ1, …, θp where none are given."""
        return self.names or tuple(f"θ{i + 1}" for i in range(self.dimension))

    def validate(self) -> None:
        """Raise ValueError that names the field, its value and the cure."""
        for name in ("P", "G", "h"):
            require_real(name, getattr(self, name))
        for name in ("F", "S"):
            value = getattr(self, name)
            if value is not None and np.ndim(value) != 2:
                fail(name, f"shape {np.shape(value)}", "Give a matrix, one column a parameter")
        if np.ndim(as_array(self.P)) != 2 or np.ndim(as_array(self.G)) != 2:
            what = f"shapes {np.shape(as_array(self.P))} and {np.shape(as_array(self.G))}"
            fail("P, G", what, "Give matrices (nz, nz) and (r, nz)")
        nz, r, p = np.shape(as_array(self.P))[0], np.shape(as_array(self.G))[0], self.dimension
        if not p:
            fail("F, S", "are both None, or have no columns", "Give what depends on parameters")
        shapes = {
            "P": (nz, nz),
            "q": (nz,),
            "F": (nz, p),
            "G": (r, nz),
            "h": (r,),
            "S": (r, p),
            "Y": (p, p),
            "y": (p,),
            "c": (),
        }
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value is None:
                continue
            cure = f"With P ({nz}, {nz}), {r} rows and {p} parameters it is {shape}"
            require_shape(name, value, shape, cure)
            if name != "h":
                require_finite(name, value)
        h = host_array("h", self.h)
        if np.any(np.isnan(h) | (h == -np.inf)):
            fail("h", "holds NaN or -inf", "Give numbers, inf for a row that does not bind")
        require_symmetric_psd("P", self.P)
        self._validate_output(nz, p)
        require_names("names", self.names, p)

    def _validate_output(self, nz: int, p: int) -> None:
        if self.output is None:
            return
        if len(self.output) != 3:
            fail("output", f"{len(self.output)} parts", "Give (gain, direct, constant)")
        k = np.shape(self.output[2])[0] if np.ndim(self.output[2]) == 1 else 0
        for name, part, shape in zip(
            ("gain", "direct", "constant"), self.output, ((k, nz), (k, p), (k,)), strict=True
        ):
            require_shape(f"output: {name}", part, shape, "k rows each, k that of the constant")
            require_finite(f"output: {name}", part)


def in_numpy(qp: ParametricQP) -> ProgramArrays:
    """Return all fields of a program as arrays of float64, zeros for None."""
    nz, p, r = np.shape(as_array(qp.P))[0], qp.dimension, np.shape(as_array(qp.G))[0]

    def filled(name: str, *shape: int) -> np.ndarray:
        value = getattr(qp, name)
        return np.zeros(shape) if value is None else host_array(name, value)

    P, Y = host_array("P", qp.P), filled("Y", p, p)
    output = Output(np.eye(nz), np.zeros((nz, p)), np.zeros(nz))
    if qp.output is not None:
        output = Output(*(host_array("output", part) for part in qp.output))
    return ProgramArrays(
        P=(P + P.T) / 2,
        q=filled("q", nz),
        F=filled("F", nz, p),
        G=host_array("G", qp.G),
        h=host_array("h", qp.h),
        S=filled("S", r, p),
        alone=Quadratic((Y + Y.T) / 2, filled("y", p), float(qp.c)),
        output=output,
    )


def parametric_qp(
    mpc: MPC, *, reference: Reals | None = None, input_reference: Reals | None = None
) -> ParametricQP:
    """Return the parametric QP of an MPC problem, with references among its parameters.

    The parameters are θ = (x_0, r), or (x_0, u_{−1}, r) where input rates matter (then give
    `critical_regions` a set that holds u_{−1} in its limits). reference (n, k), input_reference
    (m, k): the states and inputs to track are reference r and input_reference r at all steps, r
    (k,); None: zero. [[1], [0]] is a reference of the first of two states. z are the inputs of all
    steps, stage by stage (free moves, prestabilised ones where `mpc` is), V is the cost of the
    plan, and the law is the first input.

    Raises ValueError for ill-posed problems, soft rows and an ellipsoidal terminal set, and for
    references of wrong shapes. NumPy in float64; not traceable.
    """
    require_kind("mpc", mpc, MPC)
    mpc.validate()
    if mpc.soft:
        fail("mpc.soft", "has rows, and slacks make another QP", "Make the rows hard first")
    n, m = mpc.system.n, mpc.system.m
    given = [v for v in (reference, input_reference) if v is not None]
    k = np.shape(as_array(given[0]))[1] if given and np.ndim(as_array(given[0])) == 2 else 0
    of_states = np.zeros((n, k)) if reference is None else host_array("reference", reference)
    of_inputs = np.zeros((m, k))
    if input_reference is not None:
        of_inputs = host_array("input_reference", input_reference)
    for name, value, size in (("reference", of_states, n), ("input_reference", of_inputs, m)):
        require_shape(name, value, (size, k), "Give a matrix, one column an entry of r")
        require_finite(name, value)
    c = condensed_in_float64(mpc)
    if c.balls:
        fail("terminal_set", "is an ellipsoid: its law is not affine", "Give a Polytope")
    rows = Inequalities.of(c)
    q, F, alone = cost_of_parameters(mpc, c, of_states, of_inputs)
    wide = lambda M: np.pad(M, ((0, 0), (0, k)))
    return ParametricQP(
        P=c.P,
        q=q,
        F=F,
        G=rows.C,
        h=rows.b,
        S=-wide(rows.D),
        Y=alone.Y,
        y=alone.y,
        c=alone.c,
        output=(c.Omega[0], wide(c.Psi[0]), c.psi[0]),
        names=mpc.labels + tuple(f"reference {i + 1}" for i in range(k)),
    )


def cost_of_tracking(
    mpc: MPC,
    c: Condensed,
    reference: Reals | None = None,
    input_reference: Reals | None = None,
) -> tuple[np.ndarray, Quadratic]:
    """Return f (nz,) of the cost ½ z'Pz + (F θ + f)'z of plans that track references, as in
    `solve`, None for zero, and what the cost has in θ alone."""
    given = {"reference": reference, "input_reference": input_reference}
    if all(value is None for value in given.values()):
        return np.asarray(c.f), cost_of_parameters(mpc, c)[2]
    columns, shapes = [], reference_shapes(mpc)
    for name, value in given.items():
        shape = shapes[name]
        checked = checked_array(name, np.zeros(shape[0]) if value is None else value, shape)
        require_finite(name, checked)
        columns.append(host_array(name, checked)[..., None])
    F, alone = cost_of_parameters(mpc, c, *columns)[1:]
    p = mpc.dimension  # the parameter behind θ is 1
    return np.asarray(c.f) + F[:, p], alone.along(np.eye(p + 1)[p], np.eye(p + 1)[:, :p])


def cost_of_parameters(
    mpc: MPC, c: Condensed, of_states: np.ndarray | None = None, of_inputs: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, Quadratic]:
    """Return q, F and what the cost of a plan has in (θ, r) alone; of_states (n, k), of_inputs
    (m, k): the references that r stands for, (N+1, n, k) and (N, m, k) if they differ from step to
    step; None: no r.

    The cost is Σ e_k'W_k e_k over states, inputs and rates, each e_k affine in (z, θ, r): with
    e_k = E_k z + T_k (θ, r) + t_k these are 2 Σ E_k'W_k T_k and so on.
    """
    N, n, m, p = mpc.horizon, mpc.system.n, mpc.system.m, mpc.dimension
    of_states = np.zeros((n, 0)) if of_states is None else of_states
    of_inputs = np.zeros((m, 0)) if of_inputs is None else of_inputs
    k = of_states.shape[-1]

    def track(M: np.ndarray, target: np.ndarray) -> np.ndarray:
        return np.concatenate([M, np.broadcast_to(-target, (*M.shape[:2], k))], axis=2)

    Q, R = (
        np.broadcast_to(M, (N, *M.shape[-2:])) for M in map(np.asarray, (c.weights.Q, c.weights.R))
    )
    states = np.concatenate([Q, np.asarray(c.weights.P)[None]])
    terms = [
        (states, np.asarray(c.Gamma), track(np.asarray(c.Phi), of_states), np.asarray(c.phi)),
        (R, np.asarray(c.Omega), track(np.asarray(c.Psi), of_inputs), np.asarray(c.psi)),
    ]
    if mpc.input_rate_weight is not None:
        before = np.zeros((1, m, p))
        before[0, :, n:] = np.eye(m)
        none = np.zeros((1, m, c.P.shape[0])), before, np.zeros((1, m))
        change = [
            np.asarray(M) - np.concatenate([first, M[:-1]])
            for M, first in zip((c.Omega, c.Psi, c.psi), none, strict=True)
        ]
        W = np.broadcast_to(np.asarray(c.weights.W), (N, m, m))
        terms.append((W, change[0], track(change[1], np.zeros((m, k))), change[2]))
    nz, d = c.P.shape[0], p + k
    q, F, Y, y, constant = np.zeros(nz), np.zeros((nz, d)), np.zeros((d, d)), np.zeros(d), 0.0
    for W, E, T, t in terms:
        F += 2 * np.einsum("kai,kab,kbj->ij", E, W, T)
        q += 2 * np.einsum("kai,kab,kb->i", E, W, t)
        Y += 2 * np.einsum("kai,kab,kbj->ij", T, W, T)
        y += 2 * np.einsum("kai,kab,kb->i", T, W, t)
        constant += float(np.einsum("ka,kab,kb", t, W, t))
    return q, F, Quadratic(Y, y, constant)
