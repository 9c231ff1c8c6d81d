# ---
# jupyter:
#   jupytext:
#     formats: py:percent,ipynb
#   kernelspec:
#     display_name: Python 3
#     name: python3
# ---

# %% [markdown]
# # 3. Terminal sets and stability
#
# A plan ends after $N$ steps; the robot does not. You will see an MPC controller whose every plan
# is optimal and whose closed loop falls over, and then repair it with a terminal cost and a
# terminal set. You will check the hypotheses of the stability theorem and watch the optimal cost
# decrease along the closed loop.
#
# Lines that begin with `assert` check what the text says, for the numbers as they stand here; when
# you change a number, one may stop you: it says which sentence no longer holds, and may be deleted.

# %%
import jax
import matplotlib.pyplot as plt
import numpy as np

import jaxmpc as jm

# The decrease of the optimal cost is compared to many digits: compute in float64.
jax.config.update("jax_enable_x64", True)

# %% [markdown]
# ## An unstable plant
#
# An inverted pendulum about its upright position, length 0.5 m, inertia 0.1 kg m², sampled every
# 0.05 s with the torque held constant in between. The torque is weak: at most 0.5 N m.

# %%
gravity, length, inertia = 9.81, 0.5, 0.1
system = jm.LinearSystem.from_continuous(
    np.array([[0.0, 1.0], [gravity / length, 0.0]]),
    np.array([[0.0], [1 / inertia]]),
    dt=0.05,
    state_names=("angle", "rate"),
    state_units=("rad", "rad/s"),
    input_names=("torque",),
    input_units=("N m",),
)
A, B = np.asarray(system.A), np.asarray(system.B)
x_max, u_max = np.array([0.5, 2.0]), 0.5
limits, torque = jm.Box(-x_max, x_max), jm.Box([-u_max], [u_max])
Q, R, N = np.diag([10.0, 1.0]), np.array([[10.0]]), 5
print("eigenvalues of A:", np.sort(np.linalg.eigvals(A).real).round(4))
assert np.abs(np.linalg.eigvals(A)).max() > 1, "The plant is unstable."

# %% [markdown]
# ## What goes wrong without terminal ingredients
#
# First the failure: a horizon of 5 steps, no terminal cost and no terminal set. The pendulum starts
# at 0.05 rad, at rest, far from all limits.

# %%
bare = jm.Controller(jm.MPC(system, Q, R, horizon=N, states=limits, inputs=torque))


def closed_loop(controller, x, steps):
    """Return states, inputs and optimal costs; stop where there is no plan."""
    states, inputs, costs = [np.asarray(x, float)], [], []
    for _ in range(steps):
        plan = controller.plan(states[-1])
        if int(plan.status) != jm.Status.SOLVED:
            print(f"step {len(inputs)}: {jm.Status(int(plan.status)).name}")
            break
        inputs.append(np.asarray(plan.inputs)[0])
        costs.append(float(plan.cost))
        states.append(A @ states[-1] + B @ inputs[-1])
    return np.array(states), np.array(inputs), np.array(costs)


start = np.array([0.05, 0.0])
fallen, fallen_inputs, _ = closed_loop(bare, start, 40)
assert len(fallen_inputs) < 40, "The pendulum falls until no plan exists."

# %% [markdown]
# Every plan up to there was optimal and kept all limits. Nevertheless the pendulum falls until no
# plan exists. There are two separate causes.
#
# **Cause 1: the cost does not see far enough.** While no limit is active, the law is linear,
# $u = K_N x$, with the gain of a Riccati recursion of $N$ steps that starts at zero, because there
# is no terminal cost. In 5 steps a fall that is just beginning costs little, and torque costs much:

# %%
P = np.zeros((2, 2))
for _ in range(N):
    K_N = -np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
    P = Q + A.T @ P @ (A + B @ K_N)
radius = np.abs(np.linalg.eigvals(A + B @ K_N)).max()
print(f"spectral radius of the closed loop: {radius:.4f}")
assert radius > 1, "Without limits in the way the loop is unstable."
assert np.allclose(fallen_inputs[0], K_N @ start, atol=1e-6), "The MPC law is this gain."

