"""Bounds of linear programs."""

import numpy as np
import pytest

from jaxmpc.sets import lp


def test_bound_is_valid_for_inexact_multipliers():
    rows = np.vstack([np.eye(2), -np.eye(2)])
    d, g = np.array([1.0, 2.0]), np.ones(4)
    top = lp.maximise(d, rows, g)
    assert top.value == pytest.approx(3, abs=1e-12)
    random = np.random.default_rng(0)
    for size in (0.0, 1e-12, 1e-3, 1.0):
        y = np.abs(top.y + size * random.standard_normal(4))
        above = lp.bound(d, y, rows, g, np.ones(2))
        assert 3 - 1e-15 <= above <= 3 + 10 * size + 1e-12
