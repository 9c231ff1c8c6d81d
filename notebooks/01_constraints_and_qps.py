# ---
# jupyter:
#   jupytext:
#     formats: py:percent,ipynb
#   kernelspec:
#     display_name: Python 3
#     name: python3
# ---

# %% [markdown]
# # 1. Constraints and quadratic programs
#
# You will turn a small MPC problem into a quadratic program (QP) by hand, solve it, and check with
# three residuals that the answer is right. You will read the active constraints from the Lagrange
# multipliers, and verify a proof that another QP has no solution.
#
# Lines that begin with `assert` check what the text says, for the numbers as they stand here; when
# you change a number, one may stop you: it says which sentence no longer holds, and may be deleted.

# %%
import jax
import matplotlib.pyplot as plt
import numpy as np

import jaxmpc as jm

# JAX computes in float32 unless told otherwise. This notebook compares numbers to nine digits.
jax.config.update("jax_enable_x64", True)

# %% [markdown]
# ## From MPC to a QP
#
# The joint of notebook 00, over a horizon of only $N = 2$ steps, so that we can draw everything:
#
# $$x_{k+1} = A x_k + B u_k, \quad
# \min \sum_{k<2} (x_k' Q x_k + u_k' R u_k) + x_2' P x_2, \quad |x_k| \le x_{\max},\ |u_k| \le 2 .$$
#
# The velocity limit is the one that will matter. We ask for it at $k = 1$ and, by a terminal set,
# at $k = 2$. (The optimisation cannot change $x_0$; rows at $k = 0$ only say whether $x_0$ itself
# is allowed.)

# %%
T, J, N = 0.01, 0.05, 2
A = np.array([[1.0, T], [0.0, 1.0]])
B = np.array([[0.0], [T / J]])
Q, R, P = np.diag([50.0, 1.0]), np.array([[0.1]]), np.diag([1500.0, 0.1])
x_max, u_max = np.array([1.5, 2.0]), 2.0
x0 = np.array([-0.5, 1.8])

# %% [markdown]
# Insert the model: $x_1 = A x_0 + B u_0$ and $x_2 = A^2 x_0 + A B u_0 + B u_1$. With
# $z = (u_0, u_1)$ every predicted state is $x_k = \Phi_k x_0 + \Gamma_k z$. The states are gone,
# which is called condensing. What is left is a QP in the standard form
#
# $$\min_z\ \tfrac12 z' P_z z + q' z \quad \text{subject to} \quad l \le C z \le u .$$
#
# Mind the factor: the MPC cost has no ½, the QP has, so that $P_z$ holds twice the weights.

# %%
Phi = [np.eye(2), A, A @ A]
Gamma = [np.zeros((2, 2)), np.hstack([B, np.zeros((2, 1))]), np.hstack([A @ B, B])]
weights = [Q, Q, P]
P_z = 2 * (sum(G.T @ W @ G for G, W in zip(Gamma, weights, strict=True)) + R[0, 0] * np.eye(N))
q = 2 * sum(G.T @ W @ F @ x0 for F, G, W in zip(Phi, Gamma, weights, strict=True))
C = np.vstack([np.eye(N), Gamma[1], Gamma[2]])  # two torques, then x_1, then x_2
free = np.concatenate([np.zeros(N), Phi[1] @ x0, Phi[2] @ x0])  # what z = 0 gives
bound = np.concatenate([np.full(N, u_max), x_max, x_max])
qp = jm.QP(P_z, q, C, l=-bound - free, u=bound - free)
solution = jm.solve_qp(qp)
z = np.asarray(solution.z)
print(solution.sentence)
print("torques:", z, "N m")
assert int(solution.status) == jm.Status.SOLVED, "The program is solved."

# %% [markdown]
# `jm.solve` does the same from the MPC problem. The inputs and the cost agree; the constant
# $\sum_k (\Phi_k x_0)' W_k (\Phi_k x_0)$ is the part of the cost that no torque changes.

