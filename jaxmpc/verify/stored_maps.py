"""Prove the labels of a stored map again, from what is stored alone.

Multipliers that prove a state infeasible come from linear programs solved by HiGHS, in the
direction of the stored half-space or, failing that, of least violation at the state. They need not
be accurate: `exact_check.beyond` evaluates what they imply exactly. One half-space serves all
states that it excludes.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.optimize import linprog
from tqdm.std import tqdm

from jaxmpc.checks import fail
from jaxmpc.files import read_arrays, read_results, sha256
from jaxmpc.qp.status import Status
from jaxmpc.verify.exact import Constraints, beyond, roll_out, roll_out_exactly

# Tangents to a terminal ellipsoid that a linear program gets at most.
TANGENTS = 30
TOLERANCES = {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10}


@dataclass
class Verification:
    """What was verified of a store.

    labels: number of stored labels of each kind. verified: how many of the decided ones are proved.
    exactly: how many of these in exact arithmetic. margin: the least margin of a limit along a
    plan, in the units of that limit; excess: the least by which an infeasible state lies beyond its
    half-space, relative to the largest entry of the normal; ∞ where there are none. failures: index
    of each state whose label is not proved, with where it lies and the reason. problems: what is
    wrong with the store.
    """

    labels: dict[str, int]
    verified: int = 0
    exactly: int = 0
    margin: float = np.inf
    excess: float = np.inf
    failures: dict[int, str] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)

    @property
    def passed(self) -> bool:
        """Return whether the store is sound and each of its labels is proved."""
        return not self.failures and not self.problems


def verify_map(
    path: str | Path, *, exact: bool = False, sample: int = 1000, seed: int = 0,
    progress: bool = False, check: Any = lambda attributes, axes: [],
) -> Verification:  # fmt: skip
    """Prove every label of a stored map again, from its plans, half-spaces and problem.

    path: a store that `jaxmpc sweep` or `jaxmpc recursion --robot` made, its URL, or its folder; or
    the folder of a report of `jaxmpc recursion`, whose counterexample, and next states that count
    as lost after one step, are proved again too. exact: all plans in exact arithmetic, else a
    random sample of them and those with margins near rounding, the others in float64; half-spaces
    are exact always. What summary.json beside it counts is compared. check: takes the attributes
    and axes of the store before its labels are read, and returns what is wrong with them. Nothing
    is written. Where the store is damaged, `problems` says where, and no label is looked at unless
    its data can be read. Raises ValueError where there is no store.
    """
    from jaxmpc.store import read, reason

    path = find_store(path)
    report = isinstance(path, Path) and path.suffix == ".npz"
    found = read_report(Path(path), check) if report else read(path, check)
    result = Verification({}, problems=list(found.problems))
    if not found.whole:
        return result
    try:
        with np.errstate(all="ignore"):  # of numbers that are no plans: they fail
            _verify(found, report, exact, sample, seed, progress, result)
        if not report and isinstance(path, Path) and (path.parent / "summary.json").exists():
            _compare_summary(path.parent / "summary.json", found, result)
    except Exception as error:  # what numbers that fit no problem may raise
        result.problems.append(f"its labels cannot be proved again ({reason(error)})")
    return result


def _verify(
    found: Any, report: bool, exact: bool, sample: int, seed: int, progress: bool,
    result: Verification,
) -> None:  # fmt: skip
    """Verify what was read."""
    label, status = found.arrays.get("label"), found.arrays.get("status")
    if found.done < found.blocks:
        left = found.blocks - found.done
        result.problems.append(f"{left} of {found.blocks} blocks are not done: resume the sweep")
    needed = ("label", "status", "start", "plan", "cut_normal", "cut_offset")
    missing = [name for name in needed if name not in found.arrays]
    if missing or not found.axes or "problem" not in found.attributes:
        result.problems.append(f"cannot be verified without {missing or 'its problem'}")
        return
    names = {1: "feasible", -1: "infeasible", 0: "undecided"}
    result.labels = {name: int(np.sum(label == value)) for value, name in names.items()}
    expected = {1: Status.SOLVED, -1: Status.PRIMAL_INFEASIBLE}
    points, problem = found.points, found.attributes["problem"]
    if len(points) != len(label):
        result.problems.append(f"{len(label)} labels for {len(points)} states")
        return
    for i in np.flatnonzero(~np.isin(label, list(names))):
        result.failures[int(i)] = f"label {label[i]} means nothing"
    for value, name in expected.items():
        for i in np.flatnonzero((label == value) & (status != name)):
            result.failures[int(i)] = f"label {value} with status {status[i]}"
    p = Constraints(problem)
    feasible, infeasible = np.flatnonzero(label == 1), np.flatnonzero(label == -1)
    hidden = None if progress else True  # None: where stderr is no terminal
    with tqdm(total=len(feasible) + len(infeasible), unit=" labels", disable=hidden) as bar:
        _verify_feasible(p, points, found.arrays, feasible, exact, sample, seed, result, bar)
        _verify_infeasible(p, points, found.arrays, infeasible, result, bar)
    _compare_half_spaces(points, found.arrays, feasible, infeasible, result)
    if report:
        _verify_next_states(p, points, found.arrays, found.attributes, result)
    result.failures = {
        i: f"at {points[i].tolist()}: {reason}" for i, reason in result.failures.items()
    }


def _compare_summary(path: Path, found: Any, result: Verification) -> None:
    """Compare what a summary says with the store beside it. Half-spaces of refinement exclude some
    of the undecided states: those count as infeasible there."""
    try:
        summary, wrong = read_results(path)
        counts = summary.get("linear", summary)["counts"]
        feasible, infeasible, undecided = (
            int(counts[k]) for k in ("feasible", "infeasible", "undecided")
        )
    except (ValueError, TypeError, LookupError, AttributeError, ArithmeticError):
        result.problems.append(f"{path.name}: cannot be read, or holds no counts")
        return
    arrays, there = found.arrays, result.labels
    open_, more = arrays["status"] == Status.ITERATION_LIMIT, infeasible - there["infeasible"]
    beyond_bounds = np.zeros(len(open_), bool)
    for a, b in zip(arrays.get("bound_normal", ()), arrays.get("bound_offset", ()), strict=True):
        beyond_bounds |= found.points @ a > b
    fine = (
        feasible == there["feasible"]
        and undecided == int(np.sum(open_)) - more
        and 0 <= more <= int(np.sum(open_ & beyond_bounds))
    )
    if not fine and found.done == found.blocks:
        what = f"{feasible} feasible, {infeasible} infeasible, {undecided} undecided"
        wrong = f"{path.name}: counts {what}, the store {' '.join(map(str, there.values()))}"
    elif summary.get("config") != found.attributes["config"]:
        wrong = f"{path.name}: its configuration is not that of the store"
    result.problems += [wrong] if wrong else []


def _compare_half_spaces(
    points: np.ndarray, arrays: Mapping[str, np.ndarray], feasible: np.ndarray,
    infeasible: np.ndarray, result: Verification,
) -> None:  # fmt: skip
    """Look for stored half-spaces that contradict the labels: that do not exclude their own state,
    or exclude a feasible one or a proved boundary point."""
    normals, offsets = arrays["cut_normal"][infeasible], arrays["cut_offset"][infeasible]
    known = np.isfinite(offsets)
    inside = known & ~(np.sum(normals * points[infeasible], axis=1) > offsets)
    result.failures |= {int(i): "its half-space does not exclude it" for i in infeasible[inside]}
    size = np.abs(normals).max(axis=1, initial=0.0, where=np.isfinite(normals))
    known &= size > 0
    H, h = normals[known] / size[known, None], offsets[known] / size[known]
    _, first = np.unique(np.round(np.column_stack([H, h]), 9), axis=0, return_index=True)
    H, h = H[first], h[first]
    if "bound_normal" in arrays:
        more = np.column_stack([arrays["bound_normal"], arrays["bound_offset"]])
        more = np.unique(more, axis=0)
        if not np.all(np.isfinite(more)):
            result.problems.append("bound_normal, bound_offset: hold NaN or infinity")
        H, h = np.concatenate([H, more[:, :-1]]), np.append(h, more[:, -1])
    kept = points[feasible]
    if "bound_point" in arrays:
        kept = np.concatenate([kept, arrays["bound_point"]])
    for i in range(0, len(H), 256):
        off = np.max(kept @ H[i : i + 256].T - h[i : i + 256], axis=0, initial=-np.inf)
        reach = np.abs(kept).max(axis=0, initial=0.0) @ np.abs(H[i : i + 256]).T
        for j in np.flatnonzero(off > 1e-12 * (reach + np.abs(h[i : i + 256]))):
            what = f"half-space {H[i + j].tolist()} x <= {h[i + j]:.9g}"
            result.problems.append(f"{what} excludes a feasible state by {off[j]:.3g}")


def find_store(path: str | Path) -> str | Path:
    """Return the store at `path` or in that folder, or the arrays of a recursion report there; a
    URL as it is."""
    if "://" in str(path):
        return str(path)
    path = Path(path)
    if (path / "zarr.json").exists() or path.suffix == ".npz":
        return path
    names = ("sweep.zarr", "robot_map.zarr", "recursion.npz")
    inside = [path / name for name in names if (path / name).exists()]
    if len(inside) != 1:
        what = f"holds {' and '.join(v.name for v in inside)}" if inside else "holds no labels"
        fail(str(path), what, "Give the folder of a sweep or a recursion report, or what it holds")
    return inside[0]


def read_report(path: Path, check: Any = lambda attributes, axes: []) -> Any:
    """Return the samples of a recursion report as `store.read` returns those of a map."""
    from jaxmpc.store import Stored, tails

    found = read_arrays(path)
    if found is None or not isinstance(found[0], dict) or "state" not in found[1]:
        return Stored.damaged(f"{path.name}: cannot be read")
    record, arrays = found
    try:
        summary, wrong = read_results(path.parent / "summary.json")
        shapes = {name: (1, *tail) for name, tail in tails(record["problem"]).items()}
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


def _verify_next_states(
    p: Constraints, states: np.ndarray, arrays: Mapping[str, np.ndarray],
    attributes: Mapping[str, Any], result: Verification,
) -> None:  # fmt: skip
    """Verify that next states follow, and that those are infeasible that count as lost after one
    step; and the same of the counterexample, and that it has a plan."""
    inputs, after, lost = arrays["input"], arrays["next_state"], arrays["lost_at"] == 1
    worst = attributes["summary"].get("counterexample")
    if worst is not None:
        at = {k: np.array(worst[k], float) for k in ("state", "feasible_inputs", "next_state")}
        margin = roll_out_exactly(p, at["state"][None], at["feasible_inputs"][None])[0]
        if margin < 0:
            result.problems.append(f"counterexample: its plan breaks a limit by {-margin:.3g}")
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
            result.problems.append(f"{name}: it is not A x + B u + c")
        if not beyond_by > 0:
            result.problems.append(f"{name}: no half-space is found that excludes it")


def _verify_feasible(
    p: Constraints, points: np.ndarray, arrays: Mapping[str, np.ndarray], where: np.ndarray,
    exact: bool, sample: int, seed: int, result: Verification, bar: Any,
) -> None:  # fmt: skip
    """Verify the plans of states `where`."""
    same = np.searchsorted(p.moves, p.moves)
    for i in range(0, len(where), 4096):
        here = where[i : i + 4096]
        starts, plans = arrays["start"][here], arrays["plan"][here]
        known = np.isfinite(starts).all(axis=1) & np.isfinite(plans).all(axis=(1, 2))
        others = starts[:, p.others]
        fits = {
            "the start of its plan is another state": (starts[:, p.axes] == points[here]).all(1)
            & ((others >= p.low) & (others <= p.high)).all(axis=1),
            "inputs that a control horizon holds differ": (plans == plans[:, same]).all((1, 2)),
        }
        fits = {"it has no plan": known} | {k: v | ~known for k, v in fits.items()}
        for reason, fine in fits.items():
            result.failures |= {int(j): reason for j in here[~fine]}
        margin = np.where(known, 0.0, -np.inf)
        margin[known] = roll_out(p, starts[known], plans[known])
        draw = np.random.default_rng([seed, i]).random(len(here)) * len(where) < sample
        again = known & (exact | draw | ~(margin > 0))
        margin[again] = roll_out_exactly(p, starts[again], plans[again])
        result.failures |= {
            int(j): f"its plan breaks a limit by {-v:.3g}"
            for j, v in zip(here[again], margin[again], strict=True) if v < 0
        }  # fmt: skip
        good = [j for j, at in enumerate(here) if int(at) not in result.failures]
        result.verified += len(good)
        result.exactly += int(np.sum(again[good]))
        result.margin = min(result.margin, float(margin[good].min(initial=np.inf)))
        bar.update(len(here))


def _verify_infeasible(
    p: Constraints, points: np.ndarray, arrays: Mapping[str, np.ndarray], where: np.ndarray,
    result: Verification, bar: Any,
) -> None:  # fmt: skip
    """Verify that no trajectory starts at states `where`."""
    where = np.array([i for i in where if int(i) not in result.failures], int)
    excess = exclude(p, points[where], arrays["cut_normal"][where], bar)
    result.failures |= {
        int(i): "no half-space is found that excludes it" for i in where[~(excess > 0)]
    }
    proved = excess[excess > 0]
    result.verified += len(proved)
    result.exactly += len(proved)
    result.excess = min(result.excess, float(proved.min(initial=np.inf)))


def exclude(p: Constraints, points: np.ndarray, normals: np.ndarray, bar: Any = None) -> np.ndarray:
    """Return by how much points (b, d) lie beyond half-spaces that no feasible state leaves, found
    anew in the directions normals (b, d) or else by least violation; see `exact_check.beyond`."""
    best, left = np.full(len(points), -np.inf), np.ones(len(points), bool)
    if not len(points):
        return best
    programs = Programs(p)
    box = programs.boxes()
    while left.any():
        first = int(np.flatnonzero(left)[0])
        for y in programs.multipliers(points[first], normals[first]):
            best[left] = np.maximum(best[left], beyond(p, y, points[left], box))
            if best[first] > 0:
                break
        done = left & (best > 0)
        done[first] = True  # nothing more to try
        left &= ~done
        if bar is not None:
            bar.update(int(done.sum()))
    return best


class Programs:
    """Linear programs over all trajectories, v = (x_0, …, x_N, moves)."""

    def __init__(self, p: Constraints) -> None:
        """Assemble the equations of motion and the rows."""
        self.p, (n, m) = p, p.B.shape
        self.states, self.count = n * (p.N + 1), n * (p.N + 1) + m * (int(p.moves.max()) + 1)
        motion = sp.lil_matrix((n * p.N, self.count))
        parts, bounds, self.place = [], [], []
        for k in range(p.N + 1):
            x = slice(k * n, (k + 1) * n)
            block = sp.lil_matrix((len(p.H[k]), self.count))
            block[:, x] = p.H[k]
            if k < p.N:
                u = slice(self.states + p.moves[k] * m, self.states + (p.moves[k] + 1) * m)
                block[:, u] = p.D[k]
                motion[k * n : (k + 1) * n, x] = -p.A
                motion[k * n : (k + 1) * n, (k + 1) * n : (k + 2) * n] = np.eye(n)
                motion[k * n : (k + 1) * n, u] = -p.B
            for bound, sign in ((p.upper[k], 1.0), (p.lower[k], -1.0)):
                there = np.flatnonzero(np.isfinite(bound))
                parts.append(sign * block.tocsr()[there])
                bounds.append(sign * bound[there])
                self.place += [(k, int(i), sign) for i in there]
        self.motion, self.drift = motion.tocsr(), np.tile(p.c, p.N)
        self.rows, self.bounds = sp.vstack(parts).tocsr(), np.concatenate(bounds)
        self.tangents: list[np.ndarray] = []
        if p.P is not None:  # its box
            there = np.flatnonzero(np.diag(p.P))
            inverse = np.linalg.inv(p.P[np.ix_(there, there)])
            box = np.zeros((len(there), n))
            box[:, there] = inverse
            self.tangents = [*box, *-box]

    def solve(self, cost: np.ndarray, theta: np.ndarray | None = None) -> Any:
        """Return the least cost'v over all trajectories; with theta (d,) the least violation t of
        the rows over those from there instead."""
        p, n = self.p, len(self.p.A)
        elastic = theta is not None
        variables = [(None, None)] * self.count
        for i, lower, upper in zip(p.others, p.low, p.high, strict=True):
            variables[i] = (max(lower, -1e300), min(upper, 1e300))
        for i, value in zip(p.axes, [] if theta is None else theta, strict=False):
            variables[i] = (value, value)
        for _ in range(TANGENTS):
            rows, bounds = self.rows, self.bounds
            if self.tangents:
                v = np.array(self.tangents) @ p.P
                extra = sp.lil_matrix((len(v), self.count))
                extra[:, self.states - n : self.states] = v
                values = np.sqrt(p.level * np.sum(v * np.array(self.tangents), axis=1))
                rows, bounds = sp.vstack([rows, extra]), np.append(bounds, values)
            motion = self.motion
            if elastic:
                rows = sp.hstack([rows, -np.ones((rows.shape[0], 1))])
                motion = sp.hstack([motion, np.zeros((motion.shape[0], 1))])
            found = linprog(
                np.append(np.zeros(self.count), 1.0) if elastic else cost, rows, bounds, motion,
                self.drift, [*variables, (None, None)] if elastic else variables, method="highs-ds",
                options=TOLERANCES,
            )  # fmt: skip
            if found.status != 0 or p.P is None:
                return found
            last = found.x[self.states - n : self.states]
            if last @ p.P @ last <= p.level * (1 + 1e-9):
                return found
            self.tangents.append(last)
        return found

    def multipliers(self, theta: np.ndarray, normal: np.ndarray) -> Iterator[list[np.ndarray]]:
        """Yield multipliers of the rows: of the largest normal'θ, then of the least violation from
        theta."""
        p = self.p
        for direct in (True, False):
            if direct and not (np.all(np.isfinite(normal)) and np.any(normal)):
                continue
            cost = np.zeros(self.count)
            cost[p.axes] = -normal / np.abs(normal).max() if direct else 0.0
            found = self.solve(cost, None if direct else theta)
            if found.status != 0:
                continue
            values = -found.ineqlin.marginals
            values[np.abs(values) < 1e-13 * np.abs(values).max(initial=0.0)] = 0.0
            y = [np.zeros(len(rows)) for rows in p.lower]
            for (k, i, sign), value in zip(self.place, values, strict=False):
                y[k][i] += sign * value
            if p.P is not None:
                weights = values[len(self.place) :]
                y.append(weights @ np.array(self.tangents[: len(weights)]))
            yield y

    def boxes(self) -> tuple[np.ndarray, ...]:
        """Return lower and upper bounds (moves, m) of the inputs and of the states that are not
        mapped: the limits on each alone, and where there are none those of linear programs over all
        trajectories, enlarged by a part in 10⁶ of their size; ±∞ where there are none."""
        p = self.p
        size = int(p.moves.max()) + 1, p.B.shape[1]
        low, high = np.full(size, -np.inf), np.full(size, np.inf)
        for move, i, least, most in p.input_rows():
            low[move, i], high[move, i] = max(low[move, i], least), min(high[move, i], most)
        found = low.ravel(), high.ravel(), p.low.copy(), p.high.copy()
        place = np.arange(self.states, self.count), p.others
        for (lower, upper), entries in zip((found[:2], found[2:]), place, strict=True):
            for j in np.flatnonzero(~(np.isfinite(lower) & np.isfinite(upper))):
                ends = []
                for sign in (1.0, -1.0):
                    cost = np.zeros(self.count)
                    cost[entries[j]] = sign
                    best = self.solve(cost)
                    ends.append(sign * best.fun if best.status == 0 else -sign * np.inf)
                room = 1e-6 * np.max(np.abs(ends), initial=0.0, where=np.isfinite(ends))
                lower[j], upper[j] = max(lower[j], ends[0] - room), min(upper[j], ends[1] + room)
        return found[0].reshape(size), found[1].reshape(size), found[2], found[3]
