"""Closed loops of many robots in a store: block by block, resumed after an interruption."""

import inspect
from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from functools import partial
from pathlib import Path
from types import CodeType, FunctionType, MethodType, ModuleType
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from jaxmpc.arrays import Reals, numpy_array
from jaxmpc.batches import Part, Timing, first_rows, padded, work_off
from jaxmpc.checks import whole
from jaxmpc.closed_loop.feedback import Feedback
from jaxmpc.closed_loop.simulation import (
    Conditions,
    Run,
    checked_loop,
    initial_states,
    simulate_many,
)
from jaxmpc.closed_loop.variations import plant_numbers
from jaxmpc.files import check_results, fingerprint
from jaxmpc.pytrees import record
from jaxmpc.qp.status import Status
from jaxmpc.robots.load import model_hash
from jaxmpc.robots.mujoco_access import model_bytes
from jaxmpc.robots.parameters import require_numbers
from jaxmpc.robots.robot import Robot

if TYPE_CHECKING:
    from jaxmpc.store import BlockWriter, Field, Store

# The fields of `Run` in a store: without an observer there are no estimates, and violations of soft
# rows at k = 0 are not kept.
STORED = tuple(
    field.name for field in fields(Run) if field.name not in ("slack", "estimates", "disturbances")
)


@record
class StoredRuns:
    """What `simulate_into` returns.

    run: the runs, NumPy arrays (B, ...). settings: those in the store. timing: the work of this
    call.
    """

    run: Run
    settings: Mapping[str, Any]
    timing: Timing


def simulate_into(
    path: str | Path,
    controller: Feedback,
    robot: Robot,
    x0s: Reals,
    steps: int,
    *,
    reference: Reals | None = None,
    input_reference: Reals | None = None,
    factors: Mapping[str, np.ndarray] | None = None,
    settings: Mapping[str, Any] | None = None,
    chunk: int = 256,
    devices: Any = None,
    resume: bool = False,
    overwrite: bool = False,
    progress: bool = False,
    begun: Callable[[], None] = lambda: None,
) -> StoredRuns:
    """Simulate many robots into a store, block by block, each written as soon as it is done.

    path: a folder or URL (`jaxmpc.store`), which xarray.open_zarr reads: `points` (the starts),
        states, inputs, cost, status, stage_cost, violation, fallback, and the factors.
    controller, robot, x0s (B, nq + nv), steps, reference, input_reference, devices: as in
        `simulate_many`. Runs are in the precision of the controller.
    factors: by which the plants differ from the robot, of `draw_factors`.
    settings: JSON data that determine the runs: a store with others is refused. None: hashes of
        controller, models, references and factors. Of functions, such as those of tasks, it is
        their own code, and the data that they close over or read from their module: functions that
        they call are taken to be as before.
    chunk: robots of a block, which run at once, and are written at once while the next ones run: a
        killed run loses the block that runs and those being written (`store.BlockWriter`).
    resume: go on with the runs at `path`. overwrite: put new ones in their place, once their first
        block is done. Without either there must be none.
    progress: show a progress bar, where stderr is a terminal.
    begun: is called when these runs lie at `path`, hence when overwritten ones are gone.

    Raises ValueError for wrong arguments, and as `jaxmpc.store.Store` does.
    """
    from jaxmpc.store import BlockWriter, Constant, Store, report_damage

    check_results(path, resume, overwrite)
    target = {"reference": reference, "input_reference": input_reference, "devices": devices}
    steps = whole("steps", steps, 1)
    loops = _Loops(controller, robot, numpy_array(x0s), steps, target, dict(factors or {}))
    loops.validate()
    number = Constant(np.arange(len(loops.x0s)), ("sample",), {"long_name": "robot"})
    points = Constant(loops.x0s, ("sample", "state"), {"long_name": "initial state"})
    settings, axes = loops.settings() if settings is None else settings, {"sample": number}
    options: dict[str, Any] = {"constants": {"points": points}, "begun": begun}
    timing, shown = Timing(), None if progress else False
    with Store(
        path, axes, loops.fields(), settings, chunk, overwrite=overwrite, **options
    ) as store:
        report_damage(store)
        total = sum(len(store.samples(block)) for block in store.pending())
        with BlockWriter(store) as writer:
            put, parts = partial(loops.put, writer), loops.parts(store, timing)
            work_off(parts, put, total, unit="robots", progress=shown)
        found: dict[str, Any] = {name: store.read(name) for name in STORED}
        found["slack"] = np.zeros((*found["status"].shape, 0))
        return StoredRuns(Run(**found), store.attributes["config"], timing)


