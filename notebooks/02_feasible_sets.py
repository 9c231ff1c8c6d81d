# ---
# jupyter:
#   jupytext:
#     formats: py:percent,ipynb
#   kernelspec:
#     display_name: Python 3
#     name: python3
# ---

# %% [markdown]
# # 2. Feasible sets
#
# From which initial states can an MPC controller keep all its limits? You will map this set for
# the robot joint, enclose its area between two bounds that meet at 1489/125, and check two of the
# proofs behind the map yourself, in exact arithmetic.
#
# Lines that begin with `assert` check what the text says, for the numbers as they stand here; when
# you change a number, one may stop you: it says which sentence no longer holds, and may be deleted.

# %%
import subprocess
import sys
import tempfile
from fractions import Fraction

import jax
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import ListedColormap

import jaxmpc as jm

# %% [markdown]
# ## The map
#
# The joint of notebook 00, with 20 steps of 0.01 s. The feasible set $\mathcal X_N$ holds the
# states $x_0$ for which there are inputs $u_0, \dots, u_{N-1}$ that keep all limits. The cost plays
# no role. We label a grid that extends somewhat beyond the limits.

# %%
T, J = 0.01, 0.05
A, B = np.array([[1.0, T], [0.0, 1.0]]), np.array([[0.0], [T / J]])
system = jm.LinearSystem(
    A,
    B,
    dt=T,
    state_names=("q", "dq"),
    state_units=("rad", "rad/s"),
    input_names=("torque",),
    input_units=("N m",),
)
q_max, dq_max, u_max, N = 1.5, 2.0, 2.0, 20
limits, torque = jm.Box([-q_max, -dq_max], [q_max, dq_max]), jm.Box([-u_max], [u_max])
Q, R = np.diag([50.0, 1.0]), np.array([[0.1]])
mpc = jm.MPC(system, Q, R, horizon=N, states=limits, inputs=torque, terminal_cost=Q)

shape = (64, 64)
x0s = jm.grid([-1.07 * q_max, -1.05 * dq_max], [1.07 * q_max, 1.05 * dq_max], shape)
fmap = jm.map_feasible_set(mpc, x0s)
print(fmap.counts())
assert fmap.counts()["undecided"] == 0, "Every state has a label."

# %% [markdown]
# Every state has one of three labels: 1, proved feasible; −1, proved infeasible; 0, undecided.
#
# The labels give more than a picture. The feasible set is convex, so the convex hull of all states
# proved feasible lies inside it: an inner bound. Each infeasible state comes with a half-space
# $a'x \le b$ that holds on the whole feasible set; the intersection of all these is an outer bound.

# %%
low, high = fmap.volume_bounds()
print(f"area between {low:.3f} and {high:.3f}{mpc.volume_unit()}")
assert low < 1489 / 125 < high, "The bounds enclose 1489/125."

# %% [markdown]
# `refine()` closes the gap. It sends rays through the vertices of the outer polygon; each ray ends
# at a boundary point and adds the half-space that stops it.

# %%
fmap = fmap.refine()
low, high = fmap.volume_bounds()
print(f"area between {low:.9f} and {high:.9f}{mpc.volume_unit()}")
assert (high - low) / high < 1e-6, "The bounds meet."
assert low <= 1489 / 125 <= high, "They meet at 1489/125."


# %%
def draw(label, title, outline=True):
    """Draw labels on the grid, and the outline of the feasible set."""
    figure, axis = plt.subplots(figsize=(7, 3.6), layout="constrained")
    colors = {"infeasible": "#dddcd8", "feasible": "#9fcbe6"}
    q, dq = (np.unique(column) for column in x0s.T)
    cells = label.reshape(shape).T
    cmap = ListedColormap([*colors.values()])
    axis.pcolormesh(q, dq, cells, cmap=cmap, vmin=-1, vmax=1, rasterized=True)
    for name, color in colors.items():
        axis.plot([], [], "s", color=color, label=name)
    if outline:
        corners = fmap.outer().vertices()
        corners = np.vstack([corners, corners[:1]])
        axis.plot(*corners.T, color="#d55e00", lw=1.5, label="boundary", zorder=3)
    axis.set(xlabel=fmap.axis_names[0], ylabel=fmap.axis_names[1], title=title)
    figure.legend(loc="outside right upper", fontsize=9)
    return axis


draw(fmap.label, "Initial states from which all limits can be kept")
plt.show()

