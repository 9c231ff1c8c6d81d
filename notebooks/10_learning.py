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
# # 10. Learning with MPC
#
# An MPC can learn, and it can teach. First you will learn the hidden weights of an expert from what
# it does, by the gradient through the plans. Then an MPC teaches a neural network that takes its
# place, and you will prove for which states the network keeps all limits for ever; see one that
# does not; and make one that does from every state.
#
# Lines that begin with `assert` check what the text says, for the numbers as they stand here; when
# you change a number, one may stop you: it says which sentence no longer holds, and may be deleted.

# %%
from dataclasses import replace

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optax
from matplotlib.collections import PolyCollection

import jaxmpc as jm

jax.config.update("jax_enable_x64", True)

# %% [markdown]
# ## The plant
#
# A rod that falls: $x = (q, \dot q)$ with $|q| \le 1$ rad and $|\dot q| \le 1$ rad/s. It falls away
# from $q = 0$ with $\ddot q = 3 q + u$, and the input is at most 1 rad/s²: where $|q|$ is large it
# cannot be held any more. The sampling time is 0.1 s.

# %%
system = jm.LinearSystem([[1, 0.1], [0.3, 1]], [[0.005], [0.1]], dt=0.1)
states, inputs = jm.Box([-1, -1], [1, 1]), jm.Box([-1], [1])
guess = jm.MPC(system, np.eye(2), np.eye(1), 10, states=states, inputs=inputs)

# %% [markdown]
# ## An MPC that learns
#
# An expert weighs the position nine times as much as we do. We do not see its weights, only 200
# states and the inputs that it chose there. `MPCLayer` makes the problem a function of free numbers
# θ, with the derivatives of its plans; all else is ordinary gradient descent. Only $Q$ is learned:
# a common factor of $Q$ and $R$ would change nothing.

# %%
solver = jm.ADMM(newton_steps=0, eps=1e-4)  # compiles sooner
layer = jm.tuning.MPCLayer(guess, learn=("Q",), solver=solver)
x = np.random.default_rng(0).uniform([-0.15, -0.2], [0.15, 0.2], (200, 2))
chosen = jm.solve_many(replace(guess, Q=np.diag([9.0, 1.0])), x).inputs[:, 0]
adam = optax.adam(0.1)


def loss(theta):
    return jnp.mean((jax.vmap(layer, (None, 0))(theta, x).u - chosen) ** 2)


@jax.jit
def update(theta, state):
    value, gradient = jax.value_and_grad(loss)(theta)
    change, state = adam.update(gradient, state)
    return optax.apply_updates(theta, change), state, value


theta, losses, weights = layer.init(), [], []
state = adam.init(theta)
for _ in range(250):
    weights.append(np.diag(layer.values(theta)["Q"]))
    theta, state, value = update(theta, state)
    losses.append(float(value))
print("loss", losses[0], "->", losses[-1])
print("weights of position and velocity:", np.round(weights[-1], 3))
assert np.allclose(weights[-1], [9, 1], rtol=0.02), "The hidden weights are found to 2 %."

# %%
fig, (left, right) = plt.subplots(1, 2, figsize=(8, 3.2))
left.semilogy(losses)
left.set(xlabel="step of Adam", ylabel="mean square error of the inputs")
right.plot(weights, label=["position", "velocity"])
for weight in (9, 1):
    right.axhline(weight, color="gray", linewidth=0.8, linestyle="--")
right.set(xlabel="step of Adam", ylabel="weight (dashed: the expert's)")
right.legend()
fig.tight_layout()

# %% [markdown]
# ## An MPC that teaches
#
# Now the MPC is the expert. A network does not know limits. So we say first what it must not do:
# leave the set $C$ of all states from which some input keeps the limits for ever. Its teacher is an
# MPC whose next state has to be in $C$. `sample_feasible_set` draws states that are uniform on
# $C$, each proved feasible, and `solve` finds their plans.


# %%
def teacher(room):
    """Return C and an MPC on it; whatever is added to its input up to `room` leads into C too."""
    less, error = jm.Box([room - 1], [1 - room]), jm.Box([-room], [room])
    known = {"disturbance": error, "disturbance_matrix": system.B} if room else {}
    C = jm.sets.maximal_control_invariant_set(system, states, less, **known)
    deep = C.h - room * np.abs(C.H @ system.B)[:, 0]
    stays = jm.mpc.Outputs(C.H, upper=deep, stages=(1,))
    return C, replace(guess, inputs=less, outputs=stays, terminal_cost=10 * np.eye(2))


