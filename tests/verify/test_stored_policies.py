"""Stored labels under affine policies and tubes: what is true is proved, what is not is found."""

import itertools
from fractions import Fraction

import numpy as np
import pytest

import jaxmpc as jm
from jaxmpc.feasible import policy_hull, stored, sweep_into
from jaxmpc.feasible.policy_problem import problem_of
from jaxmpc.grids import mesh
from jaxmpc.verify import verify_map
from jaxmpc.verify.exact_policies import StoredPolicies
from jaxmpc.verify.half_space_search import AffinePrograms
from jaxmpc.verify.stored_problem import Constraints

A, B = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[0.5], [1.0]])
LINES = [np.linspace(-5.3, 5.3, 17), np.linspace(-2.1, 2.1, 18)]


def double(policy, unit=1.0, **fields):
    """unit: of the input."""
    given = dict(
        states=jm.Box([-5.0, -2.0], [5.0, 2.0]), inputs=jm.Box([-unit], [unit]),
        terminal_set=jm.Box([-1.0, -0.6], [1.0, 0.6]),
        disturbance=jm.Box([-0.1, -0.1], [0.05, 0.1]),
    )  # fmt: skip
    system = jm.LinearSystem(A, B / unit, np.array([0.01, 0.0]) if policy == "affine" else None)
    return jm.MPC(system, np.eye(2), 0.1, 3, **given | fields, policy=policy)


def written(path, mpc, change=lambda arrays: None):
    """Write the labels of a grid, changed before; return them as they were."""
    problem = problem_of(mpc)
    labels = jm.map_feasible_set(problem, mesh(LINES)).labels
    arrays = {name: value.copy() for name, value in labels.arrays().items()}
    change(arrays)
    with stored.open_labels(path, problem, LINES, {}, 128) as kept:
        for block in kept.pending():
            rows = kept.rows(block)
            kept.commit(block, **{name: value[rows] for name, value in arrays.items()})
    return labels


@pytest.mark.long
@pytest.mark.parametrize("policy", ["affine", "tube"])
@pytest.mark.parametrize("rounds", [8, 1])
@pytest.mark.first(1)
def test_proves_all_labels(tmp_path, monkeypatch, policy, rounds):
    """Also where few rays are sent, so that states near the boundary have policies of their own."""
    monkeypatch.setattr(policy_hull, "ROUNDS", rounds)
    path = tmp_path / "sweep.zarr"
    found = sweep_into(path, double(policy), LINES)
    whole = jm.map_feasible_set(found.problem, mesh(LINES))
    np.testing.assert_array_equal(found.store.read("label"), whole.label)
    again = stored.stored_labels(found.store)
    np.testing.assert_array_equal(again.arrays()["cone"], whole.labels.arrays()["cone"])
    decided = int(np.count_nonzero(whole.label))
    own = (whole.label == 1) & (again.arrays()["cone"] < 0)
    assert decided >= 304 and min(np.sum(whole.label == v) for v in (1, -1)) > 100
    assert own.any() == (rounds == 1)
    for exact in (False, True):
        result = verify_map(path, exact=exact, sample=20)
        assert result.passed, (result.failures, result.problems)
        assert result.verified == decided and result.margin >= 0 and result.excess > 0
        assert (result.exactly == decided) == exact


MORE = [
    ("tube", {"terminal_set": None}),
    ("tube", {"input_rate_limit": [1.2]}),
    ("affine", {"input_rate_limit": [0.8], "control_horizon": (1, 2)}),
    ("affine", {"control_horizon": 2}),
]


@pytest.mark.long
@pytest.mark.parametrize(("policy", "fields"), MORE)
@pytest.mark.first(1)
def test_proves_labels_of_rates_and_blocks(tmp_path, policy, fields):
    """The gain of the tube gives previous inputs a part in its first rate. Without a terminal set
    the last step has no rows."""
    W = jm.Box([-0.05, -0.04], [0.03, 0.05])
    if "control_horizon" in fields:  # which takes symmetric disturbances alone
        W = jm.Box([-0.04, -0.045], [0.04, 0.045])
    mpc = double(policy, disturbance=W, **fields)
    lines = [np.linspace(-5.3, 5.3, 9), np.linspace(-2.1, 2.1, 10)]
    lines += [np.array([-1.01, -0.9, 0.3, 0.8])] if mpc.rate_limited else []
    path = tmp_path / "sweep.zarr"
    found = sweep_into(path, mpc, lines)
    label = found.store.read("label")
    assert min(np.sum(label == v) for v in (1, -1)) > 25 and np.mean(label != 0) > 0.95
    result = verify_map(path, exact=True)
    assert result.passed, (result.failures, result.problems)
    assert result.verified == result.exactly == np.count_nonzero(label)


