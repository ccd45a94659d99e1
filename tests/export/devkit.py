"""The environment with the devkits of other data sets, which need NumPy 1."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path
from typing import Any

import pytest

_DEFAULT = Path(__file__).resolve().parents[2] / ".venv-devkit" / "bin" / "python"


def devkit_python() -> Path:
    """The interpreter; the test is skipped if there is none."""
    path = Path(os.environ.get("LIGHTSIM_DEVKIT_PYTHON", _DEFAULT))
    if not path.is_file():
        pytest.skip(
            f"needs nuscenes-devkit at {path} (or $LIGHTSIM_DEVKIT_PYTHON); .ci/run installs it"
        )
    return path


def probed(script: str, out: Path, *words: str) -> Any:
    """What a script of this folder writes to `out`, its last argument."""
    path = Path(__file__).with_name(script)
    command = [str(devkit_python()), "-W", "ignore", str(path), *words, str(out)]
    environment = {**os.environ, "MPLBACKEND": "Agg"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(out.read_text())