# %%
names = {
    "state_names": ("q", "dq"),
    "state_units": ("rad", "rad/s"),
    "input_names": ("torque",),
    "input_units": ("N m",),
}
system = jm.LinearSystem(A, B, dt=T, **names)
limits = jm.Box(-x_max, x_max)
mpc = jm.MPC(
    system, Q, R, N, limits, jm.Box([-u_max], [u_max]), terminal_cost=P, terminal_set=limits
)
plan = jm.solve(mpc, x0)
constant = sum(x0 @ F.T @ W @ F @ x0 for F, W in zip(Phi, weights, strict=True))
assert np.allclose(np.asarray(plan.inputs)[:, 0], z, atol=1e-7), "The inputs agree."
total = float(solution.cost) + constant
assert np.isclose(float(plan.cost), total, rtol=1e-9), "The costs agree, but for the constant."
print(f"cost {float(plan.cost):.6f} = {float(solution.cost):.6f} + {constant:.6f}")

# %% [markdown]
# With two variables we can look at it. Ellipses are level lines of the cost; the shaded area is
# what the constraints allow.

# %%
unconstrained = np.linalg.solve(P_z, -q)
span = np.linspace(-6, 11, 400)
U0, U1 = np.meshgrid(span, span)
points = np.stack([U0.ravel(), U1.ravel()])
cost = (0.5 * np.sum(points * (P_z @ points), axis=0) + q @ points).reshape(U0.shape)
rows = C @ points
allowed = np.all((rows >= qp.l[:, None]) & (rows <= qp.u[:, None]), axis=0).reshape(U0.shape)
best = 0.5 * unconstrained @ P_z @ unconstrained + q @ unconstrained
figure, axis = plt.subplots(figsize=(6, 3.8), layout="constrained")
axis.contourf(U0, U1, allowed, levels=[0.5, 1.5], colors=["#9fcbe6"])
levels = best + (float(solution.cost) - best) * np.array([0.05, 0.25, 0.6, 1.0, 1.5])
axis.contour(U0, U1, cost, levels=levels, colors="0.5", linewidths=0.8, linestyles="-")
axis.plot(*unconstrained, "o", color="#d55e00", label="optimum without constraints")
axis.plot(*z, "o", color="#00486b", label="optimum with constraints")
axis.set(xlabel="torque $u_0$ [N m]", ylabel="torque $u_1$ [N m]", xlim=(-3, 9), ylim=(-5, 5))
axis.legend(loc="upper right", fontsize=9)
plt.show()

# %% [markdown]
# ## Is it the optimum? Three residuals
#
# A solver stops at some point; whether that point is the solution is a separate question. For a
# convex QP a pair $(z, y)$ is optimal exactly when the Karush–Kuhn–Tucker (KKT) conditions hold.
# Three numbers measure how far they are from holding:
#
# * the primal residual: by how much $l \le C z \le u$ is violated,
# * the dual residual: the size of $P_z z + q + C' y$,
# * the gap: primal cost minus dual cost,
#   $z' P_z z + q' z + u' y^+ - l' y^-$, with $y^+ = \max(y, 0)$, $y^- = \max(-y, 0)$.

# %%


def residuals(qp, z, y):
    """Return primal residual, dual residual and duality gap of a QP with finite bounds."""
    rows = qp.A @ z
    primal = max(float(np.max(qp.l - rows)), float(np.max(rows - qp.u)), 0.0)
    dual = float(np.max(np.abs(qp.P @ z + qp.q + qp.A.T @ y)))
    above, below = np.maximum(y, 0), np.maximum(-y, 0)
    gap = abs(float(z @ qp.P @ z + qp.q @ z + qp.u @ above - qp.l @ below))
    return primal, dual, gap


ours = residuals(qp, z, np.asarray(solution.y))
theirs = [float(r) for r in (solution.primal_residual, solution.dual_residual, solution.gap)]
for name, mine, stated in zip(("primal", "dual", "gap"), ours, theirs, strict=True):
    print(f"{name:7} computed here {mine:.1e}, stated by the solver {stated:.1e}")
