"""The law at given states: affine pieces, plans from regions, nearest points."""

from dataclasses import replace

import numpy as np
import problems
import pytest

import jaxmpc as jm
from jaxmpc.explicit.law_at_states import Law, RegionLaw
from jaxmpc.explicit.regions import critical_regions
from jaxmpc.feasible.plan_polytope import CenteredPolytope
from jaxmpc.mpc.problem import Soft


class TestLaw:
    """The affine pieces and the projection that the ascent uses."""

    @pytest.mark.parametrize(
        "soft",
        [
            (),
            pytest.param(
                (Soft([[0.0, 1.0]], upper=[0.2], rho=2.0, quadratic=0.5),), marks=pytest.mark.slow
            ),
        ],
    )
    @pytest.mark.slow
    def test_piece_predicts_the_plan_beside(self, soft):
        mpc = replace(problems.lecture(0.25, 3), soft=soft)
        random = np.random.default_rng(0)
        affine = Law(mpc, np.zeros(2), 1024)
        x = random.uniform(-1, 1, (100, 2)) * [0.9, 0.5]
        plans = affine.plans(x)
        pieces = [affine.piece(*pair) for pair in zip(x, plans.inputs, strict=True)]
        beside = x + 1e-4 * random.standard_normal(x.shape)
        after = affine.following(beside, affine.plans(beside).inputs[:, 0])
        compared = 0
        for piece, here, there in zip(pieces, beside, after, strict=True):
            if piece is not None and np.all(piece.R @ here <= piece.r):
                np.testing.assert_allclose(piece.E @ here + piece.e, there, atol=1e-7)
                compared += 1
        assert compared > 60

    def test_plans_from_regions(self):
        """They are those of another solver, optimal to rounding; outside of X_N there is none."""
        mpc = problems.drifting()
        law = RegionLaw(critical_regions(mpc), np.zeros(2), 64)
        corners = np.concatenate([region.vertices for region in law.regions.regions])
        states = np.random.default_rng(0).dirichlet(np.ones(len(corners)), 40) @ corners
        plans = law.plans(np.vstack([states, [[9.0, 9.0]]]))
        expected = [problems.least_distance(mpc, x) for x in states]
        np.testing.assert_allclose(plans.inputs[:-1], expected, atol=1e-8)
        assert np.all(plans.status[:-1] == jm.Status.SOLVED)
        assert max(plans.primal_residual[:-1].max(), plans.dual_residual[:-1].max()) < 1e-9
        assert plans.status[-1] != jm.Status.SOLVED and np.isnan(plans.inputs[-1]).all()

    def test_nearest_point_of_a_polytope(self):
        square = CenteredPolytope(
            np.zeros(2), np.vstack([np.eye(2), -np.eye(2)]), np.ones(4), np.zeros((0, 2))
        )
        points = np.array([[3.0, 0.5], [2.0, -5.0], [0.2, 0.3]])
        near = [[1.0, 0.5], [1.0, -1.0], [0.2, 0.3]]
        np.testing.assert_allclose(square.nearest(points), near, atol=1e-12)
        np.testing.assert_allclose(square.beyond(points), [2.0, 4.0, -0.7], atol=1e-12)
        np.testing.assert_array_equal(square.depths, np.ones(4))
        # In other units of one coordinate the same facets are as far away.
        unit = np.array([1.0, 1e-7])
        thin = CenteredPolytope(np.zeros(2), square.normals, np.tile(unit, 2), np.zeros((0, 2)))
        np.testing.assert_allclose(thin.beyond(points * unit), [2.0, 4.0, -0.7], atol=1e-12)
        np.testing.assert_allclose(thin.nearest(points * unit) / unit, near, atol=1e-12)
