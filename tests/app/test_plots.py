"""The picture shows what the map holds, in any figure, without a window."""

import dataclasses
import tracemalloc
from types import SimpleNamespace

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from panels import require_no_empty_panel

import jaxmpc as jm
from jaxmpc.app.plots import (
    plot_body,
    plot_feasible_set,
    plot_plan,
    plot_recursion,
    plot_robot_map,
)
from jaxmpc.app.plots.closed_loops import BROKEN, plot_before_after, plot_runs
from jaxmpc.app.plots.style import FEASIBLE, INFEASIBLE
from jaxmpc.app.plots.tuning import plot_maps, plot_solver, plot_trade_off, plot_tuning
from jaxmpc.closed_loop.outcome import summarise_runs
from jaxmpc.closed_loop.simulation import Run
from jaxmpc.recursion.counterexamples import Counterexample, SampledLoops
from jaxmpc.recursion.proofs import Claim
from jaxmpc.recursion.report import RecursionReport
from jaxmpc.robots.linear_plant import LinearPlant
from jaxmpc.sets.convex_sets import Box, Polytope
from jaxmpc.systems.system import LinearSystem
from jaxmpc.tuning.descent import Descent
from jaxmpc.tuning.pareto import TradeOff


@dataclasses.dataclass(frozen=True)
class Map:
    """What the picture asks of a FeasibleSetMap: |x| <= 1.1 feasible, to 1.3 undecided."""

    x0s: np.ndarray
    n: int = 2
    fixed: np.ndarray | None = None
    axes: tuple[int, int] = (0, 1)

    @property
    def label(self) -> np.ndarray:
        distance = np.abs(self.x0s).max(axis=1)
        return np.where(distance <= 1.1, 1, np.where(distance <= 1.3, 0, -1)).astype(np.int8)

    @property
    def mpc(self):
        names, units = ("q", "dq", "r", "dr")[: self.n], ("rad", "rad/s", "m", "m/s")[: self.n]
        B = np.ones((self.n, 1))
        system = LinearSystem(np.eye(self.n), B, state_names=names, state_units=units)
        return SimpleNamespace(system=system, horizon=7, rate_limited=False)

    @property
    def axis_names(self):
        return self.mpc.system.state_labels[:2]

    def inner(self) -> Polytope:
        return Box(-np.ones(2), np.ones(2)).to_polytope()

    def outer(self) -> Polytope:
        return Box(-1.2 * np.ones(2), 1.2 * np.ones(2)).to_polytope()

    def terminal_section(self) -> Polytope | None:
        return Box(-0.5 * np.ones(2), 0.5 * np.ones(2)).to_polytope() if self.n == 2 else None


def square(count):
    side = np.linspace(-2, 2, count)
    return np.stack(np.meshgrid(side, side, indexing="ij"), axis=-1).reshape(-1, 2)


def texts(ax):
    return [text.get_text() for text in ax.get_legend().get_texts()]


def test_grid_becomes_an_image_with_first_state_to_the_right():
    points = square(21)
    fmap = Map(points)
    ax = plot_feasible_set(fmap)
    image = ax.images[0].get_array()
    np.testing.assert_array_equal(image[3, :], fmap.label.reshape(21, 21)[:, 3])
    assert ax.images[0].get_extent() == pytest.approx((-2.1, 2.1, -2.1, 2.1))
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("q [rad]", "dq [rad/s]")
    assert ax.get_title(loc="left") == "Feasible initial states, horizon N = 7"
    assert texts(ax) == [
        "feasible (121)",
        "infeasible (272)",
        "undecided (48)",
        "terminal set",
        "outer bound",
        "inner bound",
    ]
    reach = [np.abs(line.get_xdata()).max() for line in ax.lines]
    np.testing.assert_allclose(reach, [0.5, 1.2, 1.0])


