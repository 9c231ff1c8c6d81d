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
# # 6. Robots in MJX
#
# You will load a two-link arm, read its limits from the model file, make an MPC for it, and run 64
# closed loops at once in MuJoCo's simulator MJX. You will see which limits are kept on the
# *nonlinear* robot, and why the reference of the input matters as much as that of the state.
#
# Lines that begin with `assert` check what the text says, for the numbers as they stand here; when
# you change a number, one may stop you: it says which sentence no longer holds, and may be deleted.

# %%
import matplotlib.pyplot as plt
import numpy as np

import jaxmpc as jm

# %% [markdown]
# ## The robot and what is known of it
#
# The simulated plant is the model as written. The predictor inside the MPC is a linear model
# $x^+ = Ax + Bu + c$ of the same robot, made anew at each measured state. `report()` says where
# each limit comes from and what the predictor leaves out. We lower the velocity limits of both
# joints to 1.5 rad/s, so that they matter in what follows.

# %%
robot = jm.load_robot("arm2", velocity=1.5)
print(robot.report())

# %% [markdown]
# At rest in its home position the arm needs torque against gravity. `equilibrium` computes it.

# %%
x_ref, u_ref = robot.equilibrium()
print("home (rad, rad/s):", x_ref, "  torque that holds it (N m):", u_ref)
assert np.abs(u_ref).max() > 0.1, "The arm needs torque against gravity."

# %% [markdown]
# ## The controller
#
# `robot_mpc` takes the limits of the model, tightens those of the state by 2 % to allow for errors
# of the linear model, and chooses weights by Bryson's rule: one over the square of what is allowed,
# for velocities and inputs a hundredth of it, so that slow motion and effort are forgiven.
# The input limits are hard. `RobotController` makes the state limits soft with a large penalty, so
# that there is always a plan; `run.fallback` counts the plans that had to exceed a limit.

# %%
N, T = 10, 100
mpc = jm.robot_mpc(robot, horizon=N)
controller = jm.RobotController(robot, mpc)
velocity = np.asarray(robot.state_limits.upper)[2:]
torque = np.asarray(robot.input_limits.upper)
print(f"control period {robot.dt} s, torque limits {torque} N m, velocity limits {velocity} rad/s")
assert np.allclose(mpc.states.upper[2:], 0.98 * velocity), "State limits are tightened by 2 %."

# %% [markdown]
# ## Sixty-four robots
#
# Every loop gets a reference of its own (`references=`), as in domain randomisation: the first 32
# arms return home from random positions, the other 32 start at home and go to random positions,
# with the torque that holds the target as input reference. The first call compiles; that takes
# most of the time of this notebook. All calls below have the same shapes, so they compile nothing.

# %%
rng = np.random.default_rng(0)
count, half = 64, 32
spread = np.concatenate([rng.uniform(-0.6, 0.6, (half, 2)), np.zeros((half, 2))], axis=1)
away = x_ref + spread
hold = np.array([robot.equilibrium(x[:2])[1] for x in away])
assert np.all(np.abs(hold) <= torque), "The motors can hold each target."

x0s = np.concatenate([away, np.tile(x_ref, (half, 1))])
x_goal = np.concatenate([np.tile(x_ref, (half, 1)), away])
u_goal = np.concatenate([np.tile(u_ref, (half, 1)), hold])
run = jm.simulate_many(controller, robot, x0s, T, references=x_goal, input_references=u_goal)

# %%
solved = np.mean(run.status == jm.Status.SOLVED)
error = np.abs(run.states[:, -1, :2] - x_goal[:, :2]).max()
print(f"plans solved: {solved:.1%}, plans that exceed a limit: {run.fallback.mean():.1%}")
print(f"worst violation: {run.violation.max():.1e} in the unit of its limit (rad or rad/s)")
print(f"largest torque as a fraction of its limit: {np.max(np.abs(run.inputs) / torque):.3f}")
print(f"largest position error after {T * robot.dt:.1f} s: {error:.1e} rad")
assert run.violation.max() < 1e-4, "No loop leaves a limit of the state."
assert np.all(np.abs(run.inputs) <= torque * (1 + 1e-5)), "No torque is beyond its limit."