# %% [markdown]
# **Cause 2: the feasible set holds states that are lost.** Let $w'$ be the left eigenvector of the
# unstable eigenvalue $\lambda$, and $s = w' x$. Then $s_{k+1} = \lambda s_k + w' B u_k$, and once
# $|s| > |w' B|\, u_{\max} / (\lambda - 1)$, no torque makes $|s|$ smaller ever again. A horizon of
# 5 steps does not notice. Of the feasible set, this share is lost:

# %%
eigenvalues, vectors = (part.real for part in np.linalg.eig(A.T))  # all are real
unstable = int(np.argmax(eigenvalues))
w, growth = vectors[:, unstable], eigenvalues[unstable]
bound = abs(float((w @ B)[0])) * u_max / (growth - 1)
strip = jm.Polytope(np.stack([w, -w]), np.full(2, bound))
feasible = jm.feasible.feasible_polytope(bare.mpc)
lost = 1 - feasible.intersect(strip).volume() / feasible.volume()
print(f"{100 * lost:.1f} % of the feasible set is lost whatever the controller does")
assert lost > 0.2, "A good part of the feasible set is lost."

# %% [markdown]
# ## The repair
#
# The linear-quadratic regulator (LQR) is the optimal law for an infinite horizon without limits.
# Its cost is $x' P x$. With this $P$ as terminal cost, the plan accounts for everything that
# happens after $N$. (The sign is $u = K x$ here; many texts write $u = -K x$.)
#
# That cost is correct only if the LQR law keeps all limits after step $N$. So $x_N$ must lie in a
# set where it does, for ever. The largest such set is the maximal invariant set.

# %%
lqr = jm.lqr(system, Q, R)
K, P = np.asarray(lqr.K), np.asarray(lqr.P)
terminal_set = jm.maximal_invariant_set(system, K, limits, torque)
print(f"K = {K.round(3)}, terminal set with {len(np.asarray(terminal_set.h))} facets")
mpc = jm.MPC(
    system,
    Q,
    R,
    horizon=N,
    states=limits,
    inputs=torque,
    terminal_cost=P,
    terminal_set=terminal_set,
)

# %% [markdown]
# `verify_terminal` checks each hypothesis of the two theorems, with a margin and a sentence:
#
# * Theorem 1, recursive feasibility: if there is a plan now, there is one at the next sample.
# * Theorem 3, asymptotic stability of the origin on the whole feasible set.

# %%
report = jm.sets.verify_terminal(system, Q, R, P, terminal_set, limits, torque)
print(report)
assert report.recursive_feasibility and report.stability, "Both theorems apply."

# %% [markdown]
# The same check on the first controller names what is missing:

# %%
missing = jm.sets.verify_terminal(system, Q, R, np.zeros((2, 2)), None, limits, torque)
print(repr(missing))
assert not missing.recursive_feasibility and not missing.stability, "Neither applies."

# %% [markdown]
# ## Sets and trajectories
#
# The repaired controller has a smaller feasible set, and that is honest: what it gave up was mostly
# lost anyway. We start it at the same state, and at a vertex of its feasible set, moved inwards by
# 2 %.

# %%
repaired = jm.Controller(mpc)
honest = jm.feasible.feasible_polytope(mpc)
given_up = feasible.volume() - honest.volume()
assert lost * feasible.volume() > 0.5 * given_up, "Most of what it gave up was lost anyway."
corners = honest.vertices()
far = 0.98 * corners[np.argmax(corners @ w)]
near_states, _, _ = closed_loop(repaired, start, 60)
states, inputs, costs = closed_loop(repaired, far, 60)
assert len(inputs) == 60 and len(near_states) == 61, "There is a plan at each step."
for ended in (states[-1], near_states[-1]):
    assert np.abs(ended).max() < 1e-3, "The pendulum stands upright in the end."
assert np.all(np.abs(states) <= x_max + 1e-6), "All limits are kept."

# %%
figure, axis = plt.subplots(figsize=(7, 4), layout="constrained")
for body, color, name in (
    (feasible, "#dddcd8", "feasible, no terminal set"),
    (honest, "#9fcbe6", "feasible, terminal set"),
    (terminal_set, "#8fcfb4", "terminal set"),
):
    axis.fill(*body.vertices().T, color=color, label=name, lw=0)
