"""Prove what a stored map says once more, by code that shares nothing with what made the map.

verify_map    prove the labels of a stored map again -> Verification
"""

from jaxmpc.verify.stored_map import verify_map

__all__ = ["verify_map"]
