"""Shared fixtures; more stand beside the tests that use them."""

import os
import signal
from pathlib import Path

import pytest
from hypothesis import settings

settings.register_profile("house", max_examples=50, deadline=None)
settings.load_profile("house")

# A shell that runs the tests in the background has them ignore Ctrl-C, which some of them send.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

SHARED = Path(__file__).resolve().parents[1].parent / "shared"


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder of recorded fixtures and real data, which is not part of the project."""
    if not SHARED.is_dir():
        pytest.skip(f"no recorded fixtures and real data at {os.path.relpath(SHARED)}")
    return SHARED
