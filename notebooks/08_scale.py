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
# # 8. From one state to a million
#
# You will solve the same MPC problem for one state, for a batch by `jax.vmap`, and for many states
# by `solve_many`, and label a million states as feasible or not, with proofs. You will count what
# became of each state, measure the throughput on your own machine, and compare
# float32 with float64.
#
# Lines that begin with `assert` check what the text says, for the numbers as they stand here; when
# you change a number, one may stop you: it says which sentence no longer holds, and may be deleted.

# %%
from time import perf_counter

import jax
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import ListedColormap

import jaxmpc as jm

system = jm.LinearSystem(A=np.array([[1, 0.01], [0, 1]]), B=np.array([[0.0], [0.2]]), dt=0.01)
limits, torque = jm.Box([-1.5, -2.0], [1.5, 2.0]), jm.Box(-2.0, 2.0)
Q, R = np.diag([50.0, 1.0]), np.array([[0.1]])
mpc = jm.MPC(system, Q, R, horizon=20, states=limits, inputs=torque, terminal_cost=Q)


def states(count, seed=0):
    """Return random states, some of them beyond the limits."""
    return np.random.default_rng(seed).uniform([-1.6, -2.1], [1.6, 2.1], (count, 2))


def count_status(status):
    """Return how many states have each status."""
    values, counts = np.unique(np.asarray(status), return_counts=True)
    return {jm.Status(int(v)).name: int(k) for v, k in zip(values, counts, strict=True)}


def timed(function, *arguments):
    """Return the result and the seconds of a second call: the first one compiles."""
    jax.block_until_ready(function(*arguments))
    begun = perf_counter()
    result = jax.block_until_ready(function(*arguments))
    return result, perf_counter() - begun


# %% [markdown]
# ## One state, a thousand states
#
# A `Controller` condenses the problem and factors its matrices once. `plan` is an ordinary JAX
# function, so `jax.vmap` makes a batch of it. Each member of the batch has a status of its own,
# derived from the residuals of its answer or from a certificate that there is none.

# %%
controller = jm.Controller(mpc)
one, seconds = timed(controller.plan, np.array([0.5, -1.0]))
print(one.sentence, f"{1e6 * seconds:,.0f} µs")

batch = jax.vmap(controller.plan)
x0s = states(1024)
many, seconds_many = timed(batch, x0s.astype(np.float32))
print(count_status(many.status), f"{1e6 * seconds_many / len(x0s):,.1f} µs a state")
assert int(one.status) == jm.Status.SOLVED, "There is a plan from the one state."
assert "PRIMAL_INFEASIBLE" in count_status(many.status), "Some of the many have none."

# %% [markdown]
# ## `solve_many`
#
# Under `vmap` all members wait for the slowest one. `solve_many` runs the batch in rounds: a state
# that is done leaves, and those still open are gathered again. Its answers are float64, with
# residuals below 1e-6. We measure how the throughput grows with the number of states.

# %%
sizes, rate = [2**8, 2**11, 2**14, 2**16], []
for size in sizes:
    plans, seconds = timed(jm.solve_many, mpc, states(size))
    rate.append(size / seconds)
    print(f"{size:>7,} states: {rate[-1]:>10,.0f} plans a second", count_status(plans.status))
solved = plans.solved
assert np.max(plans.primal_residual[solved]) < 1e-5, "What is solved has small residuals."

# %%
fig, axis = plt.subplots(figsize=(6, 3.5))
axis.loglog(sizes, rate, "o-", label="solve_many, float64, to 1e-6")
axis.loglog([1024], [1024 / seconds_many], "s", label="vmap, float32, to 1e-6")
axis.set(xlabel="number of states", ylabel="plans per second (1/s)")
axis.legend()
fig.tight_layout()

# %% [markdown]
# Small batches pay for calls and set-up; larger ones share them, until the processor and its caches
# are full. From there on the rate stays, or falls.

# %% [markdown]
# ## A million labels
#
# Where only the question "is there a plan?" counts, `map_feasible_set` drops the cost. Each label
# rests on a proof: a plan whose roll-out keeps every limit, or a half-space that excludes
# the state.

# %%
points = jm.grid([-1.6, -2.1], [1.6, 2.1], (1024, 1024))
begun = perf_counter()
fmap = jm.map_feasible_set(mpc, points)
seconds = perf_counter() - begun
counts = fmap.counts()
print(f"{len(points):,} states in {seconds:.1f} s, compiling included:", counts)
cell = 3.2 * 4.2 / 1023**2
print(f"area by counting: {counts['feasible'] * cell:.4f}; exact: {1489 / 125} rad·rad/s")
assert len(points) > 1e6, "More than a million states."
assert counts["feasible"] + counts["infeasible"] + counts["undecided"] == len(points), (
    "All of them."
)
assert abs(counts["feasible"] * cell - 1489 / 125) < 0.05, "Counting gives the exact area."