@pytest.mark.parametrize("order", ["rising", "falling", "shuffled", "uneven"])
def test_cells_have_the_labels_of_their_states(order):
    x, y = np.linspace(-2, 2, 9), np.linspace(-1.9, 1.5, 7)
    y = y**3 if order == "uneven" else y[::-1] if order == "falling" else y
    points = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    if order == "shuffled":
        points = np.random.default_rng(0).permutation(points)
    fmap = Map(points)
    ax = plot_feasible_set(fmap)
    if order == "uneven":
        assert not ax.images
        return
    cells, (left, right, low, high) = ax.images[0].get_array(), ax.images[0].get_extent()
    i = ((points[:, 0] - left) / (right - left) * cells.shape[1]).astype(int)
    j = ((points[:, 1] - low) / (high - low) * cells.shape[0]).astype(int)
    np.testing.assert_array_equal(cells[j, i], fmap.label)


def test_scattered_states_take_no_memory_of_a_grid():
    """Of 6,000 there are 36 million pairs of coordinates; two of a grid at one place are none."""
    points = np.random.default_rng(0).uniform(-2, 2, (6000, 2))
    tracemalloc.start()
    assert not plot_feasible_set(Map(points)).images
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 1e8
    twice = square(5)
    twice[7] = twice[6]
    assert not plot_feasible_set(Map(twice)).images


def test_cells_end_at_the_bounds(tmp_path):
    """Beyond the outer bound the picture is grey, inside the inner one blue, whatever the cells."""
    ax = plot_feasible_set(Map(square(7)))  # cells of 2/3: one of a feasible state reaches to 1/3
    ax.figure.set_layout_engine("none")
    ax.figure.savefig(tmp_path / "map.png", dpi=100)
    image = plt.imread(tmp_path / "map.png")[::-1, :, :3]
    for x, colour in ((0.2, FEASIBLE), (0.9, FEASIBLE), (1.3, INFEASIBLE)):
        for point in ((x, 0.1), (-x, 0.1), (0.1, x), (0.1, -x)):
            column, row = ax.transData.transform(point).astype(int)
            np.testing.assert_allclose(image[row, column], to_rgb(colour), atol=0.01)


def test_set_points_over_time_and_titles():
    """One a sample, drawn as steps; two inputs beside three states fill the same height."""
    system = LinearSystem(np.eye(3), np.ones((3, 2)), dt=0.5)
    box = lambda size: Box(-2 * np.ones(size), 2 * np.ones(size))
    plant = LinearPlant(system, box(3), box(2))
    reference = np.zeros((9, 3))
    reference[4:] = 1.0
    zeros = np.zeros((1, 6))
    run = Run(np.zeros((1, 7, 3)), np.zeros((1, 6, 2)), *[zeros] * 6)
    figure = plot_runs(run, plant, reference=reference, input_reference=np.ones((6, 2)), title="T")
    assert figure.get_suptitle() == "T"
    for ax, jump in zip(figure.axes, (2.0,) * 3 + (None,) * 2, strict=True):
        x, y = ax.lines[-1].get_xydata().T
        assert (x[0], x[-1]) == (0.0, 3.0)
        np.testing.assert_array_equal(y, 1.0 if jump is None else x >= jump)
    figure.draw_without_rendering()
    for column in (figure.axes[:3], figure.axes[3:]):
        heights = [ax.get_window_extent() for ax in column]
        gaps = [above.y0 - below.y1 for above, below in zip(heights, heights[1:], strict=False)]
        assert max(gaps) < 0.1 * figure.bbox.height
    ends = [(c[0].get_window_extent().y1, c[-1].get_window_extent().y0)
            for c in (figure.axes[:3], figure.axes[3:])]  # fmt: skip
    np.testing.assert_allclose(*ends, atol=1.0)


def test_scattered_points_slice_and_projection(tmp_path):
    points = np.random.default_rng(0).uniform(-2, 2, (300, 2))
    figure = Figure()
    ax = figure.add_subplot()
    assert plot_feasible_set(Map(points, 4, np.array([0.0, 0.0, 0.5, -1.0])), ax) is ax
    assert not ax.images and len(ax.collections) == 3
    assert ax.get_title(loc="left").endswith("slice at r [m] = 0.5, dr [m/s] = -1")
    assert "terminal set" not in texts(ax)
    ax = plot_feasible_set(Map(points, 3))
    assert ax.get_title(loc="left").endswith("projection: some value of r [m]")
    figure.savefig(tmp_path / "map.png")
    assert (tmp_path / "map.png").stat().st_size > 1000


