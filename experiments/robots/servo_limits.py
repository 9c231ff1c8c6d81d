"""A servo with a limited force: do plans that promise to keep the position limit keep it?

    python experiments/robots/servo_limits.py [--states 256]

1 kg m² on a position servo of 200 N m/rad and 20 N m s/rad with 3 N m at most, |q| ≤ 1 rad, plans
of 0.2 s, from random states, of which a quarter cannot be stopped inside the limit (v²/2a).
Compared: no rows of the force, its rows alone, and with those of stopping, as `robot_mpc` has them.
"""

import argparse
import warnings
from dataclasses import replace

import mujoco
import numpy as np

import jaxmpc as jm

SERVO = """<mujoco><option gravity="0 0 0" integrator="implicitfast"/><worldbody><body>
<joint name="j" axis="0 0 1"/><geom type="capsule" fromto="0 0 0 1 0 0" size=".02" mass="3"/></body>
</worldbody><actuator><position joint="j" kp="200" kv="20" ctrlrange="-1.2 1.2" forcerange="-3 3"/>
</actuator></mujoco>"""
# 3 N m over the inertia of the capsule, rad/s².
DECELERATION = 2.959


def main() -> None:
    """Print a row for each kind of rows."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--states", type=int, default=256)
    count = parser.parse_args().states
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        robot = jm.load_robot(mujoco.MjModel.from_xml_string(SERVO), position=1.0)
    x0s = np.random.default_rng(1).uniform([-0.9, -3], [0.9, 3], (count, 2))
    reach = np.sign(x0s[:, 1]) * x0s[:, 0] + x0s[:, 1] ** 2 / (2 * DECELERATION)
    possible, mpc = reach < 1, jm.robot_mpc(robot)
    force, stopping = mpc.outputs
    kinds = {"none": (), "force": (force,), "force and stopping": (force, stopping)}
    print(f"{count} states, {possible.sum()} of which can be stopped")
    for name, rows in kinds.items():
        controller = jm.RobotController(robot, replace(mpc, outputs=rows))
        run = jm.simulate_many(controller, robot, x0s, 120)
        worst = np.abs(run.states[:, :, 0]).max(axis=1)
        promised = (run.status[:, 0] == jm.Status.SOLVED) & ~run.fallback[:, 0]
        broken, kept = promised & (worst > 1), np.mean(worst[possible] <= 1)
        beyond, share = max(worst[promised].max() - 1, 0), np.mean(promised[possible])
        print(
            f"{name:20} promised {promised.sum():4}, of these broken {broken.sum()} by up to "
            f"{beyond:.3f} rad; of what can be stopped kept {kept:.1%}, promised {share:.1%}"
        )


if __name__ == "__main__":
    main()
