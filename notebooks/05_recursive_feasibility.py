# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # 5. Recursive feasibility
#
# A plan that exists now need not exist at the next sample. You will learn how to refute the
# recursive feasibility of a controller by a counterexample, how to prove it by a longer horizon
# or by a terminal set, and how to draw the states that are lost.
#
# Lines that begin with `assert` check what the text says, for the numbers as they stand here; when
# you change a number, one may stop you: it says which sentence no longer holds, and may be deleted.

# %%
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

import jaxmpc as jm

# %% [markdown]
# ## A controller without a terminal ingredient
#
# A cart on a rail has position $p$ and velocity $v$, $|p| \le 1$ m, $|v| \le 1$ m/s, and is
# sampled once a second. The input may change the velocity by at most 0.25 m/s in a sample. The
# horizon is $N = 3$, and $x_N$ only has to keep the limits that hold at every other step.

# %%
system = jm.LinearSystem(A=np.array([[1.0, 1.0], [0.0, 1.0]]), B=np.array([[0.4], [1.0]]), dt=1.0)
limits = jm.Box(-np.ones(2), np.ones(2))
mpc = jm.MPC(
    system,
    Q=np.eye(2),
    R=10 * np.eye(1),
    horizon=3,
    states=limits,
    inputs=jm.Box(-0.25, 0.25),
    terminal_cost=np.eye(2),
    terminal_set=limits,
)

# %% [markdown]
# `recursive_feasibility` examines three claims about the feasible set $\mathcal X_N$, each weaker
# than the one before:
#
# * **strong**: every feasible first input leads to a state in $\mathcal X_N$;
# * **law**: the *optimal* first input does, which is recursive feasibility of the MPC law;
# * **weak**: at least *some* feasible first input does.
#
# For two states it enumerates the critical regions of the law, the polytopes on which the optimal
# input is affine. The distance of the next state from $\mathcal X_N$ is convex on each region, so
# the worst state of all is one of their vertices. We give it one sample state, because the
# sampling that it would do else is what we do ourselves below.

# %%
report = jm.recursive_feasibility(mpc, x0s=np.zeros((1, 2)), steps=1)
print(report)
worst = report.counterexample

# %%
claims = (report.strong, report.law, report.weak)
assert all(claim.holds is False for claim in claims), "All three claims are refuted."
assert np.isclose(worst.distance, 0.0474341649), "The next state is 0.0474 outside."
assert np.allclose(np.abs(worst.state), [0.95, 1.0]), "The law is refuted by ±(0.95, -1)."
assert np.prod(worst.state) < 0, "Position and velocity have opposite signs there."
assert np.isclose(report.volume, 1043 / 400), "The exact area of X_3 is 1043/400."
assert np.isclose(report.lost_by_law, 0.02), "The states lost have an area of 0.02."

# %% [markdown]
# All three claims are refuted. The law is refuted by $x = \pm(0.95, -1)$: this state has a feasible
# plan, and the state that follows is proved to be outside $\mathcal X_3$ by a half-space, at a
# distance of 0.0474. The states lost have an area of 0.02, under 1 % of the whole set, so a
# few random simulations could well miss them.

# %%
assert report.lost_by_law / report.volume < 0.01, "They are under 1 % of the whole set."

# %% [markdown]
# ## A failure on purpose
#
# We start closed loops on a grid, and one at the counterexample (the first row). At every sample
# `solve_many` plans for all of them; a loop is lost when its state is *proved* to have no plan.
# An optimal plan often lies exactly on a limit, where rounding would decide; so we contract each
# next state by $10^{-6}$ towards the origin, which can only help the controller.


# %%
def first_loss(mpc, x0s, steps=2):
    """Return the sample at which each loop is proved infeasible (−1: none), and all states."""
    x, lost, states = x0s, np.full(len(x0s), -1), [x0s]
    for k in range(steps + 1):
        plan = jm.solve_many(mpc, np.where(lost[:, None] < 0, x, 0.0))
        lost[(lost < 0) & (plan.status == jm.Status.PRIMAL_INFEASIBLE)] = k
        x = (1 - 1e-6) * (x @ system.A.T + plan.inputs[:, 0] @ system.B.T)
        states.append(x)
    return lost, np.stack(states)


x0s = np.vstack([worst.state, jm.grid(-1.0, 1.0, (61, 61))])
lost, states = first_loss(mpc, x0s)
counts = {k: int(np.sum(lost == k)) for k in range(3)}
print("infeasible at once, then lost at sample 1, 2:", list(counts.values()))
print(f"the first loop: lost at sample {lost[0]}, at x = {states[1, 0]}")
assert lost[0] == 1 and counts[1] > 0, "The first loop is lost after a single step."

