# ---
# jupyter:
#   jupytext:
#     formats: py:percent,ipynb
#   kernelspec:
#     display_name: Python 3
#     name: python3
# ---

# %% [markdown]
# # 4. Soft constraints
#
# A controller must do something even where no plan keeps all limits. You will soften the limits of
# the robot joint with slack variables, and see that a penalty that is too small gives limits away
# that could be kept. Then you will compute the exact threshold from which this cannot happen.
#
# Lines that begin with `assert` check what the text says, for the numbers as they stand here; when
# you change a number, one may stop you: it says which sentence no longer holds, and may be deleted.

# %%
import jax
import matplotlib.pyplot as plt
import numpy as np

import jaxmpc as jm

# Slacks are compared with zero to many digits: compute in float64.
jax.config.update("jax_enable_x64", True)

# %% [markdown]
# ## The joint, and a push
#
# The joint of the earlier notebooks, with the cost of the linear-quadratic regulator as terminal
# cost and the limits asked for at all steps $k = 0, \dots, 20$. At $q = 1.46$ rad and
# $\dot q = 1.9$ rad/s it is within its limits, but its braking distance is too long.

# %%
T, J, N = 0.01, 0.05, 20
system = jm.LinearSystem(
    np.array([[1.0, T], [0.0, 1.0]]),
    np.array([[0.0], [T / J]]),
    dt=T,
    state_names=("q", "dq"),
    state_units=("rad", "rad/s"),
    input_names=("torque",),
    input_units=("N m",),
)
q_max, dq_max, u_max = 1.5, 2.0, 2.0
limits, torque = jm.Box([-q_max, -dq_max], [q_max, dq_max]), jm.Box([-u_max], [u_max])
Q, R = np.diag([50.0, 1.0]), np.array([[0.1]])
P = np.asarray(jm.lqr(system, Q, R).P)
hard = jm.MPC(system, Q, R, N, limits, torque, terminal_cost=P, terminal_set=limits)

feasible = jm.feasible.feasible_polytope(hard)
pushed = np.array([1.46, 1.9])
print("within the limits:", bool(limits.contains(pushed)))
print("in the feasible set:", bool(feasible.contains(pushed)))
assert bool(limits.contains(pushed)), "The joint is within its limits."
assert not bool(feasible.contains(pushed)), "But its braking distance is too long."

# %% [markdown]
# `soften` replaces each limit $h$ on a state by $h + \varepsilon$ with a slack
# $\varepsilon \ge 0$, and adds $\rho \sum \varepsilon$ to the cost. Limits on torque stay hard:
# they are physics. The soft problem has a plan from every state.

# %%
soft = jm.soften(hard, rho=1000.0)
plan = jm.solve(soft, pushed)
slack = np.asarray(plan.slack)
print(plan.sentence)
highest = np.asarray(plan.states)[:, 0].max()
braking = T * np.arange(pushed[1], 0, -T / J * u_max).sum()  # with full torque, see notebook 00
print(f"q goes up to {highest:.4f} rad; braking takes {braking:.4f} rad")
assert int(plan.status) == jm.Status.SOLVED, "The soft problem has a plan."
assert np.isclose(highest, pushed[0] + braking, atol=1e-6), "The violation is the least possible."

# %%
time = T * np.arange(N + 1)
figure, axis = plt.subplots(figsize=(6, 3.2), layout="constrained")
axis.axhspan(q_max, q_max + 0.03, color="#d55e00", alpha=0.25, lw=0, label="beyond the limit")
axis.plot(time, np.asarray(plan.states)[:, 0], ".-", color="#00486b")
axis.set(xlabel="time [s]", ylabel="q [rad]", ylim=(q_max - 0.12, q_max + 0.03))
axis.legend(loc="lower left")
axis.set_title("After a push: the least possible violation", fontsize=11)
plt.show()

# %% [markdown]
# ## A failure: a penalty that is too small
#
# Now a state from which all limits can be kept: $q = -1.2$ rad, $\dot q = 0.1$ rad/s. The hard
# problem has a plan. We choose $\rho = 10$, which may look large beside $R = 0.1$.

# %%
small = 10.0
x0 = np.array([-1.2, 0.1])
reference_plan = jm.solve(hard, x0)
assert int(reference_plan.status) == jm.Status.SOLVED, "All limits can be kept from here."
cheap = jm.solve(jm.soften(hard, rho=small), x0)
peaks = [float(np.asarray(p.states)[:, 1].max()) for p in (reference_plan, cheap)]
print(f"largest velocity: hard {peaks[0]:.4f} rad/s")
print(f"soft with rho = {small:g}: {peaks[1]:.4f} rad/s")
assert peaks[0] <= dq_max + 1e-6, "The hard plan keeps the limit."
assert peaks[1] > dq_max + 0.05, "The soft one breaks it."

# %%
figure, axis = plt.subplots(figsize=(6, 3.2), layout="constrained")
top = 1.08 * max(*peaks, dq_max)
axis.axhspan(dq_max, top, color="#d55e00", alpha=0.25, lw=0, label="beyond the limit")
axis.plot(time, np.asarray(reference_plan.states)[:, 1], ".-", color="#00486b", label="hard")
soft_name = f"soft, ρ = {small:g}"
axis.plot(time, np.asarray(cheap.states)[:, 1], ".-", color="#d55e00", label=soft_name)
axis.set(xlabel="time [s]", ylabel="dq [rad/s]", ylim=(0, top))
axis.legend(loc="lower right")
plt.show()

