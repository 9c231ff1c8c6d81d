"""Prove what a stored map says once more, by code that shares nothing with what made the map.

verify_map    prove the labels of a stored map again -> Verification
"""

from jaxmpc.names import suggest_names
from jaxmpc.verify.stored_map import Verification, verify_map

__all__ = [
    "Verification",
    "verify_map",
]

suggest_names(__name__)
