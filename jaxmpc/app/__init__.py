"""The command `jaxmpc`, with its options and problem files, and `jm.app.plots`, which is imported
when it is first used."""

from typing import Any

from jaxmpc.names import imported, raise_absent

__all__ = ["plots"]


def __getattr__(name: str) -> Any:
    """Import the plots, and Matplotlib, when they are first used."""
    return imported(f"{__name__}.plots") if name == "plots" else raise_absent(__name__, name)
