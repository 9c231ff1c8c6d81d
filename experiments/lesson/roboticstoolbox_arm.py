"""End of section 7: a manipulator, from its rigid-body dynamics to constrained MPC.

A planar arm with two revolute joints and gravity, M(q) ddq + C(q, dq) dq + g(q) + D dq = tau
(Spong, Hutchinson & Vidyasagar 2006, section 7.3): what roboticstoolbox gives as robot.inertia(q),
robot.coriolis(q, dq) and robot.gravload(q). About an equilibrium (q*, 0, g(q*)), with
x = (q − q*, dq) and u = tau − g(q*),

    dx/dt = [0, I; −M⁻¹ ∂g/∂q, −M⁻¹ D] x + [0; M⁻¹] u,

sampled with the torques held constant. `joint_limits` makes the sets of positions, velocities and
torques, in deviations. The controller drives its linear model, then the arm itself (Runge-Kutta):
there the hard velocity limits are overrun by the model's error and no plan is left; with soft
limits (section 4) the loop goes through, and the table says by how much they are exceeded.

    python experiments/lesson/roboticstoolbox_arm.py
"""

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jax import Array

import jaxmpc as jm
from jaxmpc.closed_loop.simulation import simulate
from jaxmpc.mpc.problem import soften
from jaxmpc.sets.limits import JointLimits, joint_limits


@dataclass(frozen=True)
class Settings:
    """goal, start: joint angles (rad). steps: samples of dt seconds. horizon: N. rho: penalty of
    the soft limits."""

    goal: tuple[float, float] = (0.6, 0.9)
    start: tuple[float, float] = (-0.7, 0.2)
    steps: int = 80
    dt: float = 0.02
    horizon: int = 20
    rho: float = 1e4


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Arm:
    """Two links of length l (m), mass m (kg), centre of mass at r (m), inertia I (kg m²) about it,
    viscous friction D (N m s), gravity (m/s²) along −y; q1 from the x axis, q2 relative to it."""

    l: float = 0.5
    m: tuple[float, float] = (3.0, 2.0)
    r: tuple[float, float] = (0.25, 0.2)
    I: tuple[float, float] = (0.06, 0.03)
    D: tuple[float, float] = (0.5, 0.3)
    gravity: float = 9.81

    def inertia(self, q: Array) -> Array:
        """M(q) (2, 2), kg m²."""
        (m1, m2), (r1, r2), (I1, I2) = self.m, self.r, self.I
        inner = m2 * (r2**2 + self.l * r2 * jnp.cos(q[1])) + I2
        own = m2 * r2**2 + I2
        first = m1 * r1**2 + I1 + m2 * (self.l**2 + 2 * self.l * r2 * jnp.cos(q[1])) + own
        return jnp.array([[first, inner], [inner, own]])

    def coriolis(self, q: Array, dq: Array) -> Array:
        """C(q, dq) (2, 2), with dM/dt − 2C skew-symmetric."""
        h = -self.m[1] * self.l * self.r[1] * jnp.sin(q[1])
        return h * jnp.array([[dq[1], dq[0] + dq[1]], [-dq[0], 0.0]])

    def gravload(self, q: Array) -> Array:
        """g(q) (2,), N m: the torques that hold the arm."""
        (m1, m2), (r1, r2) = self.m, self.r
        outer = m2 * r2 * jnp.cos(q[0] + q[1])
        return self.gravity * jnp.array([(m1 * r1 + m2 * self.l) * jnp.cos(q[0]) + outer, outer])

    def gravity_gradient(self, q: Array) -> Array:
        """∂g/∂q (2, 2)."""
        (m1, m2), (r1, r2) = self.m, self.r
        outer = m2 * r2 * jnp.sin(q[0] + q[1])
        first = (m1 * r1 + m2 * self.l) * jnp.sin(q[0]) + outer
        return -self.gravity * jnp.array([[first, outer], [outer, outer]])

    def acceleration(self, q: Array, dq: Array, tau: Array) -> Array:
        """ddq (2,)."""
        load = self.coriolis(q, dq) @ dq + self.gravload(q) + jnp.asarray(self.D) * dq
        return jnp.linalg.solve(self.inertia(q), tau - load)

    def linearised(self, q: Array, dt: float, limits: JointLimits) -> jm.LinearSystem:
        """The sampled linear model about rest at q."""
        inverse = np.linalg.inv(self.inertia(q))
        zero, one = np.zeros((2, 2)), np.eye(2)
        A = np.block([
            [zero, one], [-inverse @ self.gravity_gradient(q), -inverse @ np.diag(self.D)]
        ])  # fmt: skip
        B = np.vstack([zero, inverse])
        return jm.LinearSystem.from_continuous(A, B, dt, **limits.names)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Plant:
    """The arm in deviations from rest at q: a plant for `simulate`."""

    arm: Arm
    q: Array
    dt: float
    substeps: int = field(default=4, metadata={"static": True})

    def step(self, x: Array, u: Array) -> Array:
        """One sampling period by the classical Runge-Kutta method."""
        tau, h = u + self.arm.gravload(self.q), self.dt / self.substeps

        def slope(x: Array) -> Array:
            return jnp.concatenate([x[2:], self.arm.acceleration(x[:2] + self.q, x[2:], tau)])

        def substep(x: Array, _: None) -> tuple[Array, None]:
            a = slope(x)
            b = slope(x + h / 2 * a)
            c = slope(x + h / 2 * b)
            d = slope(x + h * c)
            return x + h / 6 * (a + 2 * b + 2 * c + d), None

        return jax.lax.scan(substep, x, length=self.substeps)[0]


