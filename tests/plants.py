"""Linear systems of tests of sets, invariance and Riccati equations."""

import numpy as np

from jaxmpc import LinearSystem

# A robot joint (inertia 0.05, 10 ms), with the weights of an LQR, and the double integrator of
# MPT3's test suite.
JOINT = LinearSystem(np.array([[1, 0.01], [0, 1]]), np.array([[0], [0.2]]), dt=0.01)
JOINT_LQR = (JOINT, np.diag([50.0, 1.0]), np.array([[0.1]]))
DOUBLE = LinearSystem([[1, 1], [0, 1]], [[1], [0.5]], dt=1.0)
UNSTABLE = LinearSystem([[2.0]], [[1.0]])