def lesson(expert, count):
    samples = jm.feasible.sample_feasible_set(expert, count)
    return jnp.asarray(samples.states), jnp.asarray(samples.solve().inputs[:, 0])


C, expert = teacher(room=0.0)
data = lesson(expert, 10_000)
print(f"C has {len(C.h)} half-spaces; {data[0].shape[0]} states with plans")

# %% [markdown]
# The network has two hidden layers of 16 units, max(·, 0), and its output is cut to ± 1.


# %%
def network_input(network, x):
    for W, b in network[:-1]:
        x = jax.nn.relu(x @ W.T + b)
    W, b = network[-1]
    return jnp.clip(x @ W.T + b, -1, 1)


def train(data, updates, seed=0):
    x, u = data
    random = np.random.default_rng(seed)
    shapes = [(16, 2), (16, 16), (1, 16)]
    network = [(random.normal(size=s) * (2 / s[1]) ** 0.5, np.zeros(s[0])) for s in shapes]
    network = jax.tree.map(jnp.asarray, network)
    rule = optax.adam(optax.cosine_decay_schedule(0.01, updates))

    def step(carry, key):
        network, state = carry
        rows = jax.random.randint(key, (256,), 0, len(x))
        loss = lambda network: jnp.mean((network_input(network, x[rows]) - u[rows]) ** 2)
        change, state = rule.update(jax.grad(loss)(network), state)
        return (optax.apply_updates(network, change), state), None

    keys = jax.random.split(jax.random.key(seed), updates)
    return jax.lax.scan(step, (network, rule.init(network)), keys)[0][0]


few = tuple(part[:10] for part in data)
first = train(few, 3000)
proof = jm.explicit.prove_network(first, system, C, inputs, cells=50_000)
print(proof)
assert proof.broken > 0.01, "From more than a hundredth of C it leads out of it."

# %% [markdown]
# `prove_network` cuts $C$ into triangles and encloses the network's input over each of them: where
# the next state is in $C$ for all states of a triangle, it is proved; where for none, refuted;
# others are cut in two. This network has seen ten plans only, and is caught: from more than a
# hundredth of $C$ it leads out. Loops that begin there show what that means.


# %%
def loop(law, x, length=25):
    step = lambda x, _: (system.step(x, law(x)), x)
    return jax.vmap(lambda x: jax.lax.scan(step, x, length=length)[1])(x)


def excess(network, x):
    following = x @ system.A.T + network_input(network, x) @ system.B.T
    return jnp.max(following @ C.H.T - C.h, axis=1)


fresh = jnp.asarray(C.sample(20_000, seed=1))
wrong = fresh[jnp.argsort(-excess(first, fresh))[:3]]
out = loop(lambda x: network_input(first, x), wrong)
print(f"most beyond a limit: {float(jnp.max(jnp.abs(out)) - 1):.2f}")
assert jnp.max(jnp.abs(out)) > 1.1, "Its loops leave the limits."

# %% [markdown]
# ## A filter
#
# With one input the inputs that lead into $C$ are an interval: each half-space of $C$ bounds $u$ on
# one side. A network whose input is moved into that interval keeps all limits, however badly it was
# trained.


# %%
def filtered(x):
    slope, room = C.H @ system.B[:, 0], C.h - C.H @ (system.A @ x)
    ends = room / jnp.where(slope == 0, 1, slope)
    low = jnp.max(jnp.where(slope < 0, ends, -1))
    high = jnp.min(jnp.where(slope > 0, ends, 1))
    return jnp.clip(network_input(first, x), jnp.maximum(low, -1), jnp.minimum(high, 1))


kept = loop(filtered, fresh[:500])
print("most beyond a limit, with the filter:", max(0, float(jnp.max(jnp.abs(kept)) - 1)))
assert jnp.max(jnp.abs(kept)) <= 1 + 1e-9, "With the filter all loops keep the limits."


# %%
def outline(body):
    corners = body.vertices()
    aside = corners - corners.mean(axis=0)
    return corners[np.argsort(np.arctan2(aside[:, 1], aside[:, 0]))]


