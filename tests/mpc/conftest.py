"""What tests of plans share."""

import pytest

from jaxmpc.qp import jax_transformations


@pytest.fixture(scope="module")
def as_of_many():
    """A program of 64 states does as one of more does: a few steps of all of them, in blocks, go
    first. It compiles in less time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(jax_transformations, "BLOCK", 32)
        yield