# %%
fig, axis = plt.subplots(figsize=(6, 3.5))
image = fmap.label.reshape(1024, 1024)[::4, ::4].T
colors = ListedColormap(["#dddcd8", "#f0d024", "#9fcbe6"])  # of -1, 0 and 1
extent = (-1.6, 1.6, -2.1, 2.1)
axis.imshow(
    image, cmap=colors, vmin=-1, vmax=1, origin="lower", extent=extent, aspect="auto"
)  # fmt: skip
axis.set(xlabel="angle (rad)", ylabel="velocity (rad/s)")
axis.set_title("blue: proved feasible, grey: proved infeasible")
fig.tight_layout()

# %% [markdown]
# Exactly at the boundary no proof in floating-point numbers is possible. A point within about
# 1e-10 of it would be counted as undecided, and not guessed.

# %% [markdown]
# ## A failure on purpose: ADMM alone
#
# ADMM is cheap, so let us save the Newton steps: 50 steps of ADMM, `newton_steps=0`, in float64.

# %%
with jax.enable_x64(True):
    admm = jm.Controller(mpc, jm.ADMM(iterations=50, newton_steps=0))
    short = jax.vmap(admm.plan)(x0s)
reference = jm.solve_many(mpc, x0s)
print("50 ADMM steps:   ", count_status(short.status))
print("with Newton steps:", count_status(reference.status))
open_ = np.mean(np.asarray(short.status) == jm.Status.ITERATION_LIMIT)
assert open_ > 0.3, "ADMM alone leaves many open."
assert np.mean(reference.status == jm.Status.ITERATION_LIMIT) < 0.01, "Newton steps end them."

# %% [markdown]
# Nothing is broken: ADMM converges linearly and slowly where limits are active, and a status is
# never derived from the fact that a loop has ended. `ITERATION_LIMIT` says that neither a plan to
# the tolerance of 1e-6 nor a proof of infeasibility was found. What ADMM does find soon is *which*
# limits are active. Newton steps on these few rows then end at the solution, and that is
# what the default solver does.

# %% [markdown]
# ## float32 and float64
#
# JAX computes in float32 unless told otherwise; `SOLVED` means 1e-6 all the same. We compare the
# first inputs of those of the 1,024 states that have a plan with the float64 answers. Most of these
# torques are at their limit, 2 N m, which float32 holds exactly: they make the left group of the
# picture (what is below 1e-12 N m is counted there). The others are rounded to float32.

# %%
both = np.asarray(many.solved) & reference.solved
error = np.abs(np.asarray(many.inputs, np.float64) - reference.inputs)[both, 0, 0]
print(f"{both.sum()} states; error of the first torque: median {np.median(error):.1e} N m, "
      f"worst {error.max():.1e} N m")  # fmt: skip
different = np.sum(np.asarray(many.status) != reference.status)
print(f"states with another status than in float64: {different}")
assert many.inputs.dtype == np.float32, "Plans of JAX's usual type are float32."
assert reference.inputs.dtype == np.float64, "solve_many answers in float64."

# %%
fig, axis = plt.subplots(figsize=(6, 3.5))
axis.hist(np.log10(np.maximum(error, 1e-12)), bins=40)
axis.set(xlabel="log10 of the error of the first torque (N m)", ylabel="number of states")
fig.tight_layout()

# %% [markdown]
# ## Exercises
#
# 1. One state of a batch is NaN. What becomes of its neighbours?
# 2. A program may raise an exception when a plan fails. What do you do in a batch? Replace the
#    inputs of all states without a plan by a braking torque.
# 3. A state is within its limits, $|q| \le 1.5$ rad and $|\dot q| \le 2$ rad/s, and yet infeasible.
#    How many points of the map are such, and where are they?

# %% [markdown]
# **Answer 1.** It gets the status `NON_FINITE`; the others do not notice.

# %%
broken = x0s.copy()
broken[7] = np.nan
answer = jm.solve_many(mpc, broken)
others = np.arange(len(x0s)) != 7
assert answer.status[7] == jm.Status.NON_FINITE, "The state has a status of its own."
assert np.array_equal(answer.status[others], reference.status[others]), "The others do not notice."
print(jm.Status(int(answer.status[7])).sentence)

# %% [markdown]
# **Answer 2.** Choose by status with `where`; the torque against the velocity brakes the joint.

# %%
brake = np.clip(-x0s[:, 1:] / 0.2, -2.0, 2.0)
found = reference.solved[:, None]
u = np.where(found, reference.inputs[:, 0], brake)
print(f"{np.sum(~found)} of {len(u)} states brake")
assert np.all(np.isfinite(u)), "Every state has an input."
assert np.abs(u).max() <= 2.0 + 1e-6, "Within its limits."

# %% [markdown]
# **Answer 3.** They are in two corners: near the upper stop with a positive velocity, and near the
# lower stop with a negative one. The joint cannot brake before the stop.

# %%
within = np.all(np.abs(points) <= [1.5, 2.0], axis=1)
doomed = points[within & (fmap.label == -1)]
print(f"{len(doomed):,} of {within.sum():,} points within the limits have no plan")
assert len(doomed) > 0, "There are such points."
assert np.all(doomed[:, 0] * doomed[:, 1] > 0), "They move towards the stop."
assert np.abs(doomed[:, 0]).min() > 1.3, "They are near it."