# %% [markdown]
# Almost all of the box of limits is feasible, but for two slivers: fast towards the upper stop,
# and fast towards the lower one. Notebook 00 explained them by the braking distance. With full
# torque the velocity falls by $T u_{\max} / J = 0.4$ rad/s in each step, so $\dot q = v$ needs
#
# $$q \le 1.5 - 0.01 \sum_{j \ge 0} \max(v - 0.4 j,\ 0).$$
#
# The area that this cuts off the box is an integral over $v$ from 0 to 2, twice. The integral of
# $\max(v - 0.4 j, 0)$ is $(2 - 0.4 j)^2 / 2$ where $0.4 j < 2$. In fractions:


# %%
def exact_area(u_max):
    """Return the area for torques up to u_max, for a horizon that is long enough to stop."""
    period, inertia, top, speed, u = (
        Fraction(str(number)) for number in (T, J, q_max, dq_max, u_max)
    )
    per_step = period * u / inertia  # by which full torque brakes in a step
    steps = [j for j in range(N) if per_step * j < speed]
    assert per_step * N >= speed, "Longer than N steps of braking: this formula does not hold."
    removed = period * sum((speed - per_step * j) ** 2 / 2 for j in steps)
    return 2 * top * 2 * speed - 2 * removed


area = exact_area(u_max)
print(f"exact area: {area} = {float(area):.9f}, between {low:.9f} and {high:.9f}")
assert low <= area <= high, "The integral agrees with the bounds."
assert area == Fraction(1489, 125), "It is 1489/125."

# %% [markdown]
# ## What a proof is
#
# **Feasible.** The proof is a plan. Anybody can roll it out and compare with the limits. Every
# floating-point number is a fraction, so that this can be done without rounding at all:

# %%
feasible = np.flatnonzero(fmap.label == 1)
chosen = feasible[np.argmax(x0s[feasible] @ np.array([1.0, 0.5]))]  # fast, and close to the stop
exact = np.vectorize(Fraction)
A_exact, B_exact = exact(A), exact(B)
x = exact(x0s[chosen])
most_q, most_dq, most_u = exact([q_max, dq_max, u_max])
margin = most_u
for u in exact(fmap.labels.plan[chosen]):
    margin = min(margin, most_u - abs(u[0]), most_q - abs(x[0]), most_dq - abs(x[1]))
    x = A_exact @ x + B_exact @ u
print(f"state {x0s[chosen].round(4)}: least distance to a limit {float(margin):.2e}")
assert margin >= 0, "The plan keeps all limits, in exact arithmetic."

# %% [markdown]
# **Infeasible.** The proof is a half-space. It comes from a Farkas vector (notebook 01): multiply
# the constraints by it, and the inputs cancel. What is left is an inequality on $x_0$ that every
# feasible state satisfies. Here is the half-space of a state that is within all limits:

# %%
within = np.all(np.abs(x0s) <= [q_max, dq_max], axis=1)
infeasible = np.flatnonzero((fmap.label == -1) & within)
worst = infeasible[np.argmax(x0s[infeasible] @ np.array([1.0, 0.5]))]
a, b = fmap.labels.cut_normal[worst], fmap.labels.cut_offset[worst]
a, b = a / np.abs(a).max(), b / np.abs(a).max()
print(f"state {x0s[worst].round(4)} violates {a[0]:.4f} q + {a[1]:.4f} dq <= {b:.4f}")
assert a @ x0s[worst] > b, "The half-space excludes the state."
assert np.all(x0s[feasible] @ a <= b + 1e-9), "It holds for every feasible state of the map."

# %%
axis = draw(fmap.label, "One half-space excludes many states", outline=False)
axis.figure.legends[0].remove()
velocity = np.array([0.25, 1.05]) * dq_max
axis.plot(
    (b - a[1] * velocity) / a[0], velocity, "--", color="k", lw=1.5, label="half-space's edge"
)
axis.plot(*x0s[worst], "X", color="#d55e00", ms=8, label="state it was made for")
axis.plot(*x0s[chosen], "o", color="#00486b", label="state of the plan above")
axis.set(xlim=(0.8 * q_max, 1.07 * q_max), ylim=(0.25 * dq_max, 1.05 * dq_max))
axis.figure.legend(loc="outside right upper", fontsize=9)
plt.show()

# %% [markdown]
# ## A failure: labels from a solver that stopped
#
# A tempting shortcut: run a solver for a fixed number of iterations, and call a state feasible if
# the constraints are then violated by less than $10^{-3}$. We do that with 30 ADMM iterations and
# no refinement.

