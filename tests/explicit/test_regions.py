"""Critical regions: tilings, KKT residuals, laws of other solvers."""

from dataclasses import replace

import numpy as np
import problems
import pytest

import jaxmpc as jm
from jaxmpc.explicit.exact_penalties import exact_penalty
from jaxmpc.explicit.regions import critical_regions
from jaxmpc.mpc.condense import condensed_in_float64
from jaxmpc.mpc.problem import Soft
from jaxmpc.qp.status import Status


def kkt(mpc, found, count=100):
    """Largest KKT residual of the regions' plans at random states of each region."""
    c, random, worst = condensed_in_float64(mpc), np.random.default_rng(0), 0.0
    for region in found.regions[:count]:
        x = random.dirichlet(np.ones(len(region.vertices))) @ region.vertices
        z, y = region.Z @ x + region.z0, np.zeros(len(c.C))
        np.add.at(y, region.rows, region.L @ x + region.l0)
        s = c.C @ z + c.D @ x + c.d
        upper, lower = np.maximum(y, 0), np.maximum(-y, 0)
        scale = 1 + np.abs(y).max()
        worst = max(
            worst, np.abs(c.P @ z + c.F @ x + c.f + c.C.T @ y).max() / scale,
            (s - c.upper).max(), (c.lower - s).max(),
            np.abs(upper[upper > 0] * (c.upper - s)[upper > 0]).max(initial=0.0) / scale,
            np.abs(lower[lower > 0] * (s - c.lower)[lower > 0]).max(initial=0.0) / scale,
        )  # fmt: skip
    return worst