def test_a_map_without_points_shows_its_bounds():
    ax = plot_feasible_set(Map(np.zeros((0, 2))))
    assert not any(word.startswith(("feasible", "infeasible")) for word in texts(ax))
    assert any("bound" in word for word in texts(ax))


def test_only_two_states():
    with pytest.raises(ValueError, match="fmap: maps 3 states.*Choose|choose `axes`"):
        plot_feasible_set(Map(np.zeros((5, 3))))


def recursion_report(points, worst=True):
    """|x| <= 1 feasible; lost at step 1 above x2 = 0.9, at step 4 above 0.8, open above 0.7."""
    inside = np.abs(points).max(axis=1) <= 1
    height = points[:, 1]
    lost_at = np.select([~inside, height > 0.9, height > 0.8, height > 0.7], [-1, 1, 4, -2], 0)
    counterexample = Counterexample(
        state=np.array([0.5, 1.0]),
        inputs=np.zeros((7, 1)),
        next_state=np.array([1.2, 0.9]),
        normal=np.array([1.0, 0.0]),
        offset=1.0,
        distance=0.2,
        feasible_inputs=np.zeros((7, 1)),
        primal_residual=0.0,
        dual_residual=0.0,
        found="search",
    )
    system = LinearSystem(np.eye(2), np.ones((2, 1)), state_names=("q", "dq"))
    return RecursionReport(
        mpc=SimpleNamespace(system=system, horizon=7, labels=system.state_labels),
        strong=Claim(False, "a"),
        law=Claim(False, "b"),
        weak=Claim(None, "c"),
        counterexample=counterexample if worst else None,
        feasible_set=Box(-np.ones(2), np.ones(2)).to_polytope(),
        volume=4.0,
        lost_by_any=np.nan,
        lost_by_law=0.1,
        seconds=1.0,
        loops=SampledLoops(
            x0s=points,
            labels=SimpleNamespace(label=np.where(inside, 1, -1).astype(np.int8)),
            inputs=np.zeros((len(points), 1)),
            next_states=points,
            lost_at=lost_at,
            undecided_at=np.where(lost_at == -2, 1, 0),
            steps=9,
        ),
    )


def test_recursion_shows_fates_set_and_counterexample(tmp_path):
    points = square(41)
    report = recursion_report(points)
    ax = plot_recursion(report)
    image = ax.images[0].get_array().T.ravel()
    for fate, lost in ((0, -1), (1, -2), (2, 0), (3, 1), (6, 4)):
        np.testing.assert_array_equal(image == fate, report.loops.lost_at == lost)
    shown = texts(ax)
    names = ("infeasible", -1), ("undecided", -2), ("kept for 9 steps", 0), ("lost at step 1", 1)
    counts = [(f"{name} ({np.sum(report.loops.lost_at == fate):,})") for name, fate in names]
    assert shown[:4] == counts and shown[4].startswith("lost at step 4 to 5 (")
    assert shown[-4:] == [
        "X_7: states with a plan",
        "counterexample x",
        "next state",
        "half-space it leaves",
    ]
    cut = next(line for line in ax.lines if np.allclose(line.get_xdata(), 1.0))
    assert np.ptp(cut.get_ydata()) > 4  # across the picture
    assert ax.get_title(loc="left") == "Closed loops of 9 steps, horizon N = 7"
    ax = plot_recursion(recursion_report(np.zeros((0, 2))))
    assert ax.get_xlim()[0] < -0.5 and ax.get_ylim()[0] < -0.5  # all of the set in view
    ax = plot_recursion(report, Figure().add_subplot(), enlarge=True)
    assert not ax.images and ax.get_xlim()[0] > -0.5 and ax.get_xlim()[1] > 1.2
    assert "next state outside X_" in ax.get_title(loc="left")
    ax.figure.savefig(tmp_path / "enlarged.png")
    # The neighbourhood that is shown does not depend on units.
    unit = np.array([1.0, 1e4])
    worst = report.counterexample
    ends = {name: getattr(worst, name) * unit for name in ("state", "next_state")}
    other = dataclasses.replace(
        report,
        counterexample=dataclasses.replace(worst, normal=worst.normal / unit, **ends),
        feasible_set=np.diag(unit) @ report.feasible_set,
        loops=dataclasses.replace(report.loops, x0s=report.loops.x0s * unit),
    )
    other_ax = plot_recursion(other, Figure().add_subplot(), enlarge=True)
    np.testing.assert_allclose(other_ax.get_xlim(), ax.get_xlim(), rtol=1e-9)
    np.testing.assert_allclose(other_ax.get_ylim(), 1e4 * np.array(ax.get_ylim()), rtol=1e-9)
    random = np.random.default_rng(0).uniform(-2, 2, (300, 2))
    ax = plot_recursion(recursion_report(random, worst=False))
    assert not ax.images and "half-space it leaves" not in texts(ax)