assert max(ours) < 1e-6 and max(theirs) < 1e-6, "All three are within tolerance, ours and theirs."

# %% [markdown]
# The status `SOLVED` says that these three residuals are within tolerance ($10^{-6}$ in float64).
# It does not say that a number of iterations was reached.

# %% [markdown]
# ## Active constraints
#
# A row with a multiplier $y_i \ne 0$ is active: it pushes the optimum. The multiplier is also a
# price. If the bound of such a row is relaxed by a small $\delta$, the optimal cost falls by
# $|y_i|\,\delta$ to first order.

# %%
active = jm.mpc.active_constraints(mpc, plan)
for constraint in active:
    print(constraint)
found = [(constraint.name.split()[0], constraint.stage) for constraint in active]
assert found == [("dq", 1)], "One constraint is active: the velocity limit at k = 1."

# %%
rows = ["u_0", "u_1", "q in x_1", "dq in x_1", "q in x_2", "dq in x_2"]  # of C
row = int(np.argmax(np.abs(solution.y)))  # the one that pushes most
price, delta = abs(float(solution.y[row])), 1e-4
side = delta * np.eye(len(rows))[row]  # a multiplier below zero belongs to the lower bound
upper, lower = (side, 0 * side) if solution.y[row] > 0 else (0 * side, side)
relaxed = jm.QP(qp.P, qp.q, qp.A, qp.l - lower, qp.u + upper)
cheaper = float(solution.cost) - float(jm.solve_qp(relaxed).cost)
print(f"row of {rows[row]}: the cost falls by {cheaper / delta:.5f} a unit")
print(f"its multiplier is {price:.5f}")
assert np.isclose(cheaper / delta, price, rtol=1e-3), "The multiplier is the price of the bound."
assert np.isclose(abs(active[0].multiplier), price, rtol=1e-6), "The plan has the same multiplier."

# %% [markdown]
# ## A failure, and its proof
#
# Now the joint runs at 2.9 rad/s, faster than its limit of 2 rad/s. (In practice: somebody pushed
# it.) Can two steps of at most 2 N m bring it back to 2 rad/s at $k = 1$ and $k = 2$?

# %%
too_fast = np.array([-0.5, 2.9])
free = np.concatenate([np.zeros(N), Phi[1] @ too_fast, Phi[2] @ too_fast])
slope = 2 * sum(G.T @ W @ F @ too_fast for F, G, W in zip(Phi, Gamma, weights, strict=True))
impossible = jm.QP(P_z, slope, C, l=-bound - free, u=bound - free)
answer = jm.solve_qp(impossible)
print(answer.sentence)
assert int(answer.status) == jm.Status.PRIMAL_INFEASIBLE, "Two steps cannot bring it back."

# %% [markdown]
# "No solution found" would be a weak answer: perhaps the solver was not patient enough. The
# answer here is stronger. By Farkas' lemma the constraints $l \le C z \le u$ contradict each other
# exactly if there is a vector $y$ with
#
# $$C' y = 0 \quad\text{and}\quad u' y^+ - l' y^- < 0 .$$
#
# The reason is one line: for every $z$ within the bounds
# $0 = y' C z \le u' y^+ - l' y^- < 0$, which is impossible. The solver returns such a $y$, and we
# can check it without knowing how it was found.

# %%
y = np.asarray(answer.certificate)
value = impossible.u @ np.maximum(y, 0) - impossible.l @ np.maximum(-y, 0)
print("certificate:", np.round(y / np.abs(y).max(), 3))
print(f"largest entry of C'y: {np.abs(C.T @ y).max():.1e};  u'y+ - l'y-: {value:.4f}")
assert np.abs(C.T @ y).max() < 1e-12 * np.abs(y).max(), "C'y is zero."
assert value < 0, "u'y+ - l'y- is negative: this is a certificate."

# %% [markdown]
# The certificate also explains the conflict. Multiply the row of the velocity $\dot q_1$ by 1 and
# the row of $u_0$ by $-T/J = -0.2$: the variable cancels, and what is left says
# $\dot q_0 - 0.2 \cdot 2 \le 2$. The limit of the velocity can be kept at $k = 1$ only if
# $\dot q_0 \le 2.4$ rad/s. A vector made by this argument is a certificate too:

