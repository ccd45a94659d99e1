"""Blender's module bpy in a separate process.

The module requires one exact version of Python and a NumPy before 2.0, which LightSim cannot use.
`cycles_worker.py` therefore runs in another interpreter.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import weakref
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
from jaxtyping import Shaped

from lightsim.core.camera import PinholeCamera
from lightsim.core.dome import Sun
from lightsim.core.frames import RigidTransform
from lightsim.errors import LightSimError, MissingDependencyError

PYTHON_VARIABLE = "LIGHTSIM_BLENDER_PYTHON"
_REMEDY = (
    "bpy and LightSim require different versions of NumPy: make a virtual environment of Python "
    "3.11 for Blender, run `pip install 'bpy==4.5.*'` in it, and give its interpreter in "
    f"{PYTHON_VARIABLE} or --blender-python."
)


def find_bpy(python: str | Path | None = None) -> str:
    """Return the interpreter that has bpy, without importing bpy, which takes seconds.

    Args:
        python: see `Blender`.

    Raises:
        MissingDependencyError: it cannot be run, or has no bpy.
    """
    chosen = str(python or os.environ.get(PYTHON_VARIABLE) or sys.executable)
    probe = "import importlib.util, sys; sys.exit(importlib.util.find_spec('bpy') is None)"
    try:
        found = subprocess.run([chosen, "-c", probe], env=_clean_environment(), check=False)
    except OSError as error:
        raise MissingDependencyError(
            "the interpreter for Blender cannot be run", where=chosen, remedy=_REMEDY
        ) from error
    if found.returncode:
        raise MissingDependencyError("Cycles needs the package 'bpy'", where=chosen, remedy=_REMEDY)
    return chosen


class Blender:
    """Process with one Blender scene, which requests modify and render.

    Args:
        python: an interpreter that has bpy; None: the one in the environment variable
            LIGHTSIM_BLENDER_PYTHON, else the running one.

    Raises:
        MissingDependencyError: that interpreter has no bpy.
    """

    def __init__(self, python: str | Path | None = None) -> None:
        self.python = find_bpy(python)
        self._folder = tempfile.TemporaryDirectory(prefix="lightsim-cycles-")
        self._noise: IO[bytes] = (Path(self._folder.name) / "blender.log").open("w+b")
        self._process = subprocess.Popen(
            # -P: otherwise this folder's cycles.py would shadow Blender's module `cycles`.
            [self.python, "-P", str(Path(__file__).with_name("cycles_worker.py"))],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._noise,
            env=_clean_environment(),
            text=True,
        )
        # Blender ends with this object even if `close` is never called.
        self._end = weakref.finalize(self, _end, self._process, self._noise, self._folder)
        self.version: str = self.request({"do": "start"})["version"]
        """Version of Blender."""

    @property
    def pid(self) -> int:
        """Process id of Blender, for measurements of its cost."""
        return self._process.pid

    def close(self) -> None:
        """End the process; this also happens when the object is released."""
        self._end()

    def write(self, name: str, arrays: Mapping[str, Shaped[np.ndarray, "..."]]) -> str:
        """Write arrays to a file for the next request and return its path.

        Files, because arrays through a pipe would have to be encoded in JSON.
        """
        path = Path(self._folder.name) / f"{name}.npz"
        np.savez(path, allow_pickle=False, **arrays)
        return str(path)

    def render(self, request: Mapping[str, Any]) -> Shaped[np.ndarray, "h w 3"]:
        """Render a request `shot` and return its linear radiance."""
        out = Path(self._folder.name) / "picture.npy"
        self.request({"do": "shot", "out": str(out), **request})
        return np.load(out)

    def request(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """Send one request, wait until it is done and return the reply.

        Raises:
            LightSimError: the request failed, or the process ended.
        """
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        try:
            self._process.stdin.write(json.dumps(dict(request)) + "\n")
            self._process.stdin.flush()
            line = self._process.stdout.readline()
        except BrokenPipeError:
            # A crash of Blender, often for lack of memory.
            line = ""
        reply = json.loads(line) if line else {"error": "the process ended", "trace": ""}
        if "error" in reply:
            raise LightSimError(
                "Blender failed",
                where=f"{self.python}, at '{request['do']}'",
                got=" ".join(f"{reply['error']} {self._last_output()}".split()),
                remedy="Check its bpy (4.5) and the free memory, or choose another --renderer.",
            )
        return reply

    def _last_output(self) -> str:
        """Return the end of Blender's output."""
        self._noise.flush()
        self._noise.seek(0)
        # The end has Blender's own error message.
        return self._noise.read().decode(errors="replace")[-800:]


def _end(
    process: subprocess.Popen[str], noise: IO[bytes], folder: tempfile.TemporaryDirectory[str]
) -> None:
    """End Blender by closing its pipes, which ends its loop over requests."""
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            pipe.close()
    process.wait()
    noise.close()
    folder.cleanup()


def _clean_environment() -> dict[str, str]:
    """Return the environment without the variables that would expose this interpreter's
    packages."""
    # These variables would make Blender's Python import this environment's NumPy.
    hidden = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")
    return {key: value for key, value in os.environ.items() if key not in hidden}


def camera_request(camera: PinholeCamera, pose: RigidTransform) -> dict[str, Any]:
    """Return the part of a request `shot` that describes the camera."""
    return {
        "size_px": [camera.width_px, camera.height_px],
        "intrinsics_px": [camera.fx, camera.fy, camera.cx, camera.cy],
        "world_from_camera": pose.matrix.tolist(),
    }


def sun_request(sun: Sun | None) -> dict[str, Any] | None:
    """Return the part of a request `shot` that describes the sun."""
    if sun is None:
        return None
    return {
        "direction": sun.direction_world.tolist(),
        "irradiance": sun.irradiance.tolist(),
        "angular_radius_deg": sun.angular_radius_deg,
    }
