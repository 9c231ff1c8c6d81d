"""Linear systems: construction, sampling, reading other objects, errors."""

import math
from dataclasses import replace
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy
from plants import DOUBLE, JOINT
from polytopes import cube

from jaxmpc import Box, LinearSystem
from jaxmpc.systems.riccati import LQR

INF = np.inf


def test_system_takes_lists_and_resolves_labels():
    system = LinearSystem([[1, 0.1], [0, 1]], [[0], [1]], dt=0.1)
    system.validate()
    assert (system.n, system.m, system.dt, system.c) == (2, 1, 0.1, None)
    assert system.state_labels == ("x1", "x2") and system.input_labels == ("u1",)
    named = replace(
        system,
        state_names=("q", "dq"),
        state_units=("rad", ""),
        input_names=("torque",),
        input_units=("N m",),
    )
    named.validate()
    assert named.state_labels == ("q [rad]", "dq") and named.input_labels == ("torque [N m]",)
    assert replace(system, state_units=("m", "m/s")).state_labels == ("x1 [m]", "x2 [m/s]")


def test_objects_are_pytrees_with_any_leaves():
    axes = LinearSystem(A=0, B=None, c=object(), dt=0.1)
    assert jax.tree.map(lambda leaf: leaf, axes).dt == 0.1
    for instance in (JOINT, Box([0.0], [1.0]), cube(2), LQR(K=np.eye(1), P=np.eye(1))):
        leaves, tree = jax.tree.flatten(instance)
        assert type(jax.tree.unflatten(tree, [object()] * len(leaves))) is type(instance)
    batch = replace(JOINT, A=np.stack([JOINT.A, 2 * JOINT.A]))
    step = jax.jit(jax.vmap(lambda s: s.A @ jnp.ones(s.n), in_axes=(replace(JOINT, A=0, B=None),)))
    assert step(batch).shape == (2, 2)
    jax.jit(lambda s: s.validate() or s.A)(JOINT)  # shapes are checked while tracing
    assert jax.jit(lambda s: s.validate() or jnp.asarray(s.A))(DOUBLE).shape == (2, 2)
    with pytest.raises(ValueError, match="B: shape"):
        jax.jit(lambda s: s.validate())(replace(JOINT, B=np.ones((3, 1))))


def test_from_continuous_double_integrator_and_drift():
    h = 0.3
    system = LinearSystem.from_continuous(
        [[0, 1], [0, 0]], [[0], [2]], h, c=[0, -9.81], state_names=["q", "dq"]
    )
    np.testing.assert_allclose(system.A, [[1, h], [0, 1]], atol=1e-15)
    np.testing.assert_allclose(system.B, [[h**2], [2 * h]], atol=1e-15)
    np.testing.assert_allclose(system.c, [-9.81 * h**2 / 2, -9.81 * h], atol=1e-15)
    assert system.dt == h and system.state_names == ("q", "dq")
    a, b = -3.0, 2.0
    scalar = LinearSystem.from_continuous([[a]], [[b]], h)
    np.testing.assert_allclose(scalar.A, [[math.exp(a * h)]], rtol=1e-15)
    np.testing.assert_allclose(scalar.B, [[b * math.expm1(a * h) / a]], rtol=1e-14)
    assert scalar.c is None


def test_from_object_reads_scipy():
    A, B, C, D = [[0.0, 1], [-2, -3]], [[0.0], [1]], [[1.0, 0]], [[0.0]]
    continuous = scipy.signal.StateSpace(A, B, C, D)
    expected = continuous.to_discrete(0.1)
    system = LinearSystem.from_object(continuous, dt=0.1)
    np.testing.assert_allclose(system.A, expected.A, atol=1e-14)
    np.testing.assert_allclose(system.B, expected.B, atol=1e-14)
    assert system.dt == 0.1
    with pytest.raises(ValueError, match="dt: is missing and obj is continuous"):
        LinearSystem.from_object(continuous)
    assert LinearSystem.from_object(expected).dt == 0.1
    assert LinearSystem.from_object(scipy.signal.StateSpace(A, B, C, D, dt=True)).dt is None
    with pytest.raises(ValueError, match=r"obj: has no \.A"):
        LinearSystem.from_object(scipy.signal.TransferFunction([1], [1, 1]), dt=0.1)