class TestRegions:
    @pytest.mark.parametrize(
        ("mpc", "count", "area"),
        [
            (problems.lecture(), 15, 1043 / 400),
            (problems.joint(20, None), 409, problems.AREA_JOINT),
            (problems.joint_o_inf(5), None, None),
            (problems.drifting(), None, None),
            (problems.double_integrator(), None, problems.C_INF_DOUBLE_INTEGRATOR),
            (problems.scalar(), None, 2.0),
            (problems.duplicated(), 15, 1043 / 400),
            (problems.apex(), None, None),
            (problems.pair(), 15 * 15, (1043 / 400) ** 2),
            (replace(problems.lecture(), input_rate_limit=0.2), None, None),
        ],
        ids=["lecture", "joint", "joint O_inf", "drifting", "double", "scalar", "duplicated",
             "apex", "pair", "rates"],
    )  # fmt: skip
    @pytest.mark.first(1)
    def test_complete(self, mpc, count, area):
        """The regions tile X_N, their number and volume are known, and their plans are optimal."""
        found = critical_regions(mpc)
        assert found.complete, found.reason
        assert count is None or len(found) == count
        if area is not None:
            assert found.volume == pytest.approx(area, rel=1e-9)
        assert kkt(mpc, found) < 1e-9
        assert str(found).startswith(f"CriticalRegions: {len(found)} regions fill X_N")

    def test_dependent_rows(self):
        """On the apexes four rows are active at once, three of them independent."""
        found = critical_regions(problems.apex())
        degenerate = [region for region in found.regions if len(region.also_active)]
        assert degenerate and all(len(region.rows) <= 3 for region in found.regions)

    @pytest.mark.slow
    def test_law(self):
        """The first input is that of the solver, at random states in and out of X_N."""
        mpc = problems.lecture()
        x = np.random.default_rng(1).uniform(-1.1, 1.1, (300, 2))
        plans = jm.solve_many(mpc, x, dtype="float64", chunk=300)
        found = critical_regions(mpc)
        solved = plans.status == Status.SOLVED
        assert 100 < solved.sum() < 250
        np.testing.assert_array_equal(found.find(x) >= 0, solved)
        np.testing.assert_allclose(found.law(x)[solved], plans.inputs[solved, 0], atol=1e-8)
        assert np.isnan(found.plan(x)[~solved]).all()
        x[:2] = np.nan, np.inf
        assert list(found.find(x[:2])) == [-1, -1]

    def test_steps_that_differ(self):
        """Dynamics, weights and limits are others at each step."""
        mpc, random = problems.lecture(0.25, 3), np.random.default_rng(0)
        each = lambda M: np.asarray(M) * random.uniform(0.9, 1.1, (3, *np.shape(M)))
        mpc = replace(
            mpc, system=jm.LinearSystem(each(mpc.system.A), each(mpc.system.B)),
            Q=np.linspace(1, 3, 3)[:, None, None] * np.asarray(mpc.Q),
            inputs=jm.Box(mpc.inputs.lower, each(mpc.inputs.upper)),
        )  # fmt: skip
        found = critical_regions(mpc)
        assert found.complete and len(found) > 5
        assert kkt(mpc, found) < 1e-9

    def test_prestabilised(self):
        """u_0 counts the prestabilising gain; the regions do not depend on it."""
        mpc = problems.unstable(6)
        plain = critical_regions(replace(mpc, prestabilise=False))
        found = critical_regions(replace(mpc, prestabilise=True))
        assert len(plain) == len(found) and found.complete
        x = np.concatenate([region.vertices.mean(axis=0)[None] for region in found.regions])
        np.testing.assert_allclose(found.law(x), plain.law(x), atol=1e-9)

    def test_limit(self):
        found = critical_regions(problems.lecture(), max_regions=4)
        assert len(found) == 4 and not found.complete and "limit of 4" in found.reason
        assert found.volume < 1043 / 400

    def test_time_limit(self):
        found = critical_regions(problems.joint(20), seconds=1e-9)
        assert not found.complete and "stopped by the time limit" in found.reason
        bound = exact_penalty(problems.joint(20), seconds=1e-9)
        assert not bound.exact and bound.rho_bar >= 0

    def test_missing_part_is_seen(self, monkeypatch):
        """Completeness rests on volumes: a search that loses its way does not say so."""
        monkeypatch.setattr("jaxmpc.explicit.regions.RegionSearch.cross", lambda *_: None)
        monkeypatch.setattr("jaxmpc.explicit.regions.REPAIRS", 1)
        found = critical_regions(problems.lecture())
        assert not found.complete and "not found" in found.reason

    def test_within(self):
        """Without state limits X_N is unbounded; a box bounds what is looked at."""
        mpc = replace(problems.lecture(), states=None, terminal_set=None)
        everywhere = critical_regions(mpc)
        assert everywhere.complete and everywhere.volume == np.inf
        found = critical_regions(mpc, within=problems.symmetric(2.0, 2.0))
        x = np.random.default_rng(0).uniform(-2, 2, (100, 2))
        np.testing.assert_allclose(everywhere.law(x), found.law(x), atol=1e-9)
        assert found.complete and found.volume == pytest.approx(16.0)
        assert kkt(mpc, found) < 1e-9

    def test_errors(self):
        mpc = problems.lecture()
        nowhere = jm.Box(np.array([5.0, 5.0]), np.array([6.0, 6.0]))
        point = jm.Box(np.array([0.5, 0.0]), np.array([0.5, 0.0]))
        for changed, message in [
            (replace(mpc, terminal_set=nowhere), "empty"),
            (
                replace(mpc, states=point),
                r"^problem: .* one value of the parameters, \[ *0.5",
            ),
            (replace(mpc, terminal_set=jm.Ellipsoid(np.eye(2), 0.5)), "ellipsoid"),
            (replace(mpc, soft=(Soft(np.eye(2), upper=np.ones(2)),)), "soft"),
        ]:
            with pytest.raises(ValueError, match=message):
                critical_regions(changed)
        for limit in (0, 1.5, True):
            with pytest.raises(ValueError, match="max_regions"):
                critical_regions(mpc, max_regions=limit)
        with pytest.raises(ValueError, match="within"):
            critical_regions(mpc, within=np.ones(2))
        with pytest.raises(ValueError, match="x0s: shape"):
            critical_regions(mpc).law(np.zeros(3))

    def test_one_state_is_as_good_as_many(self):
        """Numbers and vectors at θ (p,), each that of the batch; nowhere counts too."""
        found = critical_regions(problems.lecture(0.25, 2))
        x0s = np.array([[0.3, -0.2], [0.9, 0.1], [5.0, 5.0]])
        for ask in (found.find, found.law, found.plan, found.value):
            many = ask(x0s)
            for x0, one in zip(x0s, many, strict=True):
                assert np.shape(ask(x0)) == np.shape(one)
                np.testing.assert_allclose(ask(x0), one, rtol=1e-14)
        assert found.law(x0s[0]).shape == (1,) and found.find(x0s[2]) == -1