# %% [markdown]
# The soft plan breaks the velocity limit although it need not. It is not a numerical error: to go
# faster saves more cost than $\rho \varepsilon$ takes. The multiplier of a limit is the price at
# which the optimal cost would buy more of it (notebook 01). If $\rho$ is below that price, the plan
# buys.
#
# **Exact penalty.** The soft and the hard problem have the same plan at $x$ if and only if
# $\rho \ge \bar\rho(x)$, the largest multiplier of the softened limits at $x$. (If the multipliers
# are not unique, take those for which the largest is least.) `exact_penalty` computes the supremum
# $\bar\rho$ over the whole feasible set. It goes through all critical regions, the polytopes on
# which the plan is affine in the state.

# %%
line = np.stack([np.linspace(-1.49, 1.49, 81), np.full(81, 0.1)], axis=1)
result = jm.explicit.exact_penalty(hard, np.vstack([x0, line]), rho=small)
print(result.sentence)
threshold = float(result.thresholds[0])
print(f"threshold at x0: {threshold:.4f}")
assert result.exact, "All critical regions were found."
assert result.sufficient is False and small < threshold, "This penalty is too small."
assert threshold < result.rho_bar, "Other states need a larger one."

# %%
figure, axis = plt.subplots(figsize=(6, 3.2), layout="constrained")
axis.plot(line[:, 0], result.thresholds[1:], color="#00486b", label=f"at dq = {x0[1]:g} rad/s")
axis.axhline(result.rho_bar, color="#d55e00", ls="--", label="supremum over the feasible set")
axis.plot(x0[0], threshold, "o", color="#00486b", label="at x0")
axis.set(xlabel="q [rad]", ylabel="threshold of ρ [cost per unit]", ylim=(-1, None))
axis.legend(loc=(0.26, 0.55), fontsize=9)
plt.show()

# %% [markdown]
# Near the middle no limit is active, and every positive $\rho$ will do. Beyond, the threshold
# rises with the distance that the joint wants to cover in a hurry.
#
# Theory says that the slack vanishes exactly at the threshold. Measured:

# %%
factors = np.array([0.2, 0.4, 0.6, 0.8, 0.9, 0.95, 0.99, 1.01, 1.1, 1.5, 2.0])
largest = []
for factor in factors:
    answer = jm.solve(jm.soften(hard, rho=factor * threshold), x0)
    assert int(answer.status) == jm.Status.SOLVED, "Soft problems have plans."
    largest.append(float(np.asarray(answer.slack).max()))
largest = np.array(largest)
assert np.all(largest[factors > 1] < 1e-7), "Above the threshold there is no slack."
assert np.all(largest[factors < 1] > 1e-5), "Below it there is some."

# %%
figure, axis = plt.subplots(figsize=(6, 3.2), layout="constrained")
axis.plot(factors * threshold, largest, "o-", color="#00486b")
axis.axvline(threshold, color="#d55e00", ls="--", label="threshold at x0")
axis.set(xlabel="penalty ρ [cost per unit]", ylabel="largest slack [rad/s]")
axis.legend()
plt.show()

# %% [markdown]
# Two practical remarks. A penalty above $\bar\rho$ is exact for all feasible states;
# `result.advised` adds a margin. And the threshold is measured in cost per unit of the row: a
# limit written in degrees in place of radians has a different one.

# %% [markdown]
# ## Exercises
#
# 1. Suppose that the optimum of the problem without the soft limits already keeps them. Show that
#    the slack is zero for every $\rho > 0$, and test it from $x_0 = (0.05, -0.1)$.
# 2. Replace the linear penalty by a quadratic one, $k \sum \varepsilon^2$. From which $k$ on is the
#    slack zero at $(-1.2, 0.1)$?
# 3. Find the threshold at $(-1.2, 0.1)$ in the multipliers of the hard plan.

# %% [markdown]
# ### Answers
#
# **1.** Let $x^\star$ be that optimum. For every trajectory $x$ and every slack $\varepsilon$ that
# it needs, $J(x) + \rho \sum \varepsilon \ge J(x) \ge J(x^\star)$, and $x^\star$ reaches this bound
# with $\varepsilon = 0$. It is the only optimum, because the cost is strictly convex in the inputs.

# %%
for rho in (1e-3, 1.0, 1e3):
    answer = jm.solve(jm.soften(hard, rho=rho), np.array([0.05, -0.1]))
    most = float(np.asarray(answer.slack).max())
    print(f"rho = {rho:g}: largest slack {most:.1e}")
    assert most < 1e-9, "The slack is zero for every rho."

# %% [markdown]
# **2.** From none. At $\varepsilon = 0$ the derivative of $k \varepsilon^2$ is zero, so that a
# small violation is always worth its price. It shrinks as $1 / k$ but never vanishes.

# %%
violations = []
for k in (1e2, 1e3, 1e4):
    answer = jm.solve(jm.soften(hard, rho=0.0, quadratic=k), x0)
    violations.append(float(np.asarray(answer.slack).max()))
    print(f"k = {k:g}: largest slack {violations[-1]:.2e} rad/s")
assert np.all(np.array(violations) > 1e-5), "The slack never vanishes."
assert np.all(np.diff(violations) < 0), "It shrinks."

# %% [markdown]
# **3.** It is the largest multiplier of a limit on the state or on the terminal state.

# %%
multipliers = reference_plan.multipliers
found = max(
    float(np.abs(np.asarray(multipliers.states)).max()),
    float(np.abs(np.asarray(multipliers.terminal)).max()),
)
print(f"largest multiplier {found:.6f}, threshold {threshold:.6f}")
assert np.isclose(found, threshold, rtol=1e-6), "The threshold is the largest multiplier."
