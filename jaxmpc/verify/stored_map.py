"""Prove the labels of a stored map, or of a recursion report, again: from what is stored alone.

Nothing here is shared with what made the labels: plans are rolled out by `exact.py`, half-spaces
are found anew by `half_space_search.py`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock

import numpy as np
from tqdm.std import tqdm

from jaxmpc.batches import slices
from jaxmpc.checks import fail
from jaxmpc.files import read_arrays, read_results, sha256
from jaxmpc.pytrees import short_text
from jaxmpc.qp.status import Status
from jaxmpc.store import Check, Stored, read, reason
from jaxmpc.verify.exact import roll_out_exactly, roll_out_in_floats
from jaxmpc.verify.exact_policies import AffineRows, StoredPolicies
from jaxmpc.verify.half_space_search import exclude
from jaxmpc.verify.stored_problem import Constraints, by_policies, label_shapes

# What stays of a store when it has been read; what its labels are proved by, those about affine
# policies and tubes too; names of labels.
LABELLED = "label", "status"
NEEDED = "start", "plan", "cut_normal", "cut_offset"
OF_POLICIES = "cone", "answer", "corner", "policy_state", "policy_plan", "policy_answer"
NAMES = {1: "feasible", -1: "infeasible", 0: "undecided"}


@dataclass(repr=False)
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

    __repr__ = short_text

    @property
    def passed(self) -> bool:
        """Return whether the store is sound and each of its labels is proved."""
        return not self.failures and not self.problems


def verify_map(
    path: str | Path,
    *,
    exact: bool = False,
    sample: int = 1000,
    seed: int = 0,
    progress: bool = False,
    check: Check = lambda attributes, axes: [],
) -> Verification:
    """Prove every label of a stored map again, from its plans, half-spaces and problem.

    path: a store that `jaxmpc sweep` or `jaxmpc recursion --robot` made, its URL, or its folder; or
    the folder of a report of `jaxmpc recursion`, whose counterexample, and next states that count
    as lost after one step, are proved again too. exact: all plans in exact arithmetic, else a
    random sample of them and those with margins near rounding, the others in float64; half-spaces
    are exact always. sample: plans of that random sample. What summary.json beside it counts is
    compared. check: takes the attributes and axes of the store before its labels are read, and
    returns what is wrong with them. Nothing is written. Where the store is damaged, `problems` says
    where, and no label is looked at unless its data can be read. Raises ValueError where there is
    no store.
    """
    path = find_store(path)
    report = isinstance(path, Path) and path.suffix == ".npz"
    # None: where stderr is no terminal.
    with tqdm(unit=" labels", delay=1, disable=None if progress else True) as bar:
        proofs = _Proofs(exact, sample, seed, bar)
        if report:
            found = read_report(Path(path), check)
        else:
            found = read(path, check, label_shapes, keep=LABELLED, visit=proofs.visit)
        result = Verification({}, problems=list(found.problems))
        if not found.whole:
            return result
        if found.attributes.get("problem", {}) is None:
            return _of_unstored_policies(found, result)
        try:
            if _count(found, result):
                if report:
                    proofs.visit(found, 0, found.arrays)
                with np.errstate(all="ignore"):
                    proofs.conclude(found, result)
                    if report:
                        p = Constraints(found.attributes["problem"])
                        result.problems += wrong_next_states(p, found)
            if not report and isinstance(path, Path) and (path.parent / "summary.json").exists():
                _compare_summary(path.parent / "summary.json", found, result)
        except Exception as error:  # what numbers that fit no problem may raise
            result.problems.append(f"its labels cannot be proved again ({reason(error)})")
    return result


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
        cure = "Give the folder of a sweep or a recursion report, or what it holds"
        if not inside and (path / "summary.json").exists():
            cure = "Of a sweep with --store give what that named: jaxmpc verify STORE"
        fail(str(path), what, cure)
    return inside[0]


def _of_unstored_policies(found: Stored, result: Verification) -> Verification:
    """Return the result for a report about policies of several sequences of inputs, which keeps no
    problem: what it says of states cannot be proved again."""
    label = found.arrays["label"]
    result.labels = {name: int(np.sum(label == value)) for value, name in NAMES.items()}
    worst = found.attributes["summary"].get("counterexample")
    told = {"labels": np.any(label != 0), "a counterexample": worst is not None}
    for what in (name for name, there in told.items() if there):
        policy = "policies of several sequences of inputs"
        result.problems.append(f"holds {what} of {policy}, which cannot be proved again")
    return result


def _count(found: Stored, result: Verification) -> bool:
    """Count the labels, compare them with their status, and return whether they can be proved."""
    label = found.arrays.get("label")
    if found.done < found.blocks:
        left = found.blocks - found.done
        result.problems.append(f"{left} of {found.blocks} blocks are not done: resume the sweep")
    fields = {*found.attributes.get("variables", {}).get("fields", ()), *found.arrays}
    problem = found.attributes.get("problem", {})
    needed = (*LABELLED, *NEEDED, *OF_POLICIES) if by_policies(problem) else (*LABELLED, *NEEDED)
    missing = [name for name in needed if name not in fields]
    if label is None or missing or not found.axes or "problem" not in found.attributes:
        result.problems.append(f"cannot be verified without {missing or 'its problem'}")
        return False
    result.labels = {name: int(np.sum(label == value)) for value, name in NAMES.items()}
    if found.count != len(label):
        result.problems.append(f"{len(label)} labels for {found.count} states")
        return False
    return True


@dataclass(eq=False)
class _BlockProofs:
    """What the proofs of a block are found to be, by the indices of its states: why labels are not
    proved; how many of the feasible ones are, how many of these exactly, their least margin; and
    the states labelled infeasible (k,) with their half-spaces."""

    failures: dict[int, str]
    infeasible: np.ndarray
    normals: np.ndarray
    offsets: np.ndarray
    verified: int = 0
    exactly: int = 0
    margin: float = np.inf

    def count(self, index: np.ndarray, margin: np.ndarray, exactly: np.ndarray, why: str) -> None:
        """Count the feasible states of these indices that are proved, `exactly` or in floats, with
        their margins; why: the reason, with a place for its size, where that is negative."""
        for j in np.flatnonzero(margin < 0):
            self.failures.setdefault(int(index[j]), why.format(-margin[j]))
        good = [j for j, i in enumerate(index) if int(i) not in self.failures]
        self.verified += len(good)
        self.exactly += int(np.sum(exactly[good]))
        self.margin = min(self.margin, float(margin[good].min(initial=np.inf)))


class _Proofs:
    """Proofs of all labels of a store: of feasible ones block by block, of infeasible ones, for
    which one half-space may serve many, in the end."""

    def __init__(self, exact: bool, sample: int, seed: int, bar: tqdm) -> None:
        self.exact, self.sample, self.seed, self.bar = exact, sample, seed, bar
        self._blocks: dict[int, _BlockProofs | Exception] = {}
        self._lock = Lock()
        self._problem: Constraints | None = None
        self._policies: StoredPolicies | None = None
        self._feasible = 0

    def visit(self, found: Stored, first: int, arrays: Mapping[str, np.ndarray]) -> None:
        """Prove the feasible labels of a block; several threads may call. See `store.read`."""
        try:
            with np.errstate(all="ignore"):  # of numbers that are no plans: they fail
                block: _BlockProofs | Exception = self._prove(found, first, arrays)
        except Exception as error:  # what numbers that fit no problem may raise
            block = error
        with self._lock:
            self._blocks[first] = block

    def conclude(self, found: Stored, result: Verification) -> None:
        """Prove the infeasible labels, and add all that was found to the result. Raises the error
        that a block ended in."""
        p, blocks = self._begin(found), list[_BlockProofs]()
        for _, block in sorted(self._blocks.items()):
            if isinstance(block, Exception):
                raise block
            blocks.append(block)
            result.failures |= block.failures
            result.verified += block.verified
            result.exactly += block.exactly
            result.margin = min(result.margin, block.margin)
        infeasible = np.concatenate([block.infeasible for block in blocks])
        normals = np.concatenate([block.normals for block in blocks])
        offsets = np.concatenate([block.offsets for block in blocks])
        affine = None if self._policies is None else self._policies.affine
        _prove_infeasible(p, found, infeasible, normals, result, self.bar, affine)
        _compare_half_spaces(found, infeasible, normals, offsets, result)
        result.failures = {
            i: f"at {found.points_at(np.array([i]))[0].tolist()}: {why}"
            for i, why in result.failures.items()
        }

    def _begin(self, found: Stored) -> Constraints:
        """Return the constraints; count the labels the first time."""
        with self._lock:
            if self._problem is None:
                plain = found.attributes["problem"]
                self._problem = Constraints(plain)
                if by_policies(plain):
                    self._policies = StoredPolicies(plain, self._problem, found.arrays)
                self._feasible = int(np.sum(found.arrays["label"] == 1))
                self.bar.total = int(np.count_nonzero(found.arrays["label"]))
            return self._problem

    def _prove(self, found: Stored, first: int, arrays: Mapping[str, np.ndarray]) -> _BlockProofs:
        """Return the proofs of a block; first: the index of its first state."""
        p, label, status = self._begin(found), arrays["label"], arrays["status"]
        infeasible = np.flatnonzero(label == -1)
        normals, offsets = arrays["cut_normal"][infeasible], arrays["cut_offset"][infeasible]
        block = _BlockProofs({}, first + infeasible, normals, offsets)
        for i in np.flatnonzero(~np.isin(label, list(NAMES))):
            block.failures[first + int(i)] = f"label {label[i]} means nothing"
        for value, expected in {1: Status.SOLVED, -1: Status.PRIMAL_INFEASIBLE}.items():
            for i in np.flatnonzero((label == value) & (status != expected)):
                block.failures[first + int(i)] = f"label {value} with status {status[i]}"
        feasible = np.flatnonzero(label == 1)
        for piece in slices(len(feasible), 4096):
            here = feasible[piece]
            draw = np.random.default_rng([self.seed, first + piece.start]).random(len(here))
            drawn = self.exact | (draw * self._feasible < self.sample)
            index = first + here
            proofs = found.points_at(index), arrays["start"][here], arrays["plan"][here]
            if self._policies is None:
                _prove_feasible(p, index, *proofs, drawn, block)
            else:
                own = arrays["cone"][here], arrays["answer"][here]
                _prove_by_policies(self._policies, index, *proofs, *own, drawn, block)
            with self._lock:
                self.bar.update(len(here))
        return block


def _prove_feasible(
    p: Constraints,
    index: np.ndarray,
    points: np.ndarray,
    starts: np.ndarray,
    plans: np.ndarray,
    drawn: np.ndarray,
    block: _BlockProofs,
) -> None:
    """Prove states of these indices feasible by their plans, those that are drawn in exact
    arithmetic."""
    same = np.searchsorted(p.moves, p.moves)
    known = np.isfinite(starts).all(axis=1) & np.isfinite(plans).all(axis=(1, 2))
    others = starts[:, p.others]
    at_point = (starts[:, p.axes] == points).all(axis=1)
    within = ((others >= p.low) & (others <= p.high)).all(axis=1)
    held = (plans == plans[:, same]).all(axis=(1, 2))
    reasons = {
        "it has no plan": known,
        "the start of its plan is another state": (at_point & within) | ~known,
        "inputs that a control horizon holds differ": held | ~known,
    }
    for why, fine in reasons.items():
        block.failures |= {int(i): why for i in index[~fine]}
    margin = np.where(known, 0.0, -np.inf)
    margin[known] = roll_out_in_floats(p, starts[known], plans[known])
    again = known & (drawn | ~(margin > 0))
    margin[again] = roll_out_exactly(p, starts[again], plans[again])
    block.count(index, margin, again, "its plan breaks a limit by {:.3g}")


def _prove_by_policies(
    policies: StoredPolicies,
    index: np.ndarray,
    points: np.ndarray,
    starts: np.ndarray,
    plans: np.ndarray,
    cones: np.ndarray,
    answers: np.ndarray,
    drawn: np.ndarray,
    block: _BlockProofs,
) -> None:
    """Prove states of these indices feasible: by their place in the cone of proved policies, those
    that are drawn in rational arithmetic, or by a policy of their own."""
    there, combined = (cones >= -1) & (cones < len(policies.corner)), cones >= 0
    combined &= there
    at_point = (starts == np.array([policies.start(x) for x in points])).all(axis=1)
    margin, exactly, same = np.full(len(index), -np.inf), ~combined, np.ones(len(index), bool)
    margin[combined], exactly[combined], same[combined] = policies.combine(
        points[combined], cones[combined], plans[combined], drawn[combined]
    )
    for j in np.flatnonzero(there & ~combined):
        margin[j] = policies.margin(points[j], plans[j], answers[j])
    reasons = {
        "its cone is not stored": there,
        "the start of its plan is another state": at_point,
        "its plan is not that of the policies of its cone": same,
        "it has no policy, or is in another cone": np.isfinite(margin) | ~there,
    }
    for why, fine in reasons.items():
        block.failures |= {int(i): why for i in index[~fine]}
    block.count(index, margin, exactly, "its policy breaks a limit by {:.3g}")


def _prove_infeasible(
    p: Constraints,
    found: Stored,
    infeasible: np.ndarray,
    normals: np.ndarray,
    result: Verification,
    bar: tqdm,
    affine: AffineRows | None,
) -> None:
    """Prove that no trajectory, or no affine policy, starts at states labelled infeasible."""
    open_ = np.array([int(i) not in result.failures for i in infeasible], bool)
    where = infeasible[open_]
    excess = exclude(p, found.points_at(where), normals[open_], bar, affine)
    result.failures |= {
        int(i): "no half-space is found that excludes it" for i in where[~(excess > 0)]
    }
    proved = excess[excess > 0]
    result.verified += len(proved)
    result.exactly += len(proved)
    result.excess = min(result.excess, float(proved.min(initial=np.inf)))


def _compare_half_spaces(
    found: Stored,
    infeasible: np.ndarray,
    normals: np.ndarray,
    offsets: np.ndarray,
    result: Verification,
) -> None:
    """Look for stored half-spaces that contradict the labels: that do not exclude their own state,
    or exclude a feasible one or a proved boundary point."""
    arrays, known = found.arrays, np.isfinite(offsets)
    inside = known & ~(np.sum(normals * found.points_at(infeasible), axis=1) > offsets)
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
    feasible = np.flatnonzero(arrays["label"] == 1)
    off, reach = np.full(len(H), -np.inf), np.zeros(len(H))
    for proved in (
        *(found.points_at(feasible[piece]) for piece in slices(len(feasible), 4096)),
        arrays.get("bound_point", np.zeros((0, H.shape[1]))),
    ):
        most = np.abs(proved).max(axis=0, initial=0.0)
        for piece in slices(len(H), 256):
            values = proved @ H[piece].T - h[piece]
            off[piece] = np.maximum(off[piece], np.max(values, axis=0, initial=-np.inf))
            reach[piece] = np.maximum(reach[piece], most @ np.abs(H[piece]).T)
    for j in np.flatnonzero(off > 1e-12 * (reach + np.abs(h))):
        what = f"half-space {H[j].tolist()} x <= {h[j]:.9g}"
        result.problems.append(f"{what} excludes a feasible state by {off[j]:.3g}")


def _compare_summary(path: Path, found: Stored, result: Verification) -> None:
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
    open_ = found.points_at(np.flatnonzero(arrays["status"] == Status.ITERATION_LIMIT))
    more, beyond_bounds = infeasible - there["infeasible"], np.zeros(len(open_), bool)
    for a, b in zip(arrays.get("bound_normal", ()), arrays.get("bound_offset", ()), strict=True):
        beyond_bounds |= open_ @ a > b
    fine = (
        feasible == there["feasible"]
        and undecided == len(open_) - more
        and 0 <= more <= int(np.sum(beyond_bounds))
    )
    if not fine and found.done == found.blocks:
        what = f"{feasible} feasible, {infeasible} infeasible, {undecided} undecided"
        wrong = f"{path.name}: counts {what}, the store {' '.join(map(str, there.values()))}"
    elif summary.get("config") != found.attributes["config"]:
        wrong = f"{path.name}: its configuration is not that of the store"
    result.problems += [wrong] if wrong else []


def read_report(path: Path, check: Check = lambda attributes, axes: []) -> Stored:
    """Return the samples of a recursion report as `store.read` returns those of a map."""
    found = read_arrays(path)
    if found is None or not isinstance(found[0], dict) or "state" not in found[1]:
        return Stored.damaged(f"{path.name}: cannot be read")
    record, arrays = found
    try:
        summary, wrong = read_results(path.parent / "summary.json")
        if record["problem"] is None:
            n, m = (arrays[name].shape[1] for name in ("state", "input"))
            shapes = dict[str, tuple[int, ...]]()
        else:
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
    if record["problem"] is not None and (differing := check(attributes, {})):
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
    A, B, c = p.A[0], p.B[0], p.c[0]
    expected = states[where] @ A.T + inputs[where] @ B.T + c
    size = np.abs(states[where]) @ np.abs(A).T + np.abs(inputs[where]) @ np.abs(B).T
    wrong = np.any(np.abs(after[where] - expected) > 1e-12 * (size + np.abs(c)), axis=1)
    normals = arrays.get("facet_normals", np.zeros((0, len(A))))
    if len(normals):
        normals = normals[np.argmax(after[where] @ normals.T - arrays["facet_offsets"], axis=1)]
    else:
        normals = np.full((len(where), len(A)), np.nan)
    excess = exclude(p, after[where], normals)
    for i, follows, beyond_by in zip(where, ~wrong, excess, strict=True):
        name = f"next state of state {i}" if i < len(arrays["state"]) else "counterexample"
        if not follows:
            problems.append(f"{name}: it is not A x + B u + c")
        if not beyond_by > 0:
            problems.append(f"{name}: no half-space is found that excludes it")
    return problems