@pytest.mark.long
@pytest.mark.parametrize(("policy", "unit"), [("tube", 1.0), ("affine", 1.0), ("affine", 2.0**-40)])
@pytest.mark.first(1)
def test_finds_what_is_wrong(tmp_path, policy, unit, monkeypatch):
    """A wrong label of either kind, a wrong cone or plan; a policy that breaks a limit makes wrong
    whatever rests on it."""
    mpc = double(policy, unit)
    before = jm.map_feasible_set(mpc, mesh(LINES)).labels
    label = before.label
    wrong = int(np.flatnonzero(label == -1)[40]), *np.flatnonzero(label == 1)[[10, 20, 30]].tolist()

    def change(arrays):
        out, inside, cone, plan = wrong
        arrays["label"][out], arrays["status"][out] = 1, jm.Status.SOLVED
        arrays["start"][out], arrays["cone"][out] = mesh(LINES)[out], 0
        arrays["plan"][out] = 0.0
        arrays["label"][inside], arrays["status"][inside] = -1, jm.Status.PRIMAL_INFEASIBLE
        arrays["cone"][cone] = (arrays["cone"][cone] + 3) % arrays["cone"].max()
        arrays["plan"][plan] += 1e-6 * unit

    written(tmp_path / "a.zarr", mpc, change)
    found = verify_map(tmp_path / "a.zarr")
    assert sorted(found.failures) == sorted(wrong) and not found.passed
    assert "no half-space" in found.failures[wrong[1]]
    assert "its plan is not that" in found.failures[wrong[3]]

    original, corners = stored.policy_format, policy_hull.policy_hull(problem_of(mpc)).corners
    first = int(corners[before.arrays()["cone"][wrong[3]]][0])

    place = (1, 0, 0, 0) if policy == "affine" else (0,)

    def other(problem):
        fields, constants = original(problem)
        constants["policy_answer"].data[first, *place] += 3.0 * unit
        return fields, constants

    monkeypatch.setattr(stored, "policy_format", other)
    labels = written(tmp_path / "b.zarr", mpc)
    resting = (corners[labels.arrays()["cone"]] == first).any(axis=1) & (labels.label == 1)
    found = verify_map(tmp_path / "b.zarr")
    assert resting.any() and {*np.flatnonzero(resting)} <= {*found.failures}
    assert any("breaks a limit" in why for why in found.failures.values())


@pytest.mark.parametrize("policy", ["affine", "tube"])
def test_margins_are_those_of_all_vertex_sequences(policy):
    """In fractions, from policies that break limits too."""
    mpc = double(policy)
    problem = problem_of(mpc)
    hull = policy_hull.policy_hull(problem)
    names = ("policy_state", "policy_plan", "policy_answer")
    arrays = dict(zip(names, hull.triples, strict=True)) | {"corner": hull.corners}
    plain = problem.plain()
    policies = StoredPolicies(plain, Constraints(plain), arrays)
    assert np.all(policies.margins >= 0)
    exact = lambda v: np.asarray(np.frompyfunc(Fraction, 1, 1)(np.asarray(v, float)), object)
    low, high = exact(mpc.disturbance.lower), exact(mpc.disturbance.upper)
    c = exact(np.zeros(2) if mpc.system.c is None else mpc.system.c)
    K = exact(plain["disturbance"].get("gain", np.zeros((1, 2))))
    random = np.random.default_rng(0)
    for theta, plan, answer in zip(*(v[:3] for v in hull.triples), strict=True):
        plan = plan + 0.3 * random.normal(size=plan.shape)
        found, _ = policies.closed_loop(
            theta, plan, answer.reshape(3, 1, -1) if policy == "affine" else answer
        )
        least, z_0 = np.inf, exact(theta)
        if policy == "tube":
            section = plain["disturbance"]["section"]
            z_0 = z_0 - exact(section["center"]) - exact(section["generators"]) @ exact(answer)
        for signs in itertools.product((-1, 1), repeat=6):
            omega = np.reshape(signs, (3, 2))
            x, z = exact(theta), z_0
            for k in range(4):
                set_ = mpc.states if k < 3 else mpc.terminal_set
                room = [*(exact(set_.upper) - x), *(x - exact(set_.lower))]
                if k < 3:
                    v = exact(plan[k])
                    u = v + K @ (x - z)
                    if policy == "affine":
                        u = v + np.einsum("mjg,jg->m", exact(answer[k]), omega)
                    room += [*(1 - u), *(u + 1)]
                    w = (low + high) / 2 + (high - low) / 2 * omega[k]
                    x = exact(A) @ x + exact(B) @ u + c + w
                    z = exact(A) @ z + exact(B) @ v + c
                least = min(least, *room)
        assert found == float(least)


def test_half_spaces_of_any_multipliers_hold_on_the_whole_set():
    """Of random ones, and those of programs, which are tight."""
    mpc = double("affine", disturbance_matrix=np.array([[1.0, 0.2], [0.0, 1.0]]))
    problem = problem_of(mpc)
    hull = policy_hull.policy_hull(problem)
    plain = problem.plain()
    p = Constraints(plain)
    names = ("policy_state", "policy_plan", "policy_answer")
    arrays = dict(zip(names, hull.triples, strict=True)) | {"corner": hull.corners}
    programs = AffinePrograms(p, StoredPolicies(plain, p, arrays).affine)
    box, proved, random = programs.boxes(), hull.bounds.points, np.random.default_rng(0)
    for _ in range(20):
        y = programs.of_rows(random.normal(size=len(programs.bounds)))
        assert np.all(programs.beyond(y, proved, box) <= 0)
    for normal in random.normal(size=(8, 2)):
        (y, _) = programs.multipliers(proved[0], normal)
        assert np.all(programs.beyond(y, proved, box) <= 0)
        outside = proved + 1e-6 * normal / np.abs(normal).max()
        most = np.argmax(proved @ normal)
        assert programs.beyond(y, outside[[most]], box)[0] > 0
