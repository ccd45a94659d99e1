"""Fixtures shared by all tests."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real logs, skies and CAD models that is not part of the repository."""
    default = Path(__file__).resolve().parents[2] / "shared" / "data"
    path = Path(os.environ.get("LIGHTSIM_DATA", default))
    if not path.is_dir():
        pytest.skip(f"needs the development data at {path} (or $LIGHTSIM_DATA)")
    return path