# %%
time = robot.dt * np.arange(T + 1)
fig, axes = plt.subplots(1, 3, figsize=(9, 3))
axes[0].plot(time, run.states[:half, :, 0].T - x_ref[0], color="tab:blue", alpha=0.4)
axes[0].set(ylabel="joint 1 minus home (rad)")
axes[1].plot(time, run.states[:, :, 2].T, color="tab:blue", alpha=0.3)
axes[1].axhline(velocity[0], color="k", linestyle="--")
axes[1].axhline(-velocity[0], color="k", linestyle="--")
axes[1].set(ylabel="velocity of joint 1 (rad/s)")
axes[2].plot(time[:-1], run.inputs[:, :, 0].T, color="tab:blue", alpha=0.3)
axes[2].axhline(torque[0], color="k", linestyle="--")
axes[2].axhline(-torque[0], color="k", linestyle="--")
axes[2].set(ylabel="torque of joint 1 (N m)")
for axis in axes:
    axis.set(xlabel="time (s)")
fig.tight_layout()

# %% [markdown]
# The dashed lines are the robot's own limits. None of the 64 loops exceeds one in the simulator,
# although the predictor is only a linear model at each sample.

# %% [markdown]
# ## A failure on purpose
#
# Now we give the right reference for the state, but forget the torque that holds it: the input
# reference is zero.

# %%
forgot = jm.simulate_many(
    controller, robot, x0s, T, references=x_goal, input_references=np.zeros_like(u_goal)
)
offset = np.linalg.norm(forgot.states[:, -1, :2] - x_goal[:, :2], axis=1)
with_torque = np.linalg.norm(run.states[:, -1, :2] - x_goal[:, :2], axis=1)
print(
    f"error at the end, worst: {with_torque.max():.1e} rad with u_ref, {offset.max():.1e} without"
)
assert offset.max() > 2 * with_torque.max(), "Without the torque the arms settle elsewhere."

# %%
fig, axis = plt.subplots(figsize=(6, 3.5))
distance = lambda r: np.linalg.norm(r.states[:, :, :2] - x_goal[:, None, :2], axis=2)
axis.semilogy(time, np.median(distance(run), axis=0), label="input reference: holding torque")
axis.semilogy(time, np.median(distance(forgot), axis=0), label="input reference: zero")
axis.set(xlabel="time (s)", ylabel="median position error (rad)")
axis.legend()
fig.tight_layout()

# %% [markdown]
# No plan failed and no limit was broken; but the arms settle at a wrong place. The cost charges
# $(u - u_{\text{ref}})'R(u - u_{\text{ref}})$. With $u_{\text{ref}} = 0$ the torque against gravity
# costs something, and the optimum is a compromise between holding the arm and letting it sag. A
# target must be a *pair* $(x_{\text{ref}}, u_{\text{ref}})$ that is an equilibrium of the model;
# then the cost is zero there, and there is no offset.

# %% [markdown]
# ## Exercises
#
# 1. Write the position limits of the arm as $G_x x \le g_x$ with
#    $x = (q, \dot q)$, and check all states of the simulation with it.
# 2. How many loops used at least 99 % of a torque limit, and how many came within 3 % of a
#    velocity limit?
# 3. The controller does not know the masses of its robot exactly. Let each robot be 20 % lighter
#    or heavier (`variations=`), and compare error and violation. (This compiles once more, for the
#    masses become arguments of the program. So the answer only draws the masses.)

# %% [markdown]
# **Answer 1.** With the selector $S_q = [I\ 0]$ they are
# $G_x = [S_q; -S_q]$ and $g_x = [q^{\max}; -q^{\min}]$.

# %%
q_max, q_min = np.asarray(robot.state_limits.upper)[:2], np.asarray(robot.state_limits.lower)[:2]
S = np.hstack([np.eye(2), np.zeros((2, 2))])
G, g = np.vstack([S, -S]), np.concatenate([q_max, -q_min])
slack = g - run.states @ G.T
print(f"smallest distance of any state from a position limit: {slack.min():.3f} rad")
assert np.all(slack >= 0), "All states keep the position limits."

# %% [markdown]
# **Answer 2.**

# %%
pushing = np.any(np.abs(run.inputs) >= 0.99 * torque, axis=(1, 2))
fast = np.any(np.abs(run.states[:, :, 2:]) >= 0.97 * velocity, axis=(1, 2))
print(
    f"{pushing.sum()} of {count} loops reach a torque limit, {fast.sum()} nearly a velocity limit"
)

# %% [markdown]
# **Answer 3.** The draws; give them to `simulate_many` as `variations=drawn`.

# %%
drawn = jm.closed_loop.randomised(robot, count, mass=(0.8, 1.2))
print({name: np.shape(value) for name, value in drawn.items()})
assert all(len(value) == count for value in drawn.values()), "Each robot has its own masses."