@record
class _Loops:
    """Loops that a store is to hold: arguments of `simulate_many`, target and devices by name, and
    the factors of the plants."""

    controller: Feedback
    robot: Robot
    x0s: np.ndarray
    steps: int
    target: dict[str, Any]
    factors: dict[str, np.ndarray]

    def validate(self) -> None:
        """Raise ValueError for starts, steps, aims and factors that `simulate_many` refuses, before
        there is a store."""
        initial_states(self.robot, self.x0s)
        aims = Conditions(self.target["reference"], self.target["input_reference"])
        checked_loop(self.controller, self.robot, self.x0s[0], self.steps, aims)
        if self.factors:
            numbers = plant_numbers(self.robot, self.factors)
            require_numbers(self.robot.plant, numbers, (len(self.x0s),))

    def settings(self) -> dict[str, Any]:
        """Return what determines the runs, as hashes."""
        aims = (self.target["reference"], self.target["input_reference"])
        data_hash = fingerprint(plain_data((self.controller, aims, self.factors)))
        robot = self.robot
        plant = fingerprint(
            repr(sorted(robot.numbers)), [robot.dt, *jax.tree.leaves(robot.numbers)]
        )
        model = model_hash(robot)
        return {"steps": self.steps, "model": model, "plant": plant, "data": data_hash}

    def fields(self) -> "dict[str, Field]":
        """Return what the store holds of each robot."""
        from jaxmpc.store import Field

        steps, dtype = self.steps, np.dtype(self.controller.dtype).name
        number = lambda shape, *axes: Field(shape, dtype, np.nan, axes)
        found = {
            "states": number((steps + 1, self.robot.state_size), "sample_time", "state"),
            "inputs": number((steps, self.robot.m), "time", "input"),
            "cost": number((steps,), "time"),
            "status": Field((steps,), "int8", int(Status.NOT_RUN), ("time",)),
            "stage_cost": number((steps,), "time"),
            "violation": number((steps + 1,), "sample_time"),
            "fallback": Field((steps,), "bool", False, ("time",)),
        }
        for name, factor in self.factors.items():
            shape = np.shape(factor)[1:]
            found[name] = Field(shape, "float64", np.nan, (f"{name}_of",) * len(shape))
        return found

    def parts(self, store: "Store", timing: Timing) -> Iterator[Part[Run]]:
        """Yield the runs of each block that is to be done; `timing` counts no writing of files."""
        for block in store.pending():
            rows = store.rows(block)
            own = {key: value[rows] for key, value in self.factors.items()}
            numbers = plant_numbers(self.robot, own)
            given = self.target | {
                "variations": {key: padded(value, store.size) for key, value in numbers.items()}
            }
            x0s, size = padded(self.x0s[rows], store.size), rows.stop - rows.start
            with timing.work(size):
                run = simulate_many(self.controller, self.robot, x0s, self.steps, **given)
            yield Part(block, size, first_rows(run, size))

    def put(self, writer: "BlockWriter", part: Part[Run]) -> None:
        """Give the runs of a block to the writer."""
        rows = writer.store.rows(part.place)
        own = {key: value[rows] for key, value in self.factors.items()}
        runs = {name: getattr(part.result, name) for name in STORED}
        writer.put(part.place, rows, **runs, **own)


def plain_data(value: Any, within: tuple[int, ...] = ()) -> Any:
    """Return what a value is as JSON data: hashes of its arrays and of MuJoCo's models, what its
    functions do, and the same of all that it holds; of other types that hold nothing their names.

    within: the `id` of what holds it, for what holds itself.
    """
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        return fingerprint(None, value)
    if id(value) in within:
        return "itself"
    parts = lambda held: plain_data(held, (*within, id(value)))
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: parts(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, set | frozenset):
        return sorted(map(repr, value))
    if isinstance(value, Enum | np.dtype | bytes | complex | range | slice):
        return repr(value)
    if isinstance(value, tuple | list):
        return list(map(parts, value))
    if isinstance(value, Mapping):
        return {str(key): parts(held) for key, held in value.items()}
    if isinstance(value, partial):
        return list(map(parts, (value.func, value.args, value.keywords)))
    if isinstance(function := inspect.unwrap(value) if callable(value) else value, MethodType):
        return list(map(parts, (function.__func__, function.__self__)))
    if isinstance(function, FunctionType):
        code = function.__code__
        closed_over = [cell.cell_contents for cell in function.__closure__ or ()]
        held = closed_over, function.__defaults__, function.__kwdefaults__
        return [_plain_code(code), *map(parts, (*held, _module_data(code, function.__globals__)))]
    if isinstance(value, type | ModuleType):
        return value.__name__
    if type(value).__name__ == "MjModel":
        return fingerprint(None, model_bytes(value))
    given = lambda key: key[:1] != "_" and not hasattr(type(value), key)  # no cached property
    own = {key: held for key, held in getattr(value, "__dict__", {}).items() if given(key)}
    return [type(value).__name__, parts(own)]


def _plain_code(code: CodeType) -> list[Any]:
    """Return the instructions of a function, and the names and constants in them, as JSON data."""
    ordered = lambda v: sorted(map(repr, v)) if isinstance(v, frozenset) else repr(v)
    constants = [_plain_code(v) if isinstance(v, CodeType) else ordered(v) for v in code.co_consts]
    return [code.co_code.hex(), list(code.co_names), constants]


def _module_data(code: CodeType, names: Mapping[str, Any]) -> dict[str, Any]:
    """Return those of the module's names that a function reads, but for modules, types and
    functions."""
    inner = [_module_data(v, names) for v in code.co_consts if isinstance(v, CodeType)]
    own = {key: names[key] for key in code.co_names if key in names}
    found = {k: v for k, v in own.items() if not (callable(v) or isinstance(v, ModuleType))}
    return found | {key: v for part in inner for key, v in part.items()}