# %% [markdown]
# The first loop stops with "no point satisfies the constraints" after a single step, although
# there is no disturbance and no model error, and every limit was kept so far. What happened? The
# plan at $t = 0$ looks three steps ahead. At $t = 1$ a fourth step comes into view, and at it no
# admissible input can brake in time: too much velocity is left so near the end of the rail. The
# solver is right; the *problem* at $t = 0$ was too optimistic.

# %%
corners = report.feasible_set.vertices()
order = lambda V: V[np.argsort(np.arctan2(V[:, 1], V[:, 0]))]
closed = lambda V: np.vstack([order(V), order(V)[:1]])

fig, (left, right) = plt.subplots(1, 2, figsize=(8, 3.5))
for axis in (left, right):
    axis.fill(*order(corners).T, color="0.9", label=f"$X_{{{mpc.horizon}}}$")
    axis.plot(*closed(corners).T, color="0.4", linewidth=1)
    axis.set(xlabel="position [m]", ylabel="velocity [m/s]")
gone = x0s[lost >= 1]
left.plot(*gone.T, ".", color="#d55e00", markersize=4, label="lost later")
left.plot(*worst.state, "k*", markersize=11, markeredgecolor="w", zorder=4, label="worst state")
left.set(xlim=(-1.1, 1.1), ylim=(-1.75, 1.15))
left.legend(loc="lower center", ncols=3, fontsize=8, columnspacing=1, handlelength=1.2)
sign = np.sign(worst.state[1])  # show the corner of the worst state
right.plot(*gone.T, ".", color="#d55e00", markersize=4, label="lost later")
right.annotate(
    "", xy=worst.next_state, xytext=worst.state, arrowprops=dict(arrowstyle="->", linewidth=1.2)
)
a, b = worst.normal, worst.offset
along = np.array([-a[1], a[0]]) / np.linalg.norm(a)
foot = worst.next_state - (a @ worst.next_state - b) / (a @ a) * a
right.plot(*np.stack([foot - along, foot + along]).T, "b--", linewidth=1, label="$a'x = b$")
right.plot(*worst.state, "k*", markersize=9, markeredgecolor="w", zorder=4, label="worst state")
right.plot(*worst.next_state, "ko", markersize=5, label="next state")
corner = np.sort(sign * np.array([[-1.05, 0.4], [0.2, 1.05]]), axis=1)
right.set(xlim=corner[0], ylim=corner[1])
right.legend(loc="lower right" if sign > 0 else "upper left", fontsize=8)
fig.tight_layout()

# %% [markdown]
# On the right the worst state (star) and where the optimal input takes it (dot). The dashed line
# is the half-space that is valid for every state with a feasible plan, and that excludes the dot.

# %% [markdown]
# ## Proof 1: one step more
#
# With $N = 4$ the same question is answered by linear programs alone, one for each facet.

# %%
longer = jm.recursive_feasibility(replace(mpc, horizon=mpc.horizon + 1))
print(longer)
refused = report.volume - longer.volume
assert longer.strong.holds and longer.law.holds, "With one step more it is proved."
assert np.isclose(longer.volume, 2.5875), "The area of X_4 is 2.5875."
assert np.isclose(refused, report.lost_by_law), "It is smaller by just what was lost."

# %% [markdown]
# The area is smaller than that of $\mathcal X_3$ by just what was lost, 0.02: the longer horizon
# does not lose these states, it refuses them from the start.

# %% [markdown]
# ## Proof 2: an invariant terminal set
#
# Theorem 1: if $\mathcal X_f$ is control invariant, every feasible plan can be shifted by one
# sample and continued inside $\mathcal X_f$, for any horizon. We take the largest set in which
# the LQR's $u = Kx$ keeps all limits for ever.

# %%
lqr = jm.lqr(system, mpc.Q, mpc.R)
terminal = jm.maximal_invariant_set(system, lqr.K, limits, mpc.inputs)
safe = replace(mpc, terminal_set=terminal, terminal_cost=lqr.P)
proof = jm.recursive_feasibility(safe)
print(proof)
assert proof.law.holds, "With an invariant terminal set it is proved."
small = jm.feasible_polytope(safe)
print(f"area: {small.volume():.4f} with the terminal set, {longer.volume:.4f} with one step more")
assert terminal.volume() < small.volume() < longer.volume, "The longer horizon costs fewer states."