fig, axes = plt.subplots(1, 2, figsize=(8, 3.6), sharey=True)
for ax, runs, title in zip(
    axes, (out, loop(filtered, wrong)), ("network", "filtered"), strict=True
):
    ax.fill(*outline(C).T, color="tab:blue", alpha=0.12)
    for run in runs:
        ax.plot(*run.T, ".-", markersize=3, linewidth=0.8)
    ax.plot(*wrong.T, "ko", markersize=4)
    ax.axvline(1, color="gray", linewidth=0.8, linestyle="--")
    ax.axvline(-1, color="gray", linewidth=0.8, linestyle="--")
    ax.set(xlabel="position (rad)", title=title, xlim=(-1.2, 1.2), ylim=(-1.2, 1.2))
axes[0].set_ylabel("velocity (rad/s)")
fig.tight_layout()

# %% [markdown]
# ## Proved from every state
#
# Along two sides of $C$ a single input is left that leads into it. No network gives exactly that,
# and however small the triangles are, some stay undecided there. The cure is room for errors: $C$
# is made for inputs that may be off by 0.05, the teacher's next state lies so deep in it that such
# an error leads nowhere else, and a network that comes as near as that is right.


# %%
second = train(data, 6000)
nearly = jm.explicit.prove_network(second, system, C, inputs, cells=50_000)
C_room, expert_room = teacher(room=0.05)
network = train(lesson(expert_room, 10_000), 6000)
always = jm.explicit.prove_network(network, system, C_room, inputs, cells=50_000)
print("no room:", nearly)
print("room   :", always)
print(f"what the room costs: {1 - C_room.volume() / C.volume():.2%} of the area of C")
assert always.undecided == always.broken == 0, "Every triangle is proved."
assert nearly.undecided > 0, "Without room some triangles stay undecided."

# %% [markdown]
# The second network keeps all limits for ever from every state of its set, without a solver and
# without a filter. What is open in the other two:

# %%
fig, axes = plt.subplots(1, 3, figsize=(9, 3.2), sharey=True)
titles = "ten plans", "10,000 plans", "10,000 plans and room"
proofs, bodies = (proof, nearly, always), (C, C, C_room)
for ax, found, body, title in zip(axes, proofs, bodies, titles, strict=True):
    ax.fill(*outline(body).T, color="tab:green", alpha=0.25)
    cells = PolyCollection(found.open_cells, facecolor="tab:red", edgecolor="tab:red")
    ax.add_collection(cells)
    ax.set(xlabel="position (rad)", xticks=[-1, 0, 1], title=f"{title}\nproved {found.kept:.3%}")
axes[0].set_ylabel("velocity (rad/s)")
fig.tight_layout()

# %% [markdown]
# Red are the triangles that are undecided. In the first picture they bound, on the right, the
# states from which that network leads out of $C$. The law of the last network, and how far it is
# from the teacher's, which stays 0.05 away from the limits of the input:

# %%
grid = C_room.sample(4000, seed=2)
given = np.asarray(network_input(network, grid))[:, 0]
asked = np.asarray(jm.solve_many(expert_room, grid).inputs)[:, 0, 0]
fig, (left, right) = plt.subplots(1, 2, figsize=(8.5, 3.4), sharey=True)
shown = left.scatter(*grid.T, c=given, s=3, cmap="coolwarm")
fig.colorbar(shown, ax=left, label="input of the network")
shown = right.scatter(*grid.T, c=np.abs(given - asked), s=3, cmap="viridis")
fig.colorbar(shown, ax=right, label="distance from the teacher's")
left.set(xlabel="position (rad)", ylabel="velocity (rad/s)")
right.set(xlabel="position (rad)")
fig.tight_layout()
print(f"largest distance: {np.abs(given - asked).max():.4f}")

# %% [markdown]
# ## Exercises
#
# 1. Let the layer learn `("Q", "R")`. The loss falls as far, and the weights end elsewhere. What do
#    they have in common with the expert's?
# 2. How few plans are enough for a network that is proved from every state? How small may the room
#    be?
# 3. Filter the input of the first network, let a new one learn what it does then, and prove it.
#
# `experiments/learning/approximate.py` does the same for 10⁶ plans and for four states,
# `experiments/learning/policy.py` trains an MPC by reinforcement learning.
