"""tune_feasible_set: enlarge the feasible set by gradient descent."""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array

from jaxmpc.arrays import Reals
from jaxmpc.batches import chosen_devices
from jaxmpc.checks import fail
from jaxmpc.feasible.smooth_fraction import MOST_STEPS, membership
from jaxmpc.mpc.problem import MPC
from jaxmpc.qp.linalg import arrays
from jaxmpc.tuning.batch_mean import BatchMean
from jaxmpc.tuning.descent import Settings, descend
from jaxmpc.tuning.parameters import Parameters, raw, require_parameters, values
from jaxmpc.tuning.result import TuningRun, finished


def tune_feasible_set(
    make_mpc: Callable[[Mapping[str, Any]], MPC],
    parameters: Parameters,
    x0s: Reals,
    width: float = 0.02,
    *,
    design_loss: Callable[[MPC], Any] | None = None,
    newton_steps: int = MOST_STEPS,
    **settings: Any,
) -> TuningRun:
    """Enlarge the feasible set by gradient: min_θ design_loss(mpc) − feasible_fraction(mpc, x0s).

    make_mpc, parameters: as in `tune_weights`, make_mpc to an MPC. x0s (B, n): states spread
    evenly over the region that matters, such as a `grid` or a uniform sample. width,
    newton_steps: as in `feasible_fraction`. design_loss: a cost that is traded against the
    size of the set, a number computed from the problem alone. (To trade it against the cost of
    closed loops, give `tune_weights` design_loss=lambda mpc: -weight * feasible_fraction(mpc,
    ...).) settings: of `Settings`, as updates=50; optimizer None: Adam of 0.05.

    Returns a `TuningRun` whose result is the MPC problem. Computes in float64. The fraction is
    smoothed and sampled: check the result by `map_feasible_set`, before and after. Numbers of
    the history: fraction, and design, the design loss. Raises ValueError for what does not fit
    together, before any compile.
    """
    require_parameters(parameters)
    chosen = Settings.of("tune_feasible_set", settings)
    chosen.validate()
    x0s = np.asarray(x0s, np.float64)
    if x0s.ndim != 2 or not len(x0s):
        fail("x0s", f"shape {x0s.shape}", "Give states (B, n), one a row")
    train, test = chosen.split(x0s, shuffle=True)

    def total(theta: Any, x0s: Array, weights: Array) -> tuple[Array, dict[str, Array]]:
        mpc = make_mpc(values(parameters, theta))
        if not isinstance(mpc, MPC):
            fail("make_mpc", f"returns a {type(mpc).__name__}", "Return a jm.MPC")
        inside = membership(mpc, x0s, width, newton_steps=newton_steps)
        fraction = jnp.sum(weights * inside) / jnp.sum(weights)
        design = jnp.zeros(()) if design_loss is None else jnp.asarray(design_loss(mpc))
        return design - fraction, {"fraction": fraction, "design": design}

    slope, value = (
        BatchMean(lambda *args, f=f: (f(*args), {}), chosen_devices(chosen.devices), (False, True))
        for f in (jax.value_and_grad(total, has_aux=True), total)
    )

    def gradient(theta: Any, step: int) -> tuple[float, Any, dict[str, float]]:
        rows = chosen.minibatch(len(train), step)
        with jax.enable_x64(True):
            x = train[rows]
            ((loss, numbers), slopes), _ = slope(*arrays((theta, x, np.ones(len(x)))))
        return float(loss), slopes, numbers

    def validate(theta: Any) -> tuple[float, dict[str, float]]:
        with jax.enable_x64(True):
            (loss, numbers), _ = value(*arrays((theta, test, np.ones(len(test)))))
        return float(loss), numbers

    decides = chosen.decides(parameters, train, test)
    decides |= {"width": float(width), "newton_steps": newton_steps, "dtype": "float64"}
    history = descend(raw(parameters), gradient, validate, optax.adam(0.05), chosen, decides)
    return finished(TuningRun.of_parameters(parameters, history, decides, make_mpc))
