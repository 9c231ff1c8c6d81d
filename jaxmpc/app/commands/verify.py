"""The command `jaxmpc verify`."""

import dataclasses
import sys
import time
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from jaxmpc.app import config as configs
from jaxmpc.app.commands.outcome import Outcome
from jaxmpc.app.options.shared import print_table
from jaxmpc.app.options.verify import VerifyOptions
from jaxmpc.checks import shown
from jaxmpc.feasible.policy_problem import problem_of
from jaxmpc.files import as_json
from jaxmpc.mpc.problem import folded
from jaxmpc.verify.stored_map import Verification, find_store, verify_map

# Failures that are printed.
SHOWN = 10


class Verify(VerifyOptions):
    """The command: its options, and `run`."""

    def run(self) -> Outcome:
        """Verify, print the table or what is damaged, return how it ended. Raises ValueError where
        there is no map."""
        path, begun = find_store(self.directory), time.perf_counter()
        found = verify_map(
            path,
            exact=self.exact,
            sample=self.sample,
            seed=self.seed,
            progress=True,
            check=contradictions,
        )
        folder = Path(self.directory)
        if folder.is_dir() and folder != path and not (folder / "summary.json").exists():
            found.problems.append("summary.json: is missing. Resume the sweep, which writes it")
        if not found.labels:
            rest = f" (and {len(found.problems) - 1} more)" if len(found.problems) > 1 else ""
            print(f"{path}: NOT VERIFIED: {found.problems[0]}{rest}")
            return Outcome(1, record(found))
        decided = found.labels.get("feasible", 0) + found.labels.get("infeasible", 0)
        word = "verified" if decided else "nothing to verify, no state is labelled"
        print(f"{path}: {word if found.passed else 'NOT VERIFIED'}")
        rows = [(name, f"{count:>12,}") for name, count in found.labels.items()]
        rows += [("verified", f"{found.verified:>12,} of {decided:,}, {found.exactly:,} exactly")]
        print_table(
            [*rows, *_extremes(found), ("total", f"{time.perf_counter() - begun:.2f} s")], 12
        )
        for problem in found.problems[:SHOWN]:
            print(f"  FAILS: {problem}")
        for index, reason in list(found.failures.items())[:SHOWN]:
            print(f"  FAILS: state {index} {reason}")
        more = len(found.problems[SHOWN:]) + len(list(found.failures)[SHOWN:])
        if more:
            print(f"  and {more:,} more")
        return Outcome(0 if found.passed else 1, record(found))


def record(found: Verification) -> dict[str, Any]:
    """Return what was verified as JSON data, under the names of `Verification`."""
    return as_json({"passed": found.passed, **dataclasses.asdict(found)})


def contradictions(attributes: Mapping[str, Any], axes: Mapping[str, np.ndarray]) -> list[str]:
    """Build the problem of a map or a recursion report from its configuration, and return where
    what is stored is another one."""
    config, problem = attributes.get("config"), attributes.get("problem")
    if not isinstance(config, Mapping) or not isinstance(problem, Mapping):
        return ["zarr.json: holds no configuration or no problem"]
    lines: Sequence[np.ndarray] = ()
    try:
        if "system" in config:
            made = configs.from_results(config, "sweep" if axes else "recursion")
            region = configs.sweep_points(made) if axes else None
            lines = () if region is None else region.along
            view = (None, None) if region is None else (region.axes, region.fixed)
            mpc = made.build_mpc()
            # A recursion report is of the problem whose outputs are rows of its states.
            built = problem_of(mpc if axes else folded(mpc), *view).plain()
        elif "robot" not in config:
            text = (
                "made by sweep_into: the problem is the stored one, no configuration makes it again"
            )
            print(text, file=sys.stderr)
            return []
        elif not _is_here(config["robot"]):
            print(
                f"{config['robot']}: is not here; the map's problem is not built from it again",
                file=sys.stderr,
            )
            return []
        else:
            from jaxmpc.robot_maps.stored_sweep import problem_again  # a third of a second

            if config["horizon"] != problem.get("horizon"):
                raise ValueError(
                    f"horizon {shown(config['horizon'])}, the problem says "
                    f"{shown(problem.get('horizon'))}"
                )
            lower, upper = config["lower"], config["upper"]
            lines = [
                np.linspace(low, high, len(axis))
                for low, high, axis in zip(lower, upper, axes.values(), strict=True)
            ]
            built = problem_again(config, np.array([lower, upper])).plain()
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        return [f"configuration: makes no problem ({error})"]
    apart = (_apart(f"problem.{key}", problem.get(key), value) for key, value in built.items())
    found = [
        f"{name}: {shown(stored)}, the configuration says {shown(value)}"
        for name, stored, value in filter(None, apart)
    ]
    for (name, line), stated in zip(axes.items(), lines, strict=bool(lines)):
        if not alike(line.tolist(), stated.tolist()):
            found.append(f"{name}: not the points of the grid in the configuration")
    return found


def _is_here(robot: Any) -> bool:
    """Return whether a robot, a name or a path, can be loaded."""
    from jaxmpc.robots.load import MODELS

    return bool(find_spec("mujoco")) and (robot in MODELS or Path(robot).is_file())


def _apart(name: str, a: Any, b: Any) -> tuple[str, Any, Any] | None:
    """Return the name of the first part in which two pieces of JSON data are not alike, and both;
    None where they are."""
    if alike(a, b):
        return None
    inner: list[tuple[str, Any, Any]] = []
    if isinstance(a, Mapping) and isinstance(b, Mapping) and a.keys() == b.keys():
        inner = [(f"{name}.{key}", a[key], b[key]) for key in a]
    if isinstance(a, list) and isinstance(b, list) and len(a) == len(b):
        inner = [(f"{name}[{i}]", *pair) for i, pair in enumerate(zip(a, b, strict=True))]
    return next(filter(None, (_apart(*part) for part in inner)), (name, a, b))


def alike(a: Any, b: Any) -> bool:
    """Return whether two pieces of JSON data are equal but for rounding of their numbers, which
    differs between processors."""
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        return a.keys() == b.keys() and all(alike(a[key], b[key]) for key in a)
    if isinstance(a, list) and any(isinstance(v, Mapping) for v in a):
        return isinstance(b, list) and len(a) == len(b) and all(map(alike, a, b))
    try:
        first, second = np.array(a, float), np.array(b, float)
    except (TypeError, ValueError):
        return bool(a == b)
    size = np.abs(second).max(initial=0.0, where=np.isfinite(second))
    return first.shape == second.shape and np.allclose(
        first, second, rtol=1e-9, atol=1e-12 * size, equal_nan=True
    )


def _extremes(found: Verification) -> list[tuple[str, str]]:
    """Return the rows of the least margin and the least excess, where there are any."""
    rows = [
        ("least margin", found.margin, "of a plan to a limit, in the unit of that"),
        ("least excess", found.excess, "of an infeasible state beyond its half-space"),
    ]
    return [(name, f"{value:.3g}  {what}") for name, value, what in rows if value < float("inf")]