def test_from_object_reads_python_control_and_itself():
    A, B = np.array([[0.0, 1], [0, 0]]), np.array([[0.0], [1]])
    labels = {"state_labels": ["q", "dq"], "input_labels": ["F"], "output_labels": ["q"]}
    fake = lambda dt: SimpleNamespace(A=A, B=B, dt=dt, **labels)
    sampled = LinearSystem.from_object(fake(0), dt=0.5)
    np.testing.assert_allclose(sampled.B, [[0.125], [0.5]], atol=1e-15)
    assert sampled.state_labels == ("q", "dq") and sampled.input_labels == ("F",)
    assert LinearSystem.from_object(fake(True)).dt is None
    assert LinearSystem.from_object(fake(True), dt=0.2).dt == 0.2
    assert LinearSystem.from_object(fake(0.2), dt=0.2).dt == 0.2
    for dt, given, message in [
        (0, None, "dt: is missing"),
        (0, -1.0, "dt: -1.0 is not a positive"),
        (0.2, 0.1, "differs from obj.dt"),
        (None, 0.1, "does not say whether"),
        (-0.1, None, "dt: -0.1 is not"),
    ]:
        with pytest.raises(ValueError, match=message):
            LinearSystem.from_object(fake(dt), dt=given)
    drifting = replace(JOINT, c=np.ones(2), dt=None)
    again = LinearSystem.from_object(drifting, dt=0.01)
    assert again.dt == 0.01 and again.c is drifting.c
    with pytest.raises(ValueError, match="dt: 0 is not a positive"):
        LinearSystem.from_object(replace(JOINT, dt=0), dt=0.01)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"A": np.ones((2, 3))}, "A: shape"),
        ({"A": np.ones(2)}, "A: shape"),
        ({"A": [[1, 2], [3]]}, "A: .* is not an array"),
        ({"A": [["a", "b"], ["c", "d"]]}, "A: entries of type <U1 where real"),
        ({"A": [[1, np.nan], [0, 1]]}, "A: holds NaN"),
        ({"A": 1j * np.eye(2)}, "A: entries of type complex128 where real"),
        ({"B": np.ones((3, 1))}, "B: shape"),
        ({"B": np.ones(3)}, "B: shape"),
        ({"B": [[INF], [0]]}, "B: holds"),
        ({"c": np.ones((2, 1))}, "c: shape"),
        ({"c": [0, np.nan]}, "c: holds"),
        ({"dt": 0.0}, "dt: 0.0"),
        ({"dt": True}, "dt: True"),
        ({"dt": "1"}, "dt: '1'"),
        ({"dt": INF}, "dt: inf"),
        ({"state_names": ("q",)}, "state_names: 1 entries where 2"),
        ({"input_units": ("N", "m")}, "input_units: 2 entries where 1"),
        ({"input_names": ["F"]}, "input_names: .* tuple"),
    ],
)
def test_system_errors(changes, message):
    with pytest.raises(ValueError, match=message):
        replace(JOINT, **changes).validate()


def test_from_continuous_errors():
    with pytest.raises(ValueError, match="dt: 0 is not a positive"):
        LinearSystem.from_continuous([[0]], [[1]], 0)
    with pytest.raises(ValueError, match="B: shape"):
        LinearSystem.from_continuous([[0]], [[1], [1]], 0.1)


def test_a_delay_of_the_input_is_no_keyword_and_its_cure_is_exact():
    A, B, dt, delay = np.array([[0, 1], [-2, -0.3]]), np.array([[0.0], [1]]), 0.1, 0.03
    with pytest.raises(ValueError, match=r"delay: is no argument .*B − B0"):
        LinearSystem.from_continuous(A, B, dt, delay=delay)
    with pytest.raises(ValueError, match="state_name: is no argument .* Did you mean state_names"):
        LinearSystem.from_continuous(A, B, dt, state_name=("q", "dq"))
    whole = LinearSystem.from_continuous(A, B, dt)
    rest = LinearSystem.from_continuous(A, B, dt - delay)
    first = LinearSystem.from_continuous(A, B, delay)
    system = LinearSystem(
        np.block([[whole.A, whole.B - rest.B], [np.zeros((1, 3))]]), np.vstack([rest.B, np.eye(1)])
    )
    x, before, u = np.array([0.3, -1.0]), np.array([0.7]), np.array([-0.4])
    between = first.A @ x + first.B @ before  # the old input for the delay, then the new one
    after = system.A @ np.append(x, before) + system.B @ u
    assert after == pytest.approx(np.append(rest.A @ between + rest.B @ u, u), abs=1e-15)


def test_whole_numbers_are_numbers():
    """Not the type in which the step is computed."""
    system = LinearSystem([[1.0, 0.1], [0.0, 0.9]], [[0.005], [0.1]], [0.25, 0.25])
    expected = [3.4525, 2.1]
    for x in ([3, 2], np.array([3, 2]), np.array([3, 2], np.int8)):
        np.testing.assert_allclose(system.step(x, [0.5]), expected, rtol=1e-6)
