# ---
# jupyter:
#   jupytext:
#     formats: py:percent,ipynb
#   kernelspec:
#     display_name: Python 3
#     name: python3
# ---

# %% [markdown]
# # 0. A first plan
#
# You will describe a robot joint with its limits, compute one optimal plan with model predictive
# control (MPC), read its status, and run the controller in a closed loop. At the end you know why
# a plan can be impossible although the joint is still within all its limits.
#
# Lines that begin with `assert` check what the text says, for the numbers as they stand here; when
# you change a number, one may stop you: it says which sentence no longer holds, and may be deleted.

# %%
import matplotlib.pyplot as plt
import numpy as np

import jaxmpc as jm

# %% [markdown]
# ## The joint
#
# The state is $x = (q, \dot q)$: angle and velocity of the joint. The input $u$ is the torque. With
# sampling time $T = 0.01$ s and inertia $J = 0.05$ kg m² the explicit Euler method gives
#
# $$q_{k+1} = q_k + T \dot q_k, \qquad \dot q_{k+1} = \dot q_k + \tfrac{T}{J} u_k .$$
#
# Names and units are optional. They appear in messages and on axes.

# %%
T, J = 0.01, 0.05
system = jm.LinearSystem(
    A=np.array([[1.0, T], [0.0, 1.0]]),
    B=np.array([[0.0], [T / J]]),
    dt=T,
    state_names=("q", "dq"),
    input_names=("torque",),
    state_units=("rad", "rad/s"),
    input_units=("N m",),
)
q_max, dq_max, u_max = 1.5, 2.0, 2.0  # rad, rad/s, N m
limits = jm.Box([-q_max, -dq_max], [q_max, dq_max])
torque = jm.Box([-u_max], [u_max])

# %% [markdown]
# ## The optimal control problem
#
# MPC minimises
#
# $$\sum_{k=0}^{N-1} \left( x_k' Q x_k + u_k' R u_k \right) + x_N' P x_N$$
#
# subject to the model and to the limits, over a horizon of $N = 20$ steps, which is 0.2 s. The
# matrix $P$ is called `terminal_cost`; here it equals $Q$. Notebook 03 makes a better choice.

# %%
Q, R, N = np.diag([50.0, 1.0]), np.array([[0.1]]), 20
mpc = jm.MPC(system, Q, R, horizon=N, states=limits, inputs=torque, terminal_cost=Q)
controller = jm.Controller(mpc)

# %% [markdown]
# `jm.solve(mpc, x0)` solves the problem once. A `Controller` does the part of the work that does
# not depend on the state beforehand, and `controller.plan(x0)` returns the same plan. The first
# call compiles the solver, which takes some seconds; the following calls take milliseconds.

# %%
x0 = np.array([-1.2, 0.1])
plan = controller.plan(x0)
print(plan.sentence)
assert int(plan.status) == jm.Status.SOLVED, "The joint has a plan from here."

# %% [markdown]
# The plan has `states` of shape $(N + 1, 2)$ and `inputs` of shape $(N, 1)$. Always look at the
# status first: if it is not `SOLVED`, the numbers of the plan mean little.
#
# The next function draws a trajectory and shades what is forbidden.


# %%
def draw(states, inputs, title):
    """Draw angle, velocity and torque over time, the forbidden values in red."""
    states, inputs = np.asarray(states), np.asarray(inputs)
    time = T * np.arange(len(states))
    figure, axes = plt.subplots(3, 1, figsize=(6, 4.8), sharex=True, layout="constrained")
    curves = (
        ("q [rad]", states[:, 0], q_max),
        ("dq [rad/s]", states[:, 1], dq_max),
        ("torque [N m]", inputs[:, 0], u_max),
    )
    for axis, (label, values, limit) in zip(axes, curves, strict=True):
        for sign in (-1, 1):
            axis.axhspan(sign * limit, sign * 1.35 * limit, color="#d55e00", alpha=0.25, lw=0)
        if len(values) == len(time):
            axis.plot(time, values, color="#00486b")
        else:  # An input is held from one sample to the next.
            axis.stairs(values, time, baseline=None, color="#00486b", lw=1.5)
        axis.set(ylabel=label, ylim=(-1.35 * limit, 1.35 * limit))
        axis.axhline(0, color="0.8", lw=0.8, zorder=0)
    axes[-1].set_xlabel("time [s]")
    figure.suptitle(title, fontsize=11)
    plt.show()


draw(plan.states, plan.inputs, f"One plan of {N} steps from q = {x0[0]:g} rad")

# %% [markdown]
# The plan accelerates with full torque until the velocity reaches its limit of 2 rad/s, and then
# coasts at that limit; towards the end it brakes. Two constraints shape the plan, one after the
# other. We check this statement instead of trusting the picture:

# %%
velocity, applied = np.asarray(plan.states)[:, 1], np.asarray(plan.inputs)[:, 0]
at_torque_limit = np.abs(applied - u_max) < 1e-4
at_velocity_limit = np.abs(velocity - dq_max) < 1e-4
print("steps at the torque limit:  ", np.flatnonzero(at_torque_limit))
print("steps at the velocity limit:", np.flatnonzero(at_velocity_limit))
full = np.flatnonzero(at_torque_limit).tolist()
assert full == [0, 1, 2, 3], "The plan accelerates with full torque for four steps."
assert at_velocity_limit.any(), "The velocity reaches its limit."
assert np.abs(np.asarray(plan.states)[:, 0]).max() <= q_max, "The angle keeps its limit."