def test_recursion_refuses_what_it_cannot_draw():
    report = recursion_report(square(5), worst=False)
    with pytest.raises(ValueError, match="enlarge: without a counterexample"):
        plot_recursion(report, enlarge=True)
    loops = dataclasses.replace(report.loops, x0s=np.zeros((5, 3)))
    with pytest.raises(ValueError, match="report: is of 3 states"):
        plot_recursion(dataclasses.replace(report, loops=loops))


@pytest.mark.parametrize("claim", ["limits", "recursion"])
def test_robot_map_says_in_words_what_became_of_each_state(claim):
    """Outside the feasible set an unsolved plan of the robot is that, and not an undecided
    label."""
    points = square(21)
    fmap, size = Map(points), np.abs(points).max(axis=1)
    fmap = SimpleNamespace(
        **{
            name: getattr(fmap, name)
            for name in ("x0s", "fixed", "axes", "mpc", "inner", "outer", "terminal_section")
        }
    )
    predicted = np.select([size > 1.5, size > 1.3], [-1, 0], 1)
    held = np.where(points[:, 0] > 0.9, -1, 1)
    if claim == "recursion":
        held[points[:, 1] > 0.9] = 0
    unsure = (predicted == 1) & (held == -1) & (points[:, 1] > 0)
    rmap = SimpleNamespace(
        x0s=points,
        linear=fmap,
        claim=claim,
        predicted=predicted,
        held=held,
        unsure=unsure,
        axis_names=("q [rad]", "dq [rad/s]"),
        set_point=np.zeros(2),
        worst=lambda: None,
        seconds=2.0,
        robot=SimpleNamespace(name="pendulum", dt=0.02, time_unit="s"),
    )
    ax = Figure().add_subplot()
    assert plot_robot_map(rmap, ax) is ax
    counts = {
        text.rsplit(" (", 1)[0].replace("\n", " "): int(text.rsplit(" (", 1)[1][:-1])
        for text in texts(ax)
        if text.endswith(")")
    }
    assert sum(counts.values()) == len(points)
    undecided = [name for name in counts if "undecided" in name]
    assert [counts.pop(name) for name in undecided] == [np.sum(predicted == 0)]
    assert counts.pop("the same, but after a plan that was not solved") == unsure.sum() > 0
    open_ = counts.pop("a plan of the robot was not solved", 0)
    assert open_ == np.sum((predicted != 0) & (held == 0)) and bool(open_) == (claim == "recursion")
    both = [(1, 1), (1, -1), (-1, -1), (-1, 1)]
    wanted = [np.sum((predicted == p) & (held == h) & ~unsure) for p, h in both]
    assert list(counts.values()) == wanted and min(wanted) > 0
    image = ax.images[0].get_array().T.ravel()
    assert len(np.unique(image)) == len(counts) + 2 + bool(open_)
    assert ax.get_title(loc="left").startswith("pendulum: ") and "2 s" in ax.get_title(loc="left")
    assert (ax.get_xlabel(), ax.get_ylabel()) == rmap.axis_names


def drawn_history(rng, steps, every, fail_share, zero):
    """A descent as `jaxmpc tune weights` draws it: validation every so many steps, some steps
    without a finite gradient."""
    accepted = rng.uniform(size=steps) >= fail_share
    measured = (np.arange(steps + 1) % every == 0) | (np.arange(steps + 1) == steps)
    share = np.where(measured, 0.0 if zero else rng.uniform(size=steps + 1), np.nan)
    return Descent(
        theta=None, best=0, thetas=None, loss=np.where(accepted, rng.uniform(1, 9, steps), np.nan),
        gradient_norm=np.where(accepted, rng.uniform(1, 9, steps), np.nan), accepted=accepted,
        validation=np.where(measured, rng.uniform(1, 9, steps + 1), np.nan), numbers={},
        validation_numbers={"unsolved": share, "violation": share}, seconds=0.0,
        interrupted=False,
    )  # fmt: skip


