"""Memory that a compiled program needs, and memory that the device has."""

import os
from typing import Any

import jax


def program_bytes(program: Any) -> float:
    """Return the bytes that a compiled program needs for temporaries and output, on each device."""
    found = program.memory_analysis()
    return 0.0 if found is None else found.temp_size_in_bytes + found.output_size_in_bytes


def device_bytes() -> float:
    """Return the bytes of memory of the present device; on a CPU, of the machine."""
    found = jax.local_devices()[0].memory_stats()
    if found and "bytes_limit" in found:
        return found["bytes_limit"]
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