# %%
short = jm.ADMM(iterations=30, newton_steps=0)
residual = jax.vmap(lambda x0: jm.solve(mpc, x0, solver=short).primal_residual)(x0s)
guess = np.where(np.asarray(residual) <= 1e-3, 1, -1)
missed = int(np.sum((guess == -1) & (fmap.label == 1)))
wrongly = int(np.sum((guess == 1) & (fmap.label == -1)))
print(f"feasible states called infeasible: {missed}; infeasible states called feasible: {wrongly}")
assert missed > 0, "Feasible states are called infeasible."
draw(guess, "Guessed from the residual after 30 iterations")
plt.show()

# %% [markdown]
# Many feasible states are called infeasible. The reason is not a mistake of the solver: the
# iterates of ADMM keep the constraints only in the limit, and after 30 iterations they are not yet
# there. A residual says something about an iterate; a label says something about a state. More
# iterations make the picture better, but no number of them makes it a proof. The map avoids the
# question: it labels a state only when it holds a plan or a half-space, and otherwise says
# "undecided".

# %% [markdown]
# ## Checking a stored map
#
# `jaxmpc sweep` computes such a map from the command line and stores it with all proofs. `verify`
# reads the stored file and proves every label again, by separate code and here in exact
# arithmetic. Without a configuration file the command maps the joint of the course, whatever you
# changed above: a file says what the problem is (`jaxmpc info` prints one).

# %%
with tempfile.TemporaryDirectory() as folder:
    command = [sys.executable, "-m", "jaxmpc", "sweep", "--grid", "24", "24", "--output", folder]
    done = subprocess.run([*command, "--overwrite"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr  # the command's own message
    found = jm.verify.verify_map(folder, exact=True)
print(found.labels, "verified:", found.verified, "exactly:", found.exactly)
assert found.passed and found.verified == 24 * 24, "Every label is proved again."

# %% [markdown]
# ## Exercises
#
# 1. A scalar system $x_{k+1} = x_k + u_k$ has $|u_k| \le u_{\max}$ and $|x_k| \le x_{\max}$ for all
#    $k = 0, \dots, N$. A common answer is that $\mathcal X_N$ is
#    $|x_0| \le x_{\max} + N u_{\max}$. Test it with $x_{\max} = 1$, $u_{\max} = 0.25$, $N = 4$.
# 2. For which index set of the state limit is that answer right? (`constrained_stages`)
# 3. What happens to the area of the joint's feasible set if the torque is halved? Predict it with
#    the integral above, then compute it.

# %% [markdown]
# ### Answers
#
# **1.** The answer is wrong. The limit at $k = 0$ is a limit on $x_0$ itself, which no input can
# change, so $|x_0| \le x_{\max}$ is necessary. It is sufficient too, with $u = 0$.


# %%
def scalar(steps):
    """Return x+ = x + u with |x| <= 1 at these steps and |u| <= 0.25, for N = 4."""
    return jm.MPC(
        jm.LinearSystem(np.eye(1), np.eye(1)),
        1.0,
        1.0,
        horizon=4,
        states=jm.Box([-1.0], [1.0]),
        inputs=jm.Box([-0.25], [0.25]),
        constrained_stages=steps,
    )


def interval(steps):
    """Return the largest x0 of the feasible set."""
    return float(jm.feasible.feasible_polytope(scalar(steps)).vertices().max())


print("limit at k = 0..4: x0 up to", round(interval((0, 1, 2, 3, 4)), 9))
assert np.isclose(interval((0, 1, 2, 3, 4)), 1.0), "x0 itself has to keep its limit."

# %% [markdown]
# **2.** It is right if the limit holds at $k = N$ alone. With $k = 1, \dots, N$ there is one step
# to come back, and the answer is $x_{\max} + u_{\max}$.

# %%
print("limit at k = 4 alone:", round(interval((4,)), 9))
print("limit at k = 1..4:   ", round(interval((1, 2, 3, 4)), 9))
assert np.isclose(interval((4,)), 1 + 4 * 0.25), "At k = N alone the common answer is right."
assert np.isclose(interval((1, 2, 3, 4)), 1.25), "From k = 1 on there is one step to come back."

# %% [markdown]
# **3.** The velocity falls by 0.2 rad/s in each step, so there are ten terms
# $(2 - 0.2 j)^2 / 2$ in place of five. The slivers become larger.

# %%
half = u_max / 2
predicted = exact_area(half)
weak = jm.MPC(system, Q, R, horizon=N, states=limits, inputs=jm.Box([-half], [half]))
computed = jm.feasible.feasible_polytope(weak).volume()
print(f"predicted {predicted} = {float(predicted)}, computed {computed:.9f}")
assert np.isclose(computed, float(predicted), rtol=1e-8), "The prediction is right."
assert predicted < area, "The set becomes smaller."
