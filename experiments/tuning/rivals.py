"""Closed loops of the lesson's joint in torch, under the laws of mpc.pytorch and cvxpylayers."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np


@dataclass(frozen=True, eq=False)
class Joint:
    """x⁺ = Ax + Bu, |x| ≤ x_max, |u| ≤ u_max; the loss's weights Q, R."""

    A: Any = field(default_factory=lambda: np.array([[1, 0.01], [0, 1]]))
    B: Any = field(default_factory=lambda: np.array([[0], [0.2]]))
    x_max: Any = field(default_factory=lambda: np.array([1.5, 2.0]))
    u_max: float = 2.0
    Q: Any = field(default_factory=lambda: np.diag([50.0, 1.0]))
    R: Any = field(default_factory=lambda: np.array([[0.1]]))


def mpc_pytorch(joint: Joint, horizon: int, loops: int, states: bool) -> Callable:
    """The law (x, L, r) → u of mpc.pytorch: cost ½τ'Cτ over N + 1 steps, torque limits only."""
    import torch
    from mpc import mpc

    if states:
        raise NotImplementedError("it has no state limits")

    F = torch.tensor(np.hstack([joint.A, joint.B])).expand(horizon, loops, 2, 3)

    def law(x: Any, L: Any, r: Any) -> Any:
        C = torch.block_diag(2 * L @ L.T, 2 * r).expand(horizon + 1, loops, 3, 3)
        c = torch.zeros(*C.shape[:3], dtype=x.dtype)
        solver = mpc.MPC(
            2,
            1,
            horizon + 1,
            u_lower=-joint.u_max,
            u_upper=joint.u_max,
            n_batch=loops,
            verbose=-1,
            exit_unconverged=False,
            detach_unconverged=False,
        )
        return solver(x, mpc.QuadCost(C, c), mpc.LinDx(F, None))[1][0]

    return law


def cvxpylayers(joint: Joint, horizon: int, loops: int, states: bool) -> Callable:
    """The same by cvxpylayers, diffcp with Clarabel."""
    import cvxpy as cp
    import torch
    from cvxpylayers.torch import CvxpyLayer

    X, U = cp.Variable((2, horizon + 1)), cp.Variable((1, horizon))
    W, root, x_0 = cp.Parameter((2, 2)), cp.Parameter((1, 1)), cp.Parameter(2)
    rows = [X[:, 0] == x_0, X[:, 1:] == joint.A @ X[:, :-1] + joint.B @ U]
    rows.append(cp.abs(U) <= joint.u_max)
    if states:
        rows.append(cp.abs(X[:, 1:]) <= joint.x_max[:, None])
    cost = cp.sum_squares(W @ X) + cp.sum_squares(root @ U)
    layer = CvxpyLayer(cp.Problem(cp.Minimize(cost), rows), [W, root, x_0], [U])
    arguments = {"solve_method": "Clarabel"}
    return lambda x, L, r: layer(L.T, torch.sqrt(r), x, solver_args=arguments)[0][:, :, 0]


def with_torch(
    joint: Joint, law: Callable, theta: dict, x0s: np.ndarray, samples: int
) -> tuple[float, np.ndarray]:
    """Time of the forward pass, and the gradient with respect to θ."""
    import torch

    # These matrices are small: more threads only wait for each other, on a busy machine for long.
    torch.set_num_threads(1)
    tensor = lambda v: torch.tensor(np.asarray(v), dtype=torch.float64)
    q, r = (tensor(theta[name]).requires_grad_() for name in ("Q", "R"))
    begun = time.perf_counter()
    zero = torch.zeros((), dtype=torch.float64)
    L = torch.stack([torch.stack([q[0].exp(), zero]), torch.stack([q[1], q[2].exp()])])
    R, x, total = (2 * r).exp()[None], tensor(x0s), zero
    for _ in range(samples):
        u = law(x, L, R)
        stage = ((x @ tensor(joint.Q)) * x).sum(1) + ((u @ tensor(joint.R)) * u).sum(1)
        total = total + stage.mean()
        x = x @ tensor(joint.A).T + u @ tensor(joint.B).T
    forward = time.perf_counter() - begun
    (total / samples).backward()
    return forward, np.concatenate([q.grad.numpy(), r.grad.numpy()])


RIVALS = {"mpc.pytorch": mpc_pytorch, "cvxpylayers": cvxpylayers}