# Steps, and after how many of them the validation loss is measured.
RUNS = [(0, 1), (1, 3), (7, 3), (0, 3), (1, 1), (2, 1), (2, 3), (7, 1), (60, 1), (60, 3)]


@pytest.mark.parametrize(("steps", "every"), RUNS)
@pytest.mark.first(3)
def test_no_panel_of_tuning_is_empty(steps, every):
    """Whatever --updates, --tune and the run come to."""
    rng = np.random.default_rng(steps)
    for fail_share in (0.0, 0.5, 1.0):
        for zero in (True, False):
            for entries in (1, 3, 12):
                trace = {"Q": {f"x{i}": rng.uniform(0.5, 2, steps + 1) for i in range(entries)}}
                history = drawn_history(rng, steps, every, fail_share, zero)
                figure = plot_tuning(history, trace, "title")
                require_no_empty_panel(figure)
                names = {ax.get_ylabel() for ax in figure.axes}
                assert ("fraction in the validation loops [%]" in names) == (not zero)
                assert ("weight relative to the start" in names) == (steps > 0)


def test_weights_that_move_alike_stay_in_sight():
    """Each later line is thinner than those that it may lie on, and dashed in another way."""
    trace = {"Q": dict.fromkeys(("p", "v", "w"), np.linspace(1, 2, 8)), "R": {"": np.ones(8)}}
    history = drawn_history(np.random.default_rng(0), 7, 1, 0.0, zero=True)
    axes = {ax.get_ylabel(): ax for ax in plot_tuning(history, trace, "title").axes}
    lines = axes["weight relative to the start"].lines[:4]
    assert np.all(np.diff([line.get_linewidth() for line in lines]) < 0)
    assert len({str(line._dash_pattern) for line in lines}) == 4


@pytest.mark.parametrize("residual", [1e-3, 1.5, np.inf, np.nan])
@pytest.mark.parametrize("count", [1, 5])
def test_no_panel_of_the_solver_is_empty(residual, count):
    run = SimpleNamespace(
        settings={
            "blocks": [("states", [0, 1, 2], 2), ("terminal", [3], 4), ("none", [], 0)],
            "given_rho": 0.6,
        },
        solver=SimpleNamespace(rho=np.full((3, 10), 0.1)),
    )
    before, after = np.full(count, residual), np.full(count, 1e-6)
    figure = plot_solver(run, before, after)
    require_no_empty_panel(figure)
    labels = [text.get_text() for text in figure.axes[-1].get_legend().get_texts()]
    assert labels[0].startswith("before: 100.0 %" if residual == 1e-3 else "before: 0.0 %")
    assert labels[1].startswith("after: 100.0 %")


def test_maps_without_area_are_drawn_as_points():
    fmap = Map(square(11))
    flat = SimpleNamespace(
        x0s=fmap.x0s, label=fmap.label, mpc=fmap.mpc, axis_names=fmap.axis_names,
        inner=lambda: None, volume_bounds=lambda: (0.0, 0.0),
    )  # fmt: skip
    figure = plot_maps(flat, flat)
    require_no_empty_panel(figure)
    assert "25 feasible states, without area" in texts(figure.axes[0])[0]


def test_what_has_nothing_to_draw_is_refused():
    report = recursion_report(square(3), worst=False)
    loops = SimpleNamespace(x0s=np.zeros((0, 2)), lost_at=np.zeros(0), label=np.zeros(0), steps=9)
    with pytest.raises(ValueError, match="holds nothing to draw"):
        plot_recursion(dataclasses.replace(report, feasible_set=None, loops=loops))
    fmap = SimpleNamespace(axis_names=("a", "b", "c"), inner=lambda: None, outer=lambda: None)
    with pytest.raises(ValueError, match="has no bounded body to draw"):
        plot_body(fmap)


