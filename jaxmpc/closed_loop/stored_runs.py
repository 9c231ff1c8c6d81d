"""Closed loops of many robots in a store: block by block, resumed after an interruption."""

from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from tqdm.std import tqdm

from jaxmpc.arrays import Reals
from jaxmpc.batches import Timing, first_rows, padded
from jaxmpc.checks import fail
from jaxmpc.closed_loop.many import simulate_many
from jaxmpc.closed_loop.run import Run
from jaxmpc.closed_loop.variations import plant_numbers
from jaxmpc.files import check_results, fingerprint
from jaxmpc.pytrees import record
from jaxmpc.qp.status import Status
from jaxmpc.robots.load import model_hash
from jaxmpc.robots.robot import Robot

if TYPE_CHECKING:
    from jaxmpc.store import Field

# The fields of `Run` in a store. Stored runs have no observer, hence no estimates, and no soft rows
# at k = 0: x_0 is measured, and no limit binds it.
STORED = tuple(field.name for field in fields(Run) if field.name not in ("slack", "estimates"))


@record
class StoredRuns:
    """What `simulate_into` returns: the runs (B, ...) in NumPy arrays, the settings in the store,
    and the work of this call."""

    run: Run
    settings: Mapping[str, Any]
    timing: Timing


def simulate_into(
    path: str | Path, controller: Any, robot: Robot, x0s: Reals, steps: int, *,
    reference: Reals | None = None, input_reference: Reals | None = None,
    factors: Mapping[str, np.ndarray] | None = None, settings: Mapping[str, Any] | None = None,
    chunk: int = 256, devices: Any = None, resume: bool = False, overwrite: bool = False,
    progress: bool = False, begun: Callable[[], None] = lambda: None,
) -> StoredRuns:  # fmt: skip
    """Simulate many robots into a store, block by block, each written as soon as it is done.

    path: a folder or URL (`jaxmpc.store`), which xarray.open_zarr reads: `points` (the starts),
        states, inputs, cost, status, stage_cost, violation, fallback, and the factors.
    controller, robot, x0s (B, nq + nv), steps, reference, input_reference, devices: as in
        `simulate_many`. Runs are in the precision of the controller.
    factors: by which the plants differ from the robot, of `draw_factors`.
    settings: JSON data that determine the runs: a store with others is refused. None: hashes of
        controller, model, references and factors.
    chunk: robots of a block: what is written at once, and lost at most.
    resume: go on with the runs at `path`. overwrite: put new ones in their place, once their first
        block is done. Without either there must be none.
    progress: show a progress bar, where stderr is a terminal.
    begun: is called when these runs lie at `path`, hence when overwritten ones are gone.

    Raises ValueError for wrong arguments, and as `jaxmpc.store.Store` does.
    """
    from jaxmpc.store import Constant, Store, report_damage

    check_results(path, resume, overwrite)
    target: dict[str, Any] = {"reference": reference, "input_reference": input_reference}
    x0s, factors, timing = np.asarray(x0s), dict(factors or {}), Timing()
    if x0s.ndim != 2 or not len(x0s):
        fail("x0s", f"shape {x0s.shape}", f"Give (B, {robot.state_size}), B ≥ 1")
    if settings is None:
        data = jax.tree.leaves((controller, target, factors))
        data_hash = fingerprint(_constants(controller), data)
        settings = {"steps": steps, "model": model_hash(robot), "data": data_hash}
    if factors:  # raises ValueError where they do not fit, before there is a store
        robot.vary(**{key: value[0] for key, value in plant_numbers(robot, factors).items()})
    number = Constant(np.arange(len(x0s)), ("sample",), {"long_name": "robot"})
    points = Constant(x0s, ("sample", "state"), {"long_name": "initial state"})
    results = _fields(robot, steps, np.dtype(controller.dtype).name, factors)
    with Store(
        path, {"sample": number}, results, settings, chunk, constants={"points": points},
        overwrite=overwrite, begun=begun,
    ) as store:  # fmt: skip
        report_damage(store)
        blocks = {block: store.rows(block) for block in store.pending()}
        total = sum(rows.stop - rows.start for rows in blocks.values())
        with tqdm(total=total, unit=" robots", disable=None if progress else True) as bar:
            for block, rows in blocks.items():
                own = {key: value[rows] for key, value in factors.items()}
                numbers = plant_numbers(robot, own)
                variations = {key: padded(value, store.size) for key, value in numbers.items()}
                count = rows.stop - rows.start
                with timing.work(count):
                    run = simulate_many(
                        controller, robot, padded(x0s[rows], store.size), steps, **target,
                        variations=variations, devices=devices,
                    )  # fmt: skip
                run = first_rows(run, count)
                store.commit(block, **{name: getattr(run, name) for name in STORED}, **own)
                bar.update(count)
        found: dict[str, Any] = {name: store.read(name) for name in STORED}
        found["slack"] = np.zeros((*found["status"].shape, 0))
        run = Run(**found)
        return StoredRuns(run, store.attributes["config"], timing)


def _fields(
    robot: Robot, steps: int, dtype: str, factors: Mapping[str, np.ndarray]
) -> "dict[str, Field]":
    """Return what the store holds of each robot."""
    from jaxmpc.store import Field

    number = lambda shape, *axes: Field(shape, dtype, np.nan, axes)
    found = {
        "states": number((steps + 1, robot.state_size), "sample_time", "state"),
        "inputs": number((steps, robot.m), "time", "input"),
        "cost": number((steps,), "time"),
        "status": Field((steps,), "int8", int(Status.NOT_RUN), ("time",)),
        "stage_cost": number((steps,), "time"),
        "violation": number((steps + 1,), "sample_time"),
        "fallback": Field((steps,), "bool", False, ("time",)),
    }
    for name, factor in factors.items():
        shape = np.shape(factor)[1:]
        found[name] = Field(shape, "float64", np.nan, (f"{name}_of",) * len(shape))
    return found


def _constants(value: Any) -> Any:
    """Return what is no array in a dataclass as JSON data: numbers, texts, and names of types."""
    if is_dataclass(value):
        return {field.name: _constants(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, tuple):
        return [_constants(part) for part in value]
    plain = value is None or isinstance(value, bool | int | float | str)
    return value if plain else type(value).__name__
