"""Verification proves what is true, and finds what is not, whatever the store says."""

import shutil
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
import zarr
from damage import turned_bits

import jaxmpc as jm
from jaxmpc import store
from jaxmpc.app.cli import main
from jaxmpc.feasible.pipeline import PROOFS
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.feasible.stored import open_labels
from jaxmpc.store.reading import checksum, regions
from jaxmpc.verify.exact import beyond, integers, roll_out_exactly, roll_out_in_floats
from jaxmpc.verify.half_space_search import Programs
from jaxmpc.verify.stored_map import verify_map
from jaxmpc.verify.stored_problem import Constraints

SYSTEM = jm.LinearSystem(
    np.array([[1.1, 0.2], [0.0, 0.9]]), np.array([[0.02], [0.2]]), c=np.array([0.01, -0.02]),
    state_names=("q", "dq"),
)  # fmt: skip
BOX = jm.Box([-1.0, -1.5], [1.2, 1.0])


def mpc(system=SYSTEM, **fields):
    given = dict(states=BOX, inputs=jm.Box([-1.0], [0.8]), terminal_cost=np.eye(system.n))
    return jm.MPC(system, np.eye(system.n), np.eye(system.m), 5, **given | fields)


def chain():
    """Three states, two inputs."""
    A = np.array([[1.0, 0.3, 0.0], [0.0, 0.8, 0.3], [0.1, 0.0, 1.05]])
    return jm.LinearSystem(A, np.array([[0.0, 0.1], [0.4, 0.0], [0.0, 0.5]]))


def differing(**fields):
    """Everything is another one at each step."""
    random = np.random.default_rng(2)
    moved = lambda M: np.asarray(M, float) + 0.05 * random.normal(size=(5, *np.shape(M)))
    rows = jm.Outputs(random.normal(size=(5, 1, 2)), upper=np.linspace(0.9, 1.2, 5)[:, None])
    return mpc(
        jm.LinearSystem(moved(SYSTEM.A), moved(SYSTEM.B), moved(np.zeros(2))),
        states=jm.Polytope(moved(np.vstack([np.eye(2), -np.eye(2)])), moved([1.2, 1.0, 1, 1.5])),
        inputs=jm.Box(moved([-1.0]), [0.8]), outputs=rows, **fields,
    )  # fmt: skip


def diamond(size):
    H = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])
    return jm.Polytope(H, np.full(4, size))


CUBE = dict(states=jm.Box([-1.0] * 3, [1.0] * 3), inputs=jm.Box([-0.5] * 2, [0.5] * 2))
PROBLEMS = {
    "box": (mpc(), None, None),
    "terminal polytope": (mpc(terminal_set=diamond(0.5)), None, None),
    "terminal ellipsoid": (
        mpc(terminal_set=jm.Ellipsoid(np.array([[2.0, 0.5], [0.5, 1.0]]), 0.3)), None, None,
    ),
    "control horizon": (mpc(control_horizon=2), None, None),
    "polytope of inputs": (mpc(chain(), **CUBE | dict(inputs=diamond(0.6))), (0, 2), np.zeros(3)),
    "slice": (mpc(chain(), **CUBE), (0, 1), np.array([0.0, 0.0, 0.3])),
    "projection": (mpc(chain(), **CUBE), (0, 1), None),
    "terminal point": (mpc(terminal_set=jm.Box([0.1, 0.0], [0.1, 0.0])), None, None),
    "terminal point, two inputs held": (
        mpc(chain(), **CUBE | dict(terminal_set=jm.Box([0.0] * 3, [0.0] * 3), control_horizon=3)),
        (0, 1), np.array([0.0, 0.0, 0.3]),
    ),
    "inputs without limits": (mpc(inputs=None), None, None),
    "input rates": (
        mpc(input_rate_limit=np.array([0.3]), terminal_set=diamond(0.4)), (0, 1),
        np.array([0.0, 0.0, 0.1]),
    ),
    "steps that differ": (differing(), None, None),
    "steps that differ, input rates": (
        differing(input_rate_limit=np.linspace(0.2, 0.4, 5)[:, None]), (0, 1),
        np.array([0.0, 0.0, 0.1]),
    ),
}  # fmt: skip


def stored(path, mpc, axes, fixed, side=15):
    """Write the labels of a grid wider than the limits, as the command does."""
    problem = FeasibilityProblem.of(mpc, axes, fixed)
    along = [np.linspace(-1.4, 1.4, side), np.linspace(-1.7, 1.7, side + 1)]
    points = np.stack(np.meshgrid(*along, indexing="ij"), -1).reshape(-1, 2)
    labels = jm.map_feasible_set(mpc, points, axes=axes, fixed=fixed).labels
    with open_labels(path, problem, along, {}, 128) as kept:
        for block in kept.pending():
            rows = kept.rows(block)
            kept.commit(block, **{k: v[rows] for k, v in labels.arrays().items()})
    return labels


FAST = ("projection",)
NAMES = [v if v in FAST else pytest.param(v, marks=pytest.mark.slow) for v in PROBLEMS]


