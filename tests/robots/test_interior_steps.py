"""The interior point method ends where rounding stops it, on the plans of an arm."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmpc as jm
from jaxmpc.mpc.stagewise import solve as stagewise

# Without that end some of these plans took all 40 steps that are allowed, most of them in vain.
MOST = 30


@pytest.mark.slow
def test_no_steps_after_rounding_stops_them(monkeypatch):
    robot = jm.load_robot("arm7")
    nv, x_ref, u_ref = robot.mujoco.nv, *robot.equilibrium()
    Q, R = np.r_[np.full(nv, 10.0), np.full(nv, 0.1)], np.full(robot.m, 1e-3)
    mpc = jm.robot_mpc(robot, Q, R, 20)
    soft = jm.soften(mpc, 1e3)
    home = np.asarray(robot.coordinates(x_ref))
    far = (
        np.random.default_rng(0).normal(size=(64, 2 * nv))
        * np.r_[np.full(nv, 0.4), np.full(nv, 0.3)]
    )
    inside = 0.95 * np.asarray(mpc.states.lower), 0.95 * np.asarray(mpc.states.upper)
    starts = jnp.asarray(np.clip(home + far, *inside), jnp.float32)
    inputs = jnp.asarray(u_ref, jnp.float32)
    aim = jnp.asarray(home, jnp.float32)
    solver = jm.ADMM(iterations=0, newton_steps=None)
    taken = []
    loop = stagewise._while_open

    def counted(step, most, constants, state):
        end = loop(step, most, constants, state)
        if most == stagewise.INTERIOR_STEPS:
            jax.debug.callback(lambda steps: taken.append(int(steps)), end.steps)
        return end

    monkeypatch.setattr(stagewise, "_while_open", counted)

    def plan(xi):
        model = replace(soft, system=robot.linearize(robot.state(xi), inputs))
        return jm.mpc.solve_stagewise(model, xi, aim, solver, input_reference=inputs)

    plans = jax.block_until_ready(jax.jit(jax.vmap(plan))(starts))
    jax.effects_barrier()
    assert (plans.status == jm.Status.SOLVED).all()
    assert np.sum(np.array(taken) > 0) > 30, "most of these starts need the method"
    assert max(taken) <= MOST
