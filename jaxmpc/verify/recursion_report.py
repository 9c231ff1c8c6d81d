"""The labels, next states and counterexample of a report of `jaxmpc recursion`."""

from pathlib import Path

import numpy as np

from jaxmpc.files import read_arrays, read_results, sha256
from jaxmpc.store import Check, Stored
from jaxmpc.verify.exact import roll_out_exactly
from jaxmpc.verify.half_spaces import exclude
from jaxmpc.verify.stored_problem import Constraints, label_shapes


def read_report(path: Path, check: Check = lambda attributes, axes: []) -> Stored:
    """Return the samples of a recursion report as `store.read` returns those of a map."""
    found = read_arrays(path)
    if found is None or not isinstance(found[0], dict) or "state" not in found[1]:
        return Stored.damaged(f"{path.name}: cannot be read")
    record, arrays = found
    try:
        summary, wrong = read_results(path.parent / "summary.json")
        shapes = {name: (1, *tail) for name, tail in label_shapes(record).items()}
        n, m = np.shape(record["problem"]["B"])
    except (ValueError, LookupError, TypeError) as error:
        return Stored.damaged(f"{path.name}, summary.json: {error}")
    count = len(arrays["label"]) if "label" in arrays and arrays["label"].ndim == 1 else -1
    shapes |= {"state": (1, n), "input": (1, m), "next_state": (1, n), "lost_at": (1,)}
    for name, shape in shapes.items():
        if name in arrays and arrays[name].shape != (count, *shape[1:]):
            what = f"shape {arrays[name].shape} where {(count, *shape[1:])} is needed"
            return Stored.damaged(f"{path.name}: {name}: {what}")
    problems = [wrong] if wrong else []
    if summary.get("sha256") != sha256(path):
        problems.append(f"{path.name}: is not as it was written")
    label, lost = arrays["label"], arrays["lost_at"]
    counts = {"feasible": label == 1, "lost after one step": lost == 1, "kept": lost == 0}
    counts |= {"lost later": lost > 1}
    stated = summary.get("counts")
    for name, flags in counts.items():
        if not isinstance(stated, dict) or stated.get(name) != int(np.sum(flags)):
            problems.append(f"summary.json: its count {name!r} is not {int(np.sum(flags)):,}")
    attributes = {**record, "summary": summary, "config": summary.get("config")}
    if differing := check(attributes, {}):
        return Stored(attributes, {}, {}, 0, 0, [*problems, *differing], False)
    arrays["points"] = arrays["state"]
    return Stored(attributes, arrays, {"sample": arrays["state"]}, 1, 1, problems)


def wrong_next_states(p: Constraints, found: Stored) -> list[str]:
    """Return what is wrong with the next states of a report: they must follow, and those be
    infeasible that count as lost after one step. The same of the counterexample, which must have a
    plan."""
    arrays, states, problems = found.arrays, found.points, list[str]()
    inputs, after, lost = arrays["input"], arrays["next_state"], arrays["lost_at"] == 1
    worst = found.attributes["summary"].get("counterexample")
    if worst is not None:
        at = {k: np.array(worst[k], float) for k in ("state", "feasible_inputs", "next_state")}
        margin = roll_out_exactly(p, at["state"][None], at["feasible_inputs"][None])[0]
        if margin < 0:
            problems.append(f"counterexample: its plan breaks a limit by {-margin:.3g}")
        states = np.concatenate([states, at["state"][None]])
        inputs = np.concatenate([inputs, np.array(worst["inputs"], float)[:1]])
        after = np.concatenate([after, at["next_state"][None]])
        lost = np.append(lost, True)
    where = np.flatnonzero(lost)
    expected = states[where] @ p.A.T + inputs[where] @ p.B.T + p.c
    size = np.abs(states[where]) @ np.abs(p.A).T + np.abs(inputs[where]) @ np.abs(p.B).T
    wrong = np.any(np.abs(after[where] - expected) > 1e-12 * (size + np.abs(p.c)), axis=1)
    normals = arrays.get("facet_normals", np.zeros((0, len(p.A))))
    if len(normals):
        normals = normals[np.argmax(after[where] @ normals.T - arrays["facet_offsets"], axis=1)]
    else:
        normals = np.full((len(where), len(p.A)), np.nan)
    excess = exclude(p, after[where], normals)
    for i, follows, beyond_by in zip(where, ~wrong, excess, strict=True):
        name = f"next state of state {i}" if i < len(arrays["state"]) else "counterexample"
        if not follows:
            problems.append(f"{name}: it is not A x + B u + c")
        if not beyond_by > 0:
            problems.append(f"{name}: no half-space is found that excludes it")
    return problems