@pytest.mark.long
@pytest.mark.parametrize("name", NAMES)
def test_proves_all_labels(tmp_path, name):
    problem, axes, fixed = PROBLEMS[name]
    labels = stored(tmp_path / "sweep.zarr", problem, axes, fixed)
    decided = int(np.count_nonzero(labels.label))
    assert decided >= 235 and len(set(labels.label)) >= 2
    for exact in (False, True):
        found = verify_map(tmp_path, exact=exact, sample=5)
        assert found.passed, (found.failures, found.problems)
        assert found.verified == decided
        assert (found.exactly == decided) == (exact or "terminal point" in name)
        assert found.margin >= 0 and found.excess > 0


@pytest.mark.parametrize("name", ["terminal polytope", "terminal ellipsoid"])
def test_roll_out_is_that_of_fractions(name):
    """Each margin to the last digit, and the bound of float64 below it."""
    p = Constraints(FeasibilityProblem.of(PROBLEMS[name][0]).plain())
    random = np.random.default_rng(0)
    starts, plans = random.normal(size=(4, 2)), random.normal(size=(4, 5, 1))
    exact = lambda v: np.vectorize(Fraction, otypes=[object])(v)
    found = roll_out_exactly(p, starts, plans)
    assert np.all(roll_out_in_floats(p, starts, plans) < found)
    np.testing.assert_allclose(roll_out_in_floats(p, starts, plans), found, atol=1e-13)
    for x, u, margin in zip(exact(starts), exact(plans), found, strict=True):
        least = []
        for k in range(6):
            for H, D, lower, upper in zip(p.H[k], p.D[k], p.lower[k], p.upper[k], strict=True):
                value = exact(H) @ x + (exact(D) @ u[k] if k < 5 else 0)
                least += [Fraction(b) - value for b in (upper,) if np.isfinite(b)]
                least += [value - Fraction(b) for b in (lower,) if np.isfinite(b)]
            x = exact(p.A[k]) @ x + exact(p.B[k]) @ u[k] + exact(p.c[k]) if k < 5 else x
        if p.P is not None:
            least.append(Fraction(p.level) - x @ exact(p.P) @ x)
        assert float(min(least)) == margin


def test_rows_that_bound_an_input_alone():
    plain = FeasibilityProblem.of(mpc()).plain()
    plain["rows"][0] = {
        "steps": [0, 2], "H": [[0.0, 0.0], [0.0, 0.0], [0.0, 1.0]], "D": [[-1.0], [2.0], [1.0]],
        "lower": [-3.0, -1.0, -1.0], "upper": [None, 1.0, 1.0],
    }  # fmt: skip
    low, high = Constraints(plain).input_box()
    assert np.all(low == -np.inf) and np.all(high[[0, 2]] == 3.0) and np.all(high[1] == np.inf)


@pytest.mark.long
def test_an_empty_set(tmp_path):
    """No state at all has a plan: the half-space 0'x ≤ b, b < 0, says so."""
    problem = mpc(terminal_set=jm.Box([5.0, 5.0], [6.0, 6.0]))
    labels = stored(tmp_path / "sweep.zarr", problem, None, None, side=4)
    assert np.all(labels.label == -1)
    found = verify_map(tmp_path)
    assert found.passed and found.verified == 20
    p = Constraints(FeasibilityProblem.of(problem).plain())
    zero, box = [np.zeros(len(rows)) for rows in p.lower], Programs(p).boxes()
    assert np.all(beyond(p, zero, np.zeros((3, 2)), box) == -np.inf)


def test_integers():
    values = np.array([0.0, 1.0, -0.1, 2.0**-60, 3e5, np.inf])
    for found, value in zip(integers(values, 130), values[:-1], strict=False):
        assert Fraction(found, 2**130) == Fraction(value)
    assert integers(values, 130)[-1] == 0


@pytest.mark.slow
def test_half_spaces_are_valid_for_any_multipliers():
    """No multipliers exclude a state with a plan."""
    for name in ("terminal ellipsoid", "projection"):
        problem, axes, fixed = PROBLEMS[name]
        view = FeasibilityProblem.of(problem, axes, fixed)
        p = Constraints(view.plain())
        grid = jm.grid([-1.0, -1.2], [1.0, 1.0], (9, 9))
        inside = grid[jm.map_feasible_set(problem, grid, axes=axes, fixed=fixed).label == 1]
        random, box = np.random.default_rng(1), Programs(p).boxes()
        for _ in range(20):
            y = [random.normal(size=len(rows)) for rows in p.lower]
            if p.P is not None:
                y.append(random.normal(size=len(p.P)))
            assert np.all(beyond(p, y, inside, box) <= 0)


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    path = tmp_path_factory.mktemp("sweep") / "sweep.zarr"
    stored(path, mpc(), None, None)
    return path


