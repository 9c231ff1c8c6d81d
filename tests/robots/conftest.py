"""What tests of robots share."""

import pytest

from jaxmpc.robots import mjx_gaps


@pytest.fixture
def uncompared(request, monkeypatch):
    """Load robots without the comparison of their steps with the C engine's, for which a program is
    compiled each time. `test_file_comparison.py` asks for it, and slow tests have it everywhere."""
    if request.node.get_closest_marker("slow") is None:
        monkeypatch.setattr(mjx_gaps, "_differences", lambda *args: ())
