"""Light3R-SfM: feed-forward Structure-from-Motion.

The two functions below load torch when they are first touched, so that ``l3r --help`` is quick.
"""

from typing import TYPE_CHECKING, Any

from l3r.version import __version__

if TYPE_CHECKING:
    from l3r.inference.checkpoint import load_model
    from l3r.inference.reconstruct import reconstruct

__all__ = ["__version__", "load_model", "reconstruct"]


def __getattr__(name: str) -> Any:
    """Import the public functions on first use."""
    if name == "load_model":
        from l3r.inference.checkpoint import load_model

        return load_model
    if name == "reconstruct":
        from l3r.inference.reconstruct import reconstruct

        return reconstruct
    raise AttributeError(f"module 'l3r' has no attribute '{name}'")