# %%
def label(report, name="no terminal set"):
    """Return the horizon of the report's set, its name, and what was found about the law."""
    found = {True: "proved", False: "refuted", None: "open"}[report.law.holds]
    return f"$X_{{{report.mpc.horizon}}}$, {name} ({found})"


fig, axis = plt.subplots(figsize=(6, 3.5))
for body, name, style in (
    (report.feasible_set, label(report), "#d55e00"),
    (longer.feasible_set, label(longer), "#006f52"),
    (small, label(proof, "with terminal set"), "#0072b2"),
    (terminal, "terminal set", "0.5"),
):
    axis.plot(*closed(body.vertices()).T, color=style, label=name)
axis.set(xlabel="position [m]", ylabel="velocity [m/s]")
axis.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1, 1))
fig.tight_layout()

# %% [markdown]
# Both proofs cost states. Here the longer horizon costs fewer; the terminal set works for every
# horizon, and it is what stability proofs ask for.

# %% [markdown]
# ## Exercises
#
# 1. For $x^+ = x + u$, $|u| \le u_{\max}$, which $x_0$ have a plan of $N$
#    steps, if $|x_k| \le x_{\max}$ is imposed at $k = 0, \dots, N$? At $k = 1, \dots, N$? At
#    $k = N$ alone? Which of these is $|x_0| \le x_{\max} + N u_{\max}$?
# 2. For $x^+ = 2x + u$, $|x| \le 5$, $|u| \le 1$ the feasible set is $|x| \le 1 + 4 \cdot 2^{-N}$.
#    Confirm that for some $N$. Which states of it are lost sooner or later, whatever $N$ is?
# 3. Give the cart a stronger drive, $|u| \le 0.3$ m/s, at $N = 3$. Which of the three claims hold?

# %% [markdown]
# **Answer 1.** $x_{\max} + N u_{\max}$ is right only if the limit holds at $k = N$
# alone. With $k = 0$ among the steps, $x_0$ itself must keep the limit and nothing is gained; with
# $k = 1, \dots, N$ one input may be spent before the first check.

# %%
x_max, u_max, N = 1.0, 0.25, 5
scalar = jm.MPC(
    jm.LinearSystem(np.eye(1), np.eye(1)), np.eye(1), np.eye(1), N, inputs=jm.Box(-u_max, u_max)
)
limit = jm.Box(-x_max, x_max)
cases = {
    "k = 0 … N": (dict(states=limit, terminal_set=limit), x_max),
    "k = 1 … N": (dict(states=limit, constrained_stages=tuple(range(1, N + 1))), x_max + u_max),
    "k = N": (dict(terminal_set=limit), x_max + N * u_max),
}
for name, (fields, expected) in cases.items():
    radius = jm.feasible_polytope(replace(scalar, **fields)).volume() / 2
    print(f"{name:10} |x_0| <= {radius:.4f}")
    assert np.isclose(radius, expected), f"With the limit at {name} it is {expected}."

# %% [markdown]
# **Answer 2.** All states with $1 < |x| \le 1 + 4 \cdot 2^{-N}$ are lost: the input cannot hold
# them, $|2x + u| \ge 2|x| - 1 > |x|$, so they move away from the origin. Only $|x| \le 1$ can be
# kept for ever. A longer horizon makes the set of lost states smaller, never empty.

# %%
bound = jm.Box(-5.0, 5.0)
for N in (1, 3, 6):
    unstable = jm.MPC(
        jm.LinearSystem(2 * np.eye(1), np.eye(1)),
        *(np.eye(1), np.eye(1), N),
        states=bound,
        inputs=jm.Box(-1.0, 1.0),
        terminal_set=bound,
    )
    radius = jm.feasible_polytope(unstable).volume() / 2
    print(f"N = {N}: |x| <= {radius:.4f}")
    assert np.isclose(radius, 1 + 4 * 2.0**-N), "The feasible set is |x| <= 1 + 4 / 2^N."
x = 1.01  # the best that the input can do
path = [x]
while abs(path[-1]) <= 5:
    path.append(2 * path[-1] - 1.0)
print(f"from x = 1.01 the limit is broken after {len(path) - 1} steps, with the best input")

# %% [markdown]
# **Answer 3.** The report says which claims hold, and why. With 0.3 m/s the law does: the
# controller is recursively feasible.

# %%
stronger = jm.recursive_feasibility(replace(mpc, inputs=jm.Box(-0.3, 0.3)))
print(stronger)
assert stronger.law.holds and stronger.weak.holds, "With the stronger drive the law holds."
