"""First floor: linear systems, convex sets, linear-quadratic control, invariant sets.

Conventions, once for the whole floor: x+ = A x + B u + c, and feedback u = K x.
Sets describe themselves in the coordinates (and units) of the system they constrain.
"""
