"""The robust MPC whose claims hold for a nonlinear robot."""

from typing import Any

from jaxmpc.arrays import Reals
from jaxmpc.checks import require_kind, whole
from jaxmpc.closed_loop.robot_controller import bryson_weights
from jaxmpc.mpc.problem import MPC
from jaxmpc.robots.linear_enclosures import LinearEnclosure
from jaxmpc.sets.convex_sets import Box, translated
from jaxmpc.sets.invariant import maximal_invariant_set
from jaxmpc.systems.riccati import lqr
from jaxmpc.systems.system import LinearSystem


def enclosed_mpc(
    enclosure: LinearEnclosure,
    Q: Reals | None = None,
    R: Reals | None = None,
    horizon: int = 20,
    *,
    gain: Reals | None = None,
    **fields: Any,
) -> MPC:
    """Return the robust MPC of a robot's linear model, under all that the model leaves out.

    What is proved of it holds for the nonlinear robot: from a state that `map_feasible_set` labels
    feasible, its policy keeps `enclosure.states` and `enclosure.inputs` for ever, at the sampling
    instants. For each state and input that the policy meets lie in these boxes and the model's next
    state too, so that the robot's next state is the model's plus a w of the disturbance.

    Arguments:
        enclosure: of `jaxmpc.robots.linear_enclosure`.
        Q, R: weights as for `robot_mpc`; None: Bryson's rule with the half-widths of the boxes.
        gain: K (m, n) of the policy and of the terminal set; None: the LQR gain of Q and R.
        fields: of `MPC`, such as `policy`. States are limited at k = 0 … N − 1 and x_N lies in the
            largest set that u = u_s + K (x − x_s) never leaves whatever the disturbance; a claim
            for ever rests on these, and one about N steps on the first.

    Raises ValueError where the disturbance leaves no such set: take smaller boxes (less is left
    out), another gain, or more input.
    """
    require_kind("enclosure", enclosure, LinearEnclosure)
    whole("horizon", horizon, 1)
    system, (x, u) = enclosure.system, (enclosure.x, enclosure.u)
    Q, R = bryson_weights(enclosure.states, enclosure.inputs, system.n // 2, Q, R)
    law = lqr(system, Q, R)
    K = law.K if gain is None else gain
    deviations = LinearSystem(system.A, system.B, dt=system.dt)
    limits = [
        Box(box.lower - at, box.upper - at)
        for box, at in ((enclosure.states, x), (enclosure.inputs, u))
    ]
    last = maximal_invariant_set(deviations, K, *limits, disturbance=enclosure.disturbance)
    usual = {"terminal_cost": law.P, "terminal_set": translated(last, x)}
    usual |= {"states": enclosure.states, "inputs": enclosure.inputs}
    usual |= {"disturbance": enclosure.disturbance}
    usual |= {} if fields.get("policy") == "affine" else {"gain": K}
    mpc = MPC(system, Q, R, horizon, **{**usual, **fields})
    mpc.validate()
    return mpc