def tampered(sound, path, name, change):
    """Return a copy of a store in which one variable is changed, with checksums to match: as one
    would leave it who made wrong labels in good faith."""
    shutil.copytree(sound, path)
    group = zarr.open_group(path, mode="r+", use_consolidated=False)
    values = np.asarray(group[name][...])
    change(values, np.asarray(group["label"][...]))
    group[name][...] = values
    names = group.attrs["variables"]
    for block, region in enumerate(regions(group["label"].shape, names["block"])):
        parts = {k: np.asarray(group[k][region]) for k in names["fields"]}
        group["checksum"][block] = checksum(parts)
    return verify_map(path)


class TestFindsWhatIsWrong:
    @pytest.mark.slow
    def test_plans_that_miss_an_equality(self, tmp_path):
        """By more than rounding, though a plan that keeps it is near."""
        path = tmp_path / "sweep.zarr"
        labels = stored(path, *PROBLEMS["terminal point"])

        def beside(values, label):
            values[label == 1] *= 1 + 1e-7

        found = tampered(path, tmp_path / "a.zarr", "plan", beside)
        assert len(found.failures) == np.sum(labels.label == 1) > 5

    @pytest.mark.long
    def test_labels(self, sound, tmp_path):
        """Each of ten flipped labels, and no other."""
        where = np.random.default_rng(0).choice(240, 10, replace=False)

        def flip(values, _):
            flat = values.reshape(-1)
            flat[where] = -flat[where]

        found = tampered(sound, tmp_path / "a.zarr", "label", flip)
        assert sorted(found.failures) == sorted(where) and not found.passed

    def test_plans(self, sound, tmp_path):
        def beyond_the_limit(values, label):
            values[label == 1, 0, 0] = np.nextafter(0.8, 1)  # by the last bit

        found = tampered(sound, tmp_path / "a.zarr", "plan", beyond_the_limit)
        assert len(found.failures) == found.labels["feasible"]

    def test_starts(self, sound, tmp_path):
        def elsewhere(values, label):
            values[label == 1] = 0.0

        found = tampered(sound, tmp_path / "a.zarr", "start", elsewhere)
        assert len(found.failures) >= found.labels["feasible"] - 1
        assert "another state" in next(iter(found.failures.values()))

    def test_half_spaces(self, sound, tmp_path):
        def turned(values, label):
            values[label == -1] *= -1

        found = tampered(sound, tmp_path / "a.zarr", "cut_normal", turned)
        assert found.failures or found.problems

    def test_a_system_with_less_force(self, sound, tmp_path):
        """The same store for a problem with tighter limits: plans fail, and some states."""
        path = tmp_path / "sweep.zarr"
        weaker = replace(mpc(), inputs=jm.Box([-0.5], [0.4]))
        problem = FeasibilityProblem.of(weaker)
        found = store.read(sound)
        with open_labels(path, problem, list(found.axes.values()), {}, 128) as kept:
            for block in kept.pending():
                rows = kept.rows(block)
                kept.commit(
                    block,
                    **{name: found.arrays[name][rows] for name in ("label", "status", *PROOFS)},
                )
        assert "breaks a limit" in " ".join(verify_map(path).failures.values())

    def test_blocks_that_are_not_done(self, sound, tmp_path):
        problem = FeasibilityProblem.of(mpc())
        axes = list(store.read(sound).axes.values())
        open_labels(tmp_path / "sweep.zarr", problem, axes, {}, 128).close()
        assert "2 of 2 blocks are not done" in verify_map(tmp_path).problems[0]

    def test_what_a_killed_run_left_of_a_block_is_no_result(self, sound, tmp_path):
        """Labels without their plans: they are not counted, and nothing is said of them."""
        path, whole = tmp_path / "sweep.zarr", verify_map(sound).labels
        shutil.copytree(sound, path)
        group = zarr.open_group(path, mode="r+")
        labels = np.ravel(
            group["label"][regions(group["label"].shape, group.attrs["variables"]["block"])[0]]
        )
        group["checksum"][0], group["plan"][:8] = 0, np.nan
        found = verify_map(path)
        assert found.problems == ["1 of 2 blocks are not done: resume the sweep"]
        assert not found.failures and not found.passed
        assert found.labels["feasible"] == whole["feasible"] - np.sum(labels == 1)
        assert found.labels["undecided"] == whole["undecided"] + np.sum(labels != 0)

    @pytest.mark.slow
    def test_one_bit_of_any_array(self, sound):
        """100 times; checksums find it where the proofs do not."""
        for file in turned_bits(sound, 100):
            assert store.read(sound).problems, file
        assert verify_map(sound).passed


def test_what_holds_no_map(tmp_path):
    with pytest.raises(ValueError, match="holds no labels"):
        verify_map(tmp_path)


@pytest.mark.long
def test_a_map_made_from_python_is_verified(tmp_path, capsys):
    """Its configuration names no system: the problem is the stored one."""
    jm.feasible.sweep_into(tmp_path / "map.zarr", mpc(), [np.linspace(-1, 1, 4)] * 2)
    found = verify_map(tmp_path / "map.zarr")
    assert found.passed and not found.problems and found.verified > 10
    assert main(["verify", str(tmp_path / "map.zarr")]) == 0
    assert "the problem is the stored one" in capsys.readouterr().err
