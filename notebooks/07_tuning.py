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
# # 7. Tuning by gradient
#
# You will tune the weights $Q$ and $R$ of an MPC by the gradient of a closed-loop loss, through the
# constraints, the solver and all samples, and see how a badly chosen loss deceives. You will also
# keep apart two numbers that are both called $\rho$: the weight of soft limits, which is part
# of the *problem*, and the step size of ADMM, which is part of the *solver*.
#
# Lines that begin with `assert` check what the text says, for the numbers as they stand here; when
# you change a number, one may stop you: it says which sentence no longer holds, and may be deleted.

# %%
from dataclasses import replace

import jax
import matplotlib.pyplot as plt
import numpy as np
import optax

import jaxmpc as jm

jax.config.update("jax_enable_x64", True)

# %% [markdown]
# ## The problem and the first guess
#
# A robot joint has the state (angle, velocity) and a torque as its input; its sampling time is
# 50 ms. The first weights are all one, in rad, rad/s and N m. That is nobody's wish, it is a guess.

# %%
dt = 0.05
system = jm.LinearSystem(A=np.array([[1, dt], [0, 1]]), B=np.array([[0.0], [dt / 0.05]]), dt=dt)
limits, torque = jm.Box([-1.5, -2.0], [1.5, 2.0]), jm.Box(-1.0, 1.0)
guess = jm.MPC(system, np.eye(2), np.eye(1), horizon=10, states=limits, inputs=torque)
x0s = np.random.default_rng(0).uniform([-1.0, -1.0], [1.0, 1.0], (64, 2))

# %% [markdown]
# What we do want stands in the loss, with weights of its own that stay fixed: the angle matters,
# the effort little, and leaving the limits is charged. The average is over the closed loops.

# %%
steps = 20
loss = jm.ClosedLoopLoss(Q=np.diag([50.0, 0.1]), R=np.array([[0.01]]), limits=limits)
weights = {"Q": jm.Parameter(np.eye(2), "diagonal"), "R": jm.Parameter(np.eye(1), "definite")}
make = lambda values: replace(guess, Q=values["Q"], R=values["R"])
run = jm.tune_weights(
    make, weights, system, x0s, loss, steps, updates=20, optimizer=optax.adam(0.3)
)
print("loss before and after:", run.before["loss"], run.after["loss"])
print("Q:", np.diag(run.values["Q"]), " R:", run.values["R"].item())
assert run.improved and run.improvement > 0.05, "The loss falls."

# %% [markdown]
# The gradient is taken with respect to the logarithms of the weights, so that a step is a relative
# change and a weight cannot become negative. A quarter of the initial states is set apart; the
# result is the step with the least loss on these.

# %%
before = jm.simulate_many(jm.Controller(guess), system, x0s, steps)
after = jm.simulate_many(run.result, system, x0s, steps)
time = dt * np.arange(steps + 1)
fig, (left, right) = plt.subplots(1, 2, figsize=(8, 3.2))
left.plot(run.history.validation, "o-", markersize=3)
left.set(xlabel="step of the optimiser", ylabel="loss on states set apart (1)")
angle = lambda r: np.median(np.abs(r.states[:, :, 0]), axis=0)
right.plot(time, angle(before), label="first guess")
right.plot(time, angle(after), label="tuned")
right.set(xlabel="time (s)", ylabel="median |angle| (rad)")
right.legend()
fig.tight_layout()
assert angle(after)[10] < angle(before)[10], "The tuned loops are nearer to the target."

# %% [markdown]
# ## A failure on purpose: the controller's own cost as the loss
#
# It seems natural to minimise the cost that the controller minimises anyway, `run.stage_cost`. A
# hundredth of the first guess, $Q/100$ and $R/100$, seems to be a far better controller then:

# %%
hundredth = replace(guess, Q=guess.Q / 100, R=guess.R / 100)
fooled = jm.simulate_many(jm.Controller(hundredth), system, x0s, steps)
own = {"first guess": before, "a hundredth of it": fooled}
own = {name: round(float(runs.stage_cost.mean()), 6) for name, runs in own.items()}
print("the controller's own cost:", own)
true_loss = lambda r: float(np.mean(jax.vmap(loss)(r)))
ours = {"first guess": before, "a hundredth of it": fooled, "tuned": after}
print("the loss that we meant:   ", {name: true_loss(r) for name, r in ours.items()})
assert own["a hundredth of it"] < 0.011 * own["first guess"], "Its cost is a hundredth."
assert np.allclose(fooled.states, before.states, atol=1e-3), "The motion is the same."
assert true_loss(after) < true_loss(before), "What we meant is better after tuning."

# %% [markdown]
# Its cost is a hundred times smaller, and the motion is the same. The sum of $x'Qx + u'Ru$ becomes
# small when $Q$ and $R$ themselves become small; the optimal plan does not change if both are
# multiplied by one number. A descent on this cost would drive the weights towards zero and say
# nothing about the motion. Weights that are tuned must not measure the result.

# %% [markdown]
# ## The first rho: the penalty of soft limits
#
# `soften(mpc, rho)` lets the state limits be exceeded and charges $\rho \cdot$ (violation). This
# $\rho$ changes the *answer*. Above a threshold $\bar\rho$, the largest multiplier of the hard
# problem, the slacks are zero wherever the limits can be kept (exact penalty, Theorem 2).