line = np.array([-1.0, 1.0]) * x_max[0]
for sign in (-1, 1):
    label = "limit of what can be saved" if sign == 1 else None
    axis.plot(line, (sign * bound - w[0] * line) / w[1], "--", color="0.4", lw=1, label=label)
axis.plot(*fallen.T, ".-", color="#d55e00", label="falls")
axis.plot(*states.T, ".-", color="#00486b", label="returns")
axis.set(xlabel="angle [rad]", ylabel="rate [rad/s]", xlim=1.1 * line)
axis.set_ylim(-1.05 * x_max[1], 1.05 * x_max[1])
figure.legend(loc="outside right upper", fontsize=8)
plt.show()

# %% [markdown]
# ## Why it is stable
#
# Take the optimal plan, drop its first input and append $u = K x$ at the end. That is a feasible
# plan for the next sample, and its cost is smaller by at least the stage cost just paid. The
# optimal cost $V$ can only be smaller still:
#
# $$V(x_{k+1}) \le V(x_k) - \left( x_k' Q x_k + u_k' R u_k \right).$$
#
# So $V$ is a Lyapunov function. We check the inequality at each step.

# %%
paid = np.einsum("ki,ij,kj->k", states[:-1], Q, states[:-1]) + R[0, 0] * inputs[:, 0] ** 2
excess = costs[1:] - costs[:-1] + paid[:-1]
print(f"largest V(x+) - V(x) + stage cost: {excess.max():.1e}, for V up to {costs[0]:.1f}")
assert np.all(excess <= 1e-6), "The optimal cost falls by at least the stage cost."

# %%
time = 0.05 * np.arange(60)
figure, axis = plt.subplots(figsize=(6, 3.2), layout="constrained")
axis.semilogy(time, costs, ".-", color="#00486b", label="optimal cost V(x)")
axis.semilogy(time, paid, ".-", color="#d55e00", label="stage cost")
axis.set(xlabel="time [s]", ylabel="cost")
axis.legend()
plt.show()

# %% [markdown]
# ## Exercises
#
# 1. Show that the LQR satisfies $(A + BK)' P (A + BK) - P + Q + K' R K = 0$, and say what it means.
# 2. From which horizon on is the controller without terminal ingredients stable near the origin?
# 3. Terminal sets are often ellipsoids. `jm.sets.invariant_ellipsoid` returns the largest level set
#    of $x' P x$ in which the LQR keeps all limits. Compare its area with that of the polytope.

# %% [markdown]
# ### Answers
#
# **1.** Insert $K = -(R + B'PB)^{-1} B'PA$ into the Riccati equation. The identity says that along
# the LQR loop $x' P x$ falls in each step by exactly the stage cost. It makes the Lyapunov
# inequality of Theorem 3 an equality.

# %%
closed = A + B @ K
residual = closed.T @ P @ closed - P + Q + K.T @ R @ K
print(f"largest entry: {np.abs(residual).max():.1e}, for P up to {np.abs(P).max():.0f}")
assert np.abs(residual).max() < 1e-9 * np.abs(P).max(), "The identity holds."

# %% [markdown]
# **2.** Run the Riccati recursion and look at the spectral radius. Stability near the origin says
# nothing about feasibility farther away: cause 2 remains.

# %%
P_k, stable_from = np.zeros((2, 2)), None
for horizon in range(1, 40):
    gain = -np.linalg.solve(R + B.T @ P_k @ B, B.T @ P_k @ A)
    P_k = Q + A.T @ P_k @ (A + B @ gain)
    radius = np.abs(np.linalg.eigvals(A + B @ gain)).max()
    if stable_from is None and radius < 1:
        stable_from = horizon
        print(f"stable from N = {horizon} on, spectral radius {radius:.4f}")
assert stable_from == 9, "Stable from N = 9 on."

# %% [markdown]
# **3.** The ellipsoid lies inside the polytope, which is the largest set of all.

# %%
ellipsoid = jm.sets.invariant_ellipsoid(system, K, P, limits, torque)
share = ellipsoid.volume() / terminal_set.volume()
print(f"ellipsoid {ellipsoid.volume():.4f}, polytope {terminal_set.volume():.4f}: {share:.0%}")
inside = all(bool(terminal_set.contains(x, 1e-9)) for x in ellipsoid.boundary(100))
assert inside, "The ellipsoid lies inside the polytope."
