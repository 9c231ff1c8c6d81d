"""Problem 5: joint limits as G_x x ≤ g_x for x = (q, dq), each row with its name and unit.

`joint_limits` stacks position and velocity limits with the selectors S_q = [I 0], S_dq = [0 I]:
G_x = [S_q; −S_q; S_dq; −S_dq]. The lesson's own rows, [I; −I] S_q x ≤ (q_max, −q_min), are the
first of them; a joint without a limit (here the last one, which turns for ever) has no row.

    python experiments/lesson/problem_5_joint_limits.py
"""

import numpy as np
import tyro

from jaxmpc.sets.limits import JointLimits, joint_limits

Q_MIN = np.array([-2.9, -1.8, -np.inf])
Q_MAX = np.array([2.9, 1.2, np.inf])
DQ_MAX = np.array([2.0, 2.0, 3.0])
TAU_MAX = np.array([80.0, 60.0, 20.0])
NAMES = ("shoulder", "elbow", "wrist")


def run() -> JointLimits:
    """Print G_x, g_x with labels, and the torque limits; return them."""
    limits = joint_limits((Q_MIN, Q_MAX), (-DQ_MAX, DQ_MAX), (-TAU_MAX, TAU_MAX), names=NAMES)
    G, g = np.asarray(limits.states.H), np.asarray(limits.states.h)
    print("x = " + ", ".join(limits.state_names))
    print(f"{'G_x':^26}{'g_x':>6}   row")
    for row, bound, label in zip(G, g, limits.states.labels, strict=True):
        print("".join(f"{v:4.0f}" for v in row) + f"{bound:8.2f}   {label}")
    bounds = zip(limits.inputs.lower, limits.input_names, limits.inputs.upper, strict=True)
    for lower, name, upper in bounds:
        print(f"{lower:.0f} ≤ {name} ≤ {upper:.0f} {limits.input_units[0]}")
    return limits


if __name__ == "__main__":
    tyro.cli(run, description=__doc__)
