"""Couplings of a model (MuJoCo's equalities): configurations and velocities that keep them.

Grippers whose fingers mirror each other, mimic joints, closed loops (connect), welded bodies and
coupled tendons. The predictor has them as the plant has: rows r(q) = 0 with Jacobian G (rows, nv)
that MuJoCo enforces by stiff springs (solref, solimp). Here they are exact, by its C engine.
"""

import numpy as np

from jaxmpc.checks import fail
from jaxmpc.robots.mujoco_access import equalities, mujoco, name_of, names

# Steps of Newton's method, and the residual (rad, m) at which they end.
_STEPS, _END = 50, 1e-12
# The residual up to which a coupling counts as met.
MET = 1e-6
# Directions of G smaller than this, relative to the largest, repeat others.
_RANK = 1e-9


class Couplings:
    """The equalities of a model, as functions of a configuration q (nq,)."""

    def __init__(self, model: "mujoco.MjModel") -> None:
        self.model, self.data = model, mujoco.MjData(model)
        self.there = bool(equalities(model))

    def rows(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the residuals (rows,) and their Jacobian (rows, nv)."""
        model, data = self.model, self.data
        data.qpos[:] = q
        mujoco.mj_fwdPosition(model, data)
        return data.efc_pos[: data.ne].copy(), equality_jacobian(model, data)

    def motions(self, q: np.ndarray) -> np.ndarray:
        """Return the projector (nv, nv) onto the velocities that keep the couplings at q."""
        return projector(self.rows(q)[1])

    def met(self, q: np.ndarray) -> np.ndarray:
        """Return the configuration near q that meets the couplings, by Newton's method; where that
        finds none, where it ends: see `unmet`."""
        q = np.array(q, float)
        for _ in range(_STEPS if self.there else 0):
            residual, G = self.rows(q)
            if np.abs(residual).max(initial=0.0) <= _END:
                break
            step = -np.linalg.lstsq(G, residual, rcond=_RANK)[0]
            mujoco.mj_integratePos(self.model, q, step, 1.0)
        return q

    def unmet(self, q: np.ndarray) -> str:
        """Return in words which coupling is off the most at q, "" where all are met."""
        if not self.there:
            return ""
        residual = np.abs(self.rows(q)[0])
        worst = int(np.argmax(residual))
        if residual[worst] <= MET:
            return ""
        return f"{self.name(self.data.efc_id[worst])} is off by {residual[worst]:.3g}"

    def name(self, i: int) -> str:
        """Return the name of an equality, or where it has none the joints that it couples."""
        model = self.model
        if names(model, "equality")[i] or model.eq_type[i] != mujoco.mjtEq.mjEQ_JOINT:
            return name_of(model, "equality", i)
        ends = (model.eq_obj1id[i], model.eq_obj2id[i])
        return "equality of " + " and ".join(name_of(model, "joint", k) for k in ends if k >= 0)

    def kept(self, states: np.ndarray) -> np.ndarray:
        """Return states (..., nq + nv + na) with the nearest configurations and velocities that
        keep the couplings. Raises ValueError where none is found."""
        states = np.array(states, float)
        nq, nv = self.model.nq, self.model.nv
        for state in states.reshape(-1, states.shape[-1]) if self.there else ():
            state[:nq] = self.met(state[:nq])
            if off := self.unmet(state[:nq]):
                cure = "Draw states nearer to home (spread), or mend the couplings of the file"
                fail("robot", f"its couplings cannot be met near {state[:nq]}: {off}", cure)
            velocity = slice(nq, nq + nv)
            state[velocity] = self.motions(state[:nq]) @ state[velocity]
        return states


def equality_jacobian(model: "mujoco.MjModel", data: "mujoco.MjData") -> np.ndarray:
    """Return the Jacobian (rows, nv) of the equalities at the position in `data`."""
    dense = np.zeros((data.nefc, model.nv))
    if mujoco.mj_isSparse(model):
        parts = data.efc_J, data.efc_J_rownnz, data.efc_J_rowadr, data.efc_J_colind
        mujoco.mju_sparse2dense(dense, *(part.ravel() for part in parts))
    elif data.nefc:
        dense = data.efc_J.reshape(data.nefc, model.nv)
    return dense[: data.ne].copy()


def projector(G: np.ndarray) -> np.ndarray:
    """Return the orthogonal projector (nv, nv) onto the null space of G (rows, nv)."""
    _, sizes, directions = np.linalg.svd(G, full_matrices=False)
    fixed = directions[sizes > _RANK * max(sizes.max(initial=0.0), 1e-300)]
    return np.eye(G.shape[1]) - fixed.T @ fixed