# %% [markdown]
# ## Closed loop
#
# A plan is a forecast. MPC applies only the first input, measures the state again and plans anew.
# The controller takes the state and the previous plan, from which it starts the solver;
# `controller.start` stands for the time step before the first. Here the joint moves from rest
# to the reference $q = 1$ rad; the reference enters the cost, the constraints stay where they are.

# %%
x, goal = np.zeros(2), 1.0
control = controller.start(x)
states, inputs = [x], []
for _ in range(120):
    control = controller(x, control, reference=np.array([goal, 0.0]))
    assert control.plan.solved, "Every plan is solved."
    x = np.asarray(system.A) @ x + np.asarray(system.B) @ np.asarray(control.u)
    states.append(x)
    inputs.append(np.asarray(control.u))
states, inputs = np.array(states), np.array(inputs)
draw(states, inputs, f"Closed loop from rest to the reference {goal:g} rad")

# %%
final = states[-1]
print(f"after {T * len(inputs):.1f} s: q = {final[0]:.4f} rad, dq = {final[1]:.4f} rad/s")
assert np.all(np.abs(states) <= np.array([q_max, dq_max]) + 1e-5), "Angle and velocity keep limits."
assert np.all(np.abs(inputs) <= u_max), "The torque keeps its limit."
assert abs(final[0] - goal) < 0.01, "The joint arrives at the reference."

# %% [markdown]
# ## A failure, and what it means
#
# At $q = 1.49$ rad and $\dot q = 1.9$ rad/s the joint is within all its limits. Is there a plan?

# %%
x0 = np.array([1.49, 1.9])
assert bool(limits.contains(x0)), "The state is within all limits."
plan = controller.plan(x0)
print(jm.Status(int(plan.status)).name, "-", plan.sentence)
assert int(plan.status) == jm.Status.PRIMAL_INFEASIBLE, "And yet there is no plan."

# %% [markdown]
# There is none, and the solver has a proof of that. The reason is the braking distance. Full
# torque changes the velocity by $T u_{\max} / J = 0.4$ rad/s in each step, so that from 1.9 rad/s
# the velocities 1.9, 1.5, 1.1, 0.7 and 0.3 rad/s still pass before the joint stands:

# %%
per_step, fast = T * u_max / J, x0[1]
velocities = np.arange(fast, 0, -per_step)
distance = T * velocities.sum()
edge = q_max - distance
print("velocities while braking:", velocities, "rad/s")
print(f"braking distance: {distance:.3f} rad, so q <= {edge:.3f} rad at {fast:g} rad/s")
assert np.isclose(per_step, 0.4), "Full torque changes the velocity by 0.4 rad/s in each step."
assert np.isclose(distance, 0.055), "The joint moves on by 0.055 rad."

# %% [markdown]
# The joint moves on by 0.055 rad at least, so with 1.9 rad/s it must not be beyond 1.445 rad. The
# solver knows nothing about braking distances, yet it finds the same boundary:

# %%
for q in (edge - 1e-3, edge + 1e-3):
    status = jm.Status(int(controller.plan(np.array([q, fast])).status))
    print(f"q = {q:.3f} rad: {status.name}")
    expected = jm.Status.SOLVED if q < edge else jm.Status.PRIMAL_INFEASIBLE
    assert status == expected, "The solver finds the boundary that the braking distance gives."

# %% [markdown]
# So a limit on the state is not the same as the set of states from which limits can be kept. This
# set is called the feasible set. Notebook 02 computes it.

# %% [markdown]
# ## Exercises
#
# 1. How many samples does the closed loop above spend at the velocity limit? Compare with the time
#    that 1 rad takes at 2 rad/s.
# 2. Make torque expensive: raise $R$ from 0.1 to 10, and compare the largest torque of the two
#    plans from $(-1.2, 0.1)$.
# 3. Joint limits are often written as one matrix inequality $G_x x \le g_x$. Write it down for this
#    joint, give it to `jm.Polytope`, and check on random states that both sets are the same.
#    (`jm.MPC` takes either as `states`.)

# %% [markdown]
# ### Answers
#
# **1.** The loop brakes long before the reference, because the cost on the velocity makes it do so;
# it never coasts all the way.

# %%
count = int(np.sum(np.abs(states[:, 1] - dq_max) < 1e-4))
whole = goal / dq_max
print(f"{count} samples, {T * count:.2f} s, at the velocity limit; {whole:g} s for all of the way")
assert 0 < T * count < whole, "The joint never coasts all the way."

# %% [markdown]
# **2.** A plan with expensive torque accelerates less.

# %%
x0 = np.array([-1.2, 0.1])
cheap = controller.plan(x0)
dear = np.array([[10.0]])
expensive = jm.MPC(system, Q, dear, horizon=N, states=limits, inputs=torque, terminal_cost=Q)
costly = jm.solve(expensive, x0)
largest = [float(np.abs(np.asarray(p.inputs)).max()) for p in (cheap, costly)]
for weight, value in zip((R, dear), largest, strict=True):
    print(f"largest torque for R = {weight.item():g}: {value:.3f} N m")
assert largest[1] < largest[0], "A plan with expensive torque accelerates less."

# %% [markdown]
# **3.** The rows of $G_x$ are $\pm$ the unit vectors: each limit of a box is one row.

# %%
G = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
g = np.array([q_max, q_max, dq_max, dq_max])
rows = jm.Polytope(G, g)
samples = np.random.default_rng(0).uniform([-2.0, -3.0], [2.0, 3.0], (200, 2))
for sample in samples:
    assert bool(rows.contains(sample)) == bool(limits.contains(sample)), "Both are the same set."
print("the polytope and the box agree on", len(samples), "random states")
