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
# # 9. From a robot to a robust controller
#
# A load that nobody measures pushes a joint. You will learn how to say so, how much of it the
# limits can take, how to get a controller that keeps them whatever the load does, how to prove that
# it always has a plan, and how to write it as C code.
#
# Lines that begin with `assert` check what the text says, for the numbers as they stand here; when
# you change a number, one may stop you: it says which sentence no longer holds, and may be deleted.

# %%
import tempfile
from dataclasses import replace

import jax
import matplotlib.pyplot as plt
import numpy as np

import jaxmpc as jm

# %% [markdown]
# ## The robot, and what disturbs it
#
# The joint has position $q$ and velocity $\dot q$, $|q| \le 1.5$ rad, $|\dot q| \le 2$ rad/s, and
# a torque of at most 2 N m. Its model is linear. The load is a torque of up to 0.6 N m of any form:
# it enters as the input does, $x^+ = A x + B u + B w$.

# %%
robot = jm.load_robot("joint")
with jax.enable_x64(True):
    system = jax.tree.map(np.asarray, robot.linearize(*robot.equilibrium([0.0])))
states, inputs = robot.state_limits, robot.input_limits
load, E = jm.Box([-0.6], [0.6]), system.B
Q, R = np.diag([50.0, 1.0]), np.array([[2.0]])
law = jm.lqr(system, Q, R)

# %% [markdown]
# How far can the load alone carry the state under $u = K x$? The minimal robust invariant set says
# so: at most a tenth of the way to the position limits, half of that to the velocity limits.

# %%
alone = jm.sets.minimal_robust_invariant_set(system, law.K, load, 1e-2, disturbance_matrix=E)
print(alone.bounding_box())
reach = np.asarray(alone.bounding_box().upper)
assert np.all(reach < [0.15, 1.0]), "At most a tenth and a half of the way to the limits."

# %% [markdown]
# ## A nominal controller breaks a limit
#
# The nominal problem knows nothing of the load. From a state near a limit, moving towards it, plans
# end up to touch the limit, and the load does the rest.

# %%
shared = {"Q": Q, "R": R, "horizon": 15, "states": states, "inputs": inputs}
X_f = jm.maximal_invariant_set(system, law.K, states, inputs)
nominal = jm.MPC(system, **shared, terminal_cost=law.P, terminal_set=X_f)
against = {"disturbance": load, "disturbance_matrix": E}
X_w = jm.maximal_invariant_set(system, law.K, states, inputs, **against)
robust = jm.MPC(system, **shared, terminal_cost=law.P, terminal_set=X_w, **against)

fmap = jm.map_feasible_set(robust, jm.grid([-1.5, -2.0], [1.5, 2.0], (61, 61)))
corners = jm.feasible.feasible_polytope(robust).vertices()
start = 0.98 * corners[np.argmax(corners @ [1.0, 0.5])]
print(fmap, "start", start)

# %%
steps = 40
loads = jm.closed_loop.draw_disturbances(robust, steps, 64)
loads[0] = 0.6 * np.asarray(E)[:, 0]  # and one load that pushes all the time


@jax.jit
def loops(controller, loads):
    return jax.vmap(lambda w: jm.simulate(controller, system, start, steps, disturbance=w))(loads)


with jax.enable_x64(True):
    runs = {
        name: jax.tree.map(np.asarray, loops(jm.Controller(mpc), loads))
        for name, mpc in (("nominal", nominal), ("robust", robust))
    }
for name, run in runs.items():
    solved = np.mean(run.status == jm.Status.SOLVED)
    print(f"{name}: largest violation {run.violation.max():.4f}, plans solved {solved:.2%}")
assert runs["nominal"].violation.max() > 1e-3, "The nominal controller breaks a limit."
assert runs["robust"].violation.max() < 1e-6, "The robust one keeps all."
assert np.all(runs["robust"].status == jm.Status.SOLVED), "It always has a plan."

# %%
figure, axes = plt.subplots(1, 2, figsize=(9, 3.5), sharey=True)
for axis, (name, run) in zip(axes, runs.items(), strict=True):
    axis.plot(run.states[:, :, 0].T, run.states[:, :, 1].T, lw=0.7, color="#0072b2")
    axis.axhspan(-2.1, -2, color="#dddcd8")  # beyond the limit, near which the loops differ
    axis.set(title=name, xlabel="q [rad]", xlim=(0.1, 0.45), ylim=(-2.05, -1.5))
axes[0].set_ylabel("velocity [rad/s]")
figure.tight_layout()

# %% [markdown]
# ## It always has a plan
#
# The terminal set is invariant for all loads, so the plan of the last sample, shifted, is a plan
# again. `recursive_feasibility` checks every hypothesis.

# %%
report = jm.recursive_feasibility(robust)
print(report.strong)
assert report.strong.holds, "It is proved."
assert "factor is at most 1" in report.strong.reason, "In rational arithmetic too."

# %% [markdown]
# ## How much larger could the set be?
#
# The policy answers to the load by the gain $K$. Affine policies answer by any matrix, each state
# by its own; no label costs more, once the policies at the ends of some rays are known.

# %%
areas = {}
for policy in ("tightened", "affine"):
    areas[policy] = jm.feasible.feasible_polytope(
        replace(robust, policy=policy, horizon=6)
    ).volume()
areas["no load"] = jm.feasible.feasible_polytope(replace(nominal, horizon=6)).volume()
print(areas)
assert areas["tightened"] <= areas["affine"], "Affine policies answer to more."
assert areas["affine"] <= areas["no load"], "The load takes something away."

# %% [markdown]
# ## On the controller's own processor
#
# The problem is nominal with tightened limits: the C code is that of any other.

# %%
with tempfile.TemporaryDirectory() as folder:
    files = jm.export.export_c(robust, folder, name="joint")
    print([path.name for path in files])

# %% [markdown]
# ## Exercise
#
# How large may the load be, so that there still is a robust terminal set?

# %% [markdown]
# **Answer.** Bisection: the function says in one sentence where there is none.

# %%
low, high = 0.6, 2.0
while high - low > 1e-3:
    middle = (low + high) / 2
    try:
        W = jm.Box([-middle], [middle])
        jm.maximal_invariant_set(system, law.K, states, inputs, disturbance=W, disturbance_matrix=E)
        low = middle
    except ValueError as error:
        high, why = middle, error
print(f"{low:.3f} N m; beyond, {why}")