# %%
unit = jm.Box(-np.ones(2), np.ones(2))
cart = jm.MPC(
    jm.LinearSystem(np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[0.4], [1.0]]), dt=1.0),
    *(np.eye(2), 10 * np.eye(1), 3),
    states=unit,
    inputs=jm.Box(-0.25, 0.25),
    terminal_cost=np.eye(2),
    terminal_set=unit,
)
exact = jm.explicit.exact_penalty(cart)
factors = np.array([0.1, 0.5, 0.9, 0.99, 1.01, 2.0])
worst = np.array([0.999999 * exact.at])  # a hair inside the feasible set
slack = [jm.solve_many(jm.soften(cart, rho=f * exact.rho_bar), worst).slack.max() for f in factors]
print(f"threshold: {exact.rho_bar:.6g}")
print("slack by factor:", ", ".join(f"{f}: {s:.6f}" for f, s in zip(factors, slack, strict=True)))
assert np.isclose(exact.rho_bar, 11.25), "The threshold is 11.25."
assert min(slack[:3]) > 1e-4, "Below the threshold there is slack."
assert max(slack[4:]) < 1e-5, "Above it there is none."

# %% [markdown]
# ## The second rho: the step size of ADMM
#
# ADMM's $\rho$ weighs the distance between its two copies of the variables. It changes nothing
# about the problem: with enough iterations every $\rho > 0$ ends at the same plan. It
# decides how fast.
# Here 48 ADMM steps alone, without Newton steps, on states with a plan:

# %%
states = np.random.default_rng(1).uniform([-1.5, -2.0], [1.5, 2.0], (320, 2))
states = states[jm.map_feasible_set(guess, states).label == 1]
rhos = np.logspace(-2, 2, 9)
accuracy, solved = [], []
for rho in rhos:
    admm = jm.ADMM(iterations=48, rho=rho, newton_steps=0)
    plans = jax.vmap(jm.Controller(run.mpc, admm).plan)(states)
    accuracy.append(np.maximum(plans.primal_residual, plans.dual_residual))
    solved.append(np.mean(plans.solved))
print("solved, by rho:", ", ".join(f"{r:.3g}: {s:.3f}" for r, s in zip(rhos, solved, strict=True)))

# %%
fig, (left, right) = plt.subplots(1, 2, figsize=(8, 3.2))
left.semilogy(factors, np.maximum(slack, 1e-9), "o-")
left.axvline(1.0, color="k", linestyle="--")
left.set(xlabel=r"soft penalty $\rho / \bar\rho$ (1)", ylabel="largest slack (m or m/s)")
right.loglog(rhos, np.median(accuracy, axis=1), "o-", label="median")
right.loglog(rhos, np.quantile(accuracy, 0.9, axis=1), "s-", label="90 %")
right.set(xlabel=r"ADMM's $\rho$ (1)", ylabel="residual after 48 steps")
right.legend()
fig.tight_layout()

# %% [markdown]
# `tune_solver` learns this step size by gradient through the ADMM steps: one value for each
# group of rows and each quarter of the iterations. Its start is the best constant, and
# what it returns is never worse on the validation states than the solver that it is compared with.
# Its numbers are not those of the picture: it measures on states set apart for validation, and its
# residual is the largest of three, the duality gap too, which the picture leaves out. That one, in
# units of cost, is the largest here.

# %%
penalties = jm.tuning.tune_solver(run.mpc, states, iterations=48, updates=30, batch=16)
print("solved to 1e-6:", penalties.before["solved"], "->", penalties.after["solved"])
print("median residual:", penalties.before["residual"], "->", penalties.after["residual"])
assert penalties.after["solved"] >= penalties.before["solved"], "It is not worse."

# %% [markdown]
# ## Exercises
#
# 1. Let the optimum without the limits keep the limits. Show on an example
#    that then the slack is zero for *any* soft penalty $\rho > 0$, however small.
# 2. Multiply $Q$, $R$ and the terminal cost by ten. What happens to the plan, and to $\bar\rho$?
# 3. Does the tuned ADMM change the plan? Compare with the default solver.

# %% [markdown]
# **Answer 1.** Near the origin no limit is active, so its multiplier is zero, and the threshold at
# that state is zero too: any $\rho > 0$ is large enough.

# %%
near = np.array([[0.05, -0.02]])
plain = jm.solve_many(replace(cart, states=None, terminal_set=None), near)
assert np.all(np.abs(plain.states) < 1), "The optimum without the limits keeps them."
tiny = jm.solve_many(jm.soften(cart, rho=1e-3), near)
print(
    "slack:", tiny.slack.max(), " difference of the inputs:", abs(tiny.inputs - plain.inputs).max()
)
assert tiny.slack.max() < 1e-6, "The slack is zero."
assert np.allclose(tiny.inputs, plain.inputs, atol=1e-5), "The inputs are the same."

# %% [markdown]
# **Answer 2.** The plan stays; the multipliers, and with them $\bar\rho$, grow tenfold. A penalty
# has the unit of the cost per unit of the limit that it softens.

# %%
tenfold = replace(cart, Q=10 * cart.Q, R=10 * cart.R, terminal_cost=10 * cart.terminal_cost)
same = jm.solve_many(cart, worst).inputs - jm.solve_many(tenfold, worst).inputs
print("difference:", abs(same).max(), " threshold:", jm.explicit.exact_penalty(tenfold).rho_bar)
assert abs(same).max() < 1e-5, "The plan stays."
assert np.isclose(jm.explicit.exact_penalty(tenfold).rho_bar, 112.5), "The threshold grows tenfold."

# %% [markdown]
# **Answer 3.** No, within the tolerance of the residuals: it changes the path of the iterates only.

# %%
tuned = jax.vmap(jm.Controller(run.mpc, penalties.solver).plan)(states)
default = jm.solve_many(run.mpc, states)
both = tuned.solved & default.solved
gap = np.abs(np.asarray(tuned.inputs) - default.inputs)[both].max()
print(f"{both.sum()} of {len(states)} states compared; largest difference {gap:.1e} N m")
assert gap < 1e-2, "The plans are the same within the tolerance."