def test_loops_that_cannot_be_drawn_are_named():
    system, zeros = LinearSystem(np.eye(1), np.ones((1, 1)), dt=0.5), np.zeros((1, 6))
    plant = LinearPlant(system, Box([-1], [1]), Box([-1], [1]))
    run = Run(np.zeros((1, 7, 1)), np.zeros((1, 6, 1)), *[zeros] * 6)
    with pytest.raises(ValueError, match="plant: is a LinearSystem. Give jm.LinearPlant"):
        plot_runs(run, system)
    with pytest.raises(ValueError, match="run: is a tuple. Give what simulate"):
        plot_runs((), plant)
    with pytest.raises(ValueError, match="robot: is a LinearPlant. Give a"):
        summarise_runs(run, plant, np.zeros(1), np.zeros(1))


@pytest.mark.parametrize("finite", [0, 1, 2, 9])
def test_no_panel_of_loops_that_end_is_empty(finite):
    """Of states and inputs that are finite for so many samples."""
    B, T = 3, 8
    states, inputs, zeros = np.zeros((B, T + 1, 2)), np.zeros((B, T, 1)), np.zeros((B, T))
    states[:, finite:], inputs[:, finite:] = np.nan, np.nan
    plant = LinearPlant(
        LinearSystem(np.eye(2), np.ones((2, 1)), dt=0.1), Box([-1, -1], [1, 1]), Box([-1], [1])
    )
    run = Run(states, inputs, zeros, zeros, zeros, zeros, zeros, zeros)
    require_no_empty_panel(plot_runs(run, plant))
    figure = plot_before_after(run, run, plant, loops=[2, 0])
    require_no_empty_panel(figure)
    shown = [line for line in figure.axes[0].lines if len(line.get_xdata()) == T + 1]
    assert len(shown) == 4  # two loops, before and after
    with pytest.raises(ValueError, match="loops: "):
        plot_before_after(run, run, plant, loops=[B])


def test_an_empty_panel_is_found():
    figure = Figure()
    ax = figure.add_subplot()
    ax.axhline(1.0)
    with pytest.raises(AssertionError, match="is empty"):
        require_no_empty_panel(figure)
    ax.plot([0.0, np.nan, 1.0], [0.0, 1.0, 1.0])
    with pytest.raises(AssertionError, match="is empty"):
        require_no_empty_panel(figure)
    ax.plot([0.0], [0.0], "o")
    require_no_empty_panel(figure)


def test_a_trade_off_shows_the_front_dominated_points_and_the_start():
    losses = np.array([[3.0, 1.0], [1.0, 4.0], [2.5, 3.0], [2.0, 2.0]])
    weights = np.array([[1.0, 20.0], [5.0, 2.0], [1.0, 0.0], [1.0, 2.0]])
    ax = Figure().add_subplot()
    trade = TradeOff(("far", "loud"), weights, losses, np.array([4.0, 2.0]), ())
    assert plot_trade_off(trade, ax) is ax
    lines = {line.get_label(): line.get_xydata().tolist() for line in ax.lines}
    assert lines["Pareto optimal"] == [[1.0, 4.0], [2.0, 2.0], [3.0, 1.0]]
    assert lines["dominated"] == [[2.5, 3.0]] and lines["as given"] == [[4.0, 2.0]]
    assert [text.get_text() for text in ax.texts] == ["5:1", "1:1", "1:10"]
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("loss: far", "loss: loud")