# %%
by_hand = np.zeros(6)
by_hand[0], by_hand[3] = -T / J, 1.0
value = impossible.u @ np.maximum(by_hand, 0) - impossible.l @ np.maximum(-by_hand, 0)
dq_max = x_max[1]
most = dq_max + T / J * u_max  # from which one step of full torque brakes to the limit
print(f"certificate by hand: u'y+ - l'y- = {value:.2f} rad/s = {most:g} - {too_fast[1]:g}")
assert np.allclose(C.T @ by_hand, 0), "The variables cancel."
assert np.isclose(value, most - too_fast[1]), "What is left is the bound of dq_0."
assert np.isclose(most, 2.4), "The velocity limit can be kept from 2.4 rad/s at most."

# %% [markdown]
# ## Exercises
#
# 1. Write the KKT conditions of the QP above and check each of the four (stationarity, primal
#    feasibility, dual feasibility, complementary slackness) for the solution.
# 2. How far must all bounds of the infeasible QP be widened until a solution exists? Answer with
#    `jm.qp.feasibility_margin`, then by hand.
# 3. The certificate by hand gives a half-space of initial states. Which one?

# %% [markdown]
# ### Answers
#
# **1.** Split the multiplier of each two-sided row: $\lambda^+ = y^+$ belongs to $C z \le u$ and
# $\lambda^- = y^-$ to $l \le C z$.

# %%
y = np.asarray(solution.y)
above, below = np.maximum(y, 0), np.maximum(-y, 0)
rows = C @ z
stationarity = np.abs(P_z @ z + q + C.T @ (above - below)).max()
primal = max(np.max(rows - qp.u), np.max(qp.l - rows), 0.0)
slackness = max(np.abs(above * (qp.u - rows)).max(), np.abs(below * (rows - qp.l)).max())
print(f"stationarity {stationarity:.1e}, primal {primal:.1e}, slackness {slackness:.1e}")
assert max(stationarity, primal, slackness) < 1e-6, "Three of the conditions hold, to 1e-6."
assert above.min() >= 0 and below.min() >= 0, "And no multiplier is negative."

# %% [markdown]
# **2.** The margin is negative: every bound must give way by its absolute value. By hand: widen
# torque and velocity by $t$, then $2.9 - 0.2\,(2 + t) \le 2 + t$, so that
# $t = 0.5 / 1.2$. (The limits at $k = 1$ decide; those at $k = 2$ can do so for other numbers.)

# %%
margin, status = jm.qp.feasibility_margin(impossible)
assert int(status) == jm.Status.SOLVED, "The margin is found."
first = (most - too_fast[1]) / (1 + T / J)
print(f"margin {float(margin):.6f}; by hand {first:.6f}")
assert np.isclose(float(margin), first, atol=1e-6), "The limits at k = 1 decide."

# %% [markdown]
# **3.** The certificate uses $x_0$ only through the bounds, which are affine in $x_0$. It proves
# infeasible every state with $u(x_0)' y^+ - l(x_0)' y^- < 0$, that is, every state with
# $\dot q_0 > 2.4$ rad/s: one proof for infinitely many states. Notebook 02 builds on this.

# %%


def excluded(x):
    """Return whether the certificate made by hand proves the state x infeasible."""
    shift = np.concatenate([np.zeros(N), Phi[1] @ x, Phi[2] @ x])
    upper, lower = bound - shift, -bound - shift
    return bool(upper @ np.maximum(by_hand, 0) - lower @ np.maximum(-by_hand, 0) < 0)


for q0 in (-1.0, 0.0, 1.2):
    fast, slow = (np.array([q0, most + d]) for d in (1e-3, -1e-3))
    assert excluded(fast) and not excluded(slow), "It excludes what is faster, whatever q is."
print(f"excluded: all states with dq > {most:g} rad/s")