def deviations(arm: Arm, q: np.ndarray) -> JointLimits:
    """About rest at q: |q1| ≤ 1.2, −0.3 ≤ q2 ≤ 2 rad, |dq| ≤ 2 rad/s, |tau| ≤ (40, 12) N m."""
    q_min, q_max = np.array([-1.2, -0.3]), np.array([1.2, 2.0])
    tau_max, load = np.array([40.0, 12.0]), np.asarray(arm.gravload(q))
    position, torque = (q_min - q, q_max - q), (-tau_max - load, tau_max - load)
    return joint_limits(position, (-2 * np.ones(2), 2 * np.ones(2)), torque)


def control_problem(s: Settings, arm: Arm) -> jm.MPC:
    """MPC of the linear model: LQR cost at the end, state limits on x_N too."""
    q = np.array(s.goal)
    limits = deviations(arm, q)
    system = arm.linearised(q, s.dt, limits)
    Q, R = np.diag([100.0, 100.0, 1.0, 1.0]), np.diag([0.01, 0.05])
    return jm.MPC(
        system, Q, R, horizon=s.horizon, states=limits.states, inputs=limits.inputs,
        terminal_cost=jm.lqr(system, Q, R).P, terminal_set=limits.states,
    )  # fmt: skip


def run(s: Settings) -> dict[str, dict]:
    """Print a table of the three loops; return what it says and the loops themselves."""
    arm, q = Arm(), np.array(s.goal)
    mpc = control_problem(s, arm)
    x0 = np.concatenate([np.array(s.start) - q, np.zeros(2)])
    true = Plant(arm, q, s.dt)
    hard, soft = jm.Controller(mpc), jm.Controller(soften(mpc, s.rho))
    loops = {
        "linear model, hard limits": simulate(hard, mpc.system, x0, s.steps),
        "the arm, hard limits": simulate(hard, true, x0, s.steps),
        "the arm, soft limits": simulate(soft, true, x0, s.steps),
    }
    H, h = np.asarray(mpc.states.H), np.asarray(mpc.states.h)
    table = {}
    print(
        f"{'loop':28}{'solved':>10}{'excess':>12}{'of limit':>20}{'max |tau|':>16}{'|q − q*|':>11}"
    )
    for name, loop in loops.items():
        x, u = np.asarray(loop.states), np.asarray(loop.inputs)
        excess = (x @ H.T - h).max(axis=0)
        worst = int(np.argmax(excess))
        tau = np.abs(u + np.asarray(arm.gravload(q))).max(axis=0)
        error = np.abs(x[-1, :2]).max()
        print(
            f"{name:28}{int(loop.feasible_steps):4} of{s.steps:3}{max(excess[worst], 0):12.1e}"
            f"{mpc.states.labels[worst]:>20}{tau[0]:9.2f}{tau[1]:7.2f}{error:11.1e}"
        )
        table[name] = {
            "feasible_steps": int(loop.feasible_steps), "excess": max(excess[worst], 0.0),
            "tau": tau, "error": error, "loop": loop,
        }  # fmt: skip
    print(f"\n{'t [s]':>6}" + "".join(f"{label:>14}" for label in mpc.system.state_labels))
    soft_states = np.asarray(loops["the arm, soft limits"].states)
    for k in range(0, s.steps + 1, 10):
        print(f"{k * s.dt:6.2f}" + "".join(f"{v:14.4f}" for v in soft_states[k]))
    return table


if __name__ == "__main__":
    with jax.enable_x64(True):
        run(tyro.cli(Settings, description=__doc__))