@pytest.mark.long
def test_a_plan_over_its_horizon():
    """Lines hold its numbers; grey and red follow the limits of each step, those of any kind of
    rows with one entry; what is no plan is told by its status."""
    # The limits of dq come as rows; a soft one of q holds from k = 2 on.
    states = jm.Polytope([[0, 2], [0, -1], [1, 1]], [4, 2, 9], labels=("up", "down", "both"))
    soft = jm.Soft([[1, 0]], upper=[0.5], stages=(2, 3))
    system = LinearSystem([[1, 0.1], [0, 1]], [0, 0.1], dt=0.1, state_names=("q", "dq"))
    mpc = jm.MPC(
        system, np.eye(2), np.eye(1), 3, states=states, inputs=Box([-1.0], [2.0]), soft=soft
    )
    x = np.array([[0.4, 1.0], [0.5, 1.1], [0.61, 1.3], [0.4, 1.5]])
    u = np.array([[1.0], [2.0], [2.5]])
    # Without Newton steps a program compiles fastest; what is drawn is replaced.
    plan = jm.solve(mpc, x[0], solver=jm.ADMM(20, newton_steps=0))
    plan = dataclasses.replace(plan, states=x, inputs=u, status=np.int32(jm.Status.SOLVED))
    drawn = {"reference": [0.2, 0], "input_reference": [0.7], "title": "A plan"}
    figure = plot_plan(plan, mpc, **drawn)
    q, dq, torque = figure.axes
    assert figure.get_suptitle() == "A plan"
    assert any(np.all(line.get_ydata() == 0.7) for line in torque.lines)
    np.testing.assert_allclose(q.lines[0].get_ydata(), x[:, 0])
    np.testing.assert_allclose(torque.lines[0].get_ydata(), [1, 2, 2.5, 2.5])
    # Grey regions, and their edges: below, above.
    upper = {ax: ax.patches[2].get_data() for ax in figure.axes}
    for ax in figure.axes:
        np.testing.assert_array_equal(upper[ax].values, ax.patches[3].get_data().values)
    np.testing.assert_allclose(upper[q].values, [np.nan, np.nan, 0.5, 0.5])
    np.testing.assert_allclose(upper[q].edges, [0, 0.05, 0.15, 0.25, 0.3])
    np.testing.assert_allclose(upper[dq].values, [2, 2, 2, np.nan])
    np.testing.assert_allclose(upper[torque].values, [2, 2, 2])
    np.testing.assert_allclose(upper[torque].edges, [0, 0.1, 0.2, 0.3])
    np.testing.assert_allclose(dq.patches[0].get_data().values, [-2, -2, -2, np.nan])
    np.testing.assert_allclose(q.lines[1].get_xdata(), [0.2])
    np.testing.assert_allclose(torque.lines[1].get_xdata(), [0.2, 0.3])
    require_no_empty_panel(figure)
    # Outputs of several have panels of their own, with the steps at which they hold.
    sum_of_all = jm.Outputs([[1, 1], [1, 0]], -3, 2.2, D=[[1.0], [0.0]], names=("sum", "q"),
                            units=("m", "m"), stages=(1, 2))  # fmt: skip
    *_, ax = plot_plan(plan, dataclasses.replace(mpc, outputs=sum_of_all)).axes
    assert ax.get_ylabel() == "sum [m]" and len(plot_plan(plan, mpc).axes) == 3
    np.testing.assert_allclose(ax.lines[0].get_ydata(), [np.nan, 3.6, 4.41, np.nan])
    np.testing.assert_allclose(ax.patches[2].get_data().values, [np.nan, 2.2, 2.2, np.nan])
    red = [line for line in ax.lines if line.get_color() == BROKEN]
    np.testing.assert_array_equal(red[0].get_xdata(), [0.1, 0.2])
    # Each row is one of its own: beside one of inputs, with rounding, and in any unit.
    for unit in (1.0, 1e-7):
        C, D = [[1, 5.6e-17], [0, 0]], [[0], [1]]
        soft = jm.Soft(C, upper=np.array([0.5 * unit, 9]), D=D, rho=2.0, stages=(2,))
        scaled = dataclasses.replace(plan, states=x * unit)
        changed = dataclasses.replace(mpc, states=None, outputs=(), soft=(soft,))
        ax = plot_plan(scaled, changed).axes[0]
        assert ax.patches[2].get_data().values[2] == pytest.approx(0.5 * unit)
        red = [line for line in ax.lines if line.get_color() == BROKEN]
        np.testing.assert_array_equal(red[0].get_ydata(), unit * x[2:3, 0])
    lost = dataclasses.replace(plan, status=np.int32(jm.Status.PRIMAL_INFEASIBLE))
    assert "PRIMAL_INFEASIBLE" in plot_plan(lost, mpc).get_suptitle()
    with pytest.raises(ValueError, match="plan: has states .4, 2. and inputs"):
        plot_plan(plan, dataclasses.replace(mpc, horizon=4))
