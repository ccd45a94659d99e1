"""Blender's Cycles as a reference renderer (paper, Sec. 4), in a separate process.

The module bpy requires one exact version of Python and a NumPy before 2.0, which LightSim cannot
use. `cycles_worker.py` therefore runs in another interpreter.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import weakref
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
from jaxtyping import Float32

from lightsim.core.camera import PinholeCamera
from lightsim.core.dome import Sun, split_sun
from lightsim.core.frames import RigidTransform
from lightsim.core.mesh import TriMesh
from lightsim.core.sensors import CameraFrame
from lightsim.errors import LightSimError, MissingDependencyError
from lightsim.render.gbuffers import camera_pose
from lightsim.render.reference.corner_mesh import corner_mesh
from lightsim.render.reference.renderer import SEED_STEP, Picture, Shot
from lightsim.render.scene import FrameScene, StaticScene

PYTHON_VARIABLE = "LIGHTSIM_BLENDER_PYTHON"
_REMEDY = (
    "bpy and LightSim require different versions of NumPy: make a virtual environment of Python "
    "3.11 for Blender, run `pip install 'bpy==4.5.*'` in it, and give its interpreter in "
    f"{PYTHON_VARIABLE} or --blender-python."
)


def find_bpy(python: str | Path | None = None) -> str:
    """Return the interpreter that has bpy, without importing bpy, which takes seconds.

    Args:
        python: see `Cycles`.

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


class Cycles:
    """Reference renderer by Cycles on the CPU. A rolling shutter is rendered at its middle row.

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
        self._static: StaticScene | None = None
        self._scene: FrameScene | None = None
        self._ask({"do": "start"})

    @property
    def pid(self) -> int:
        """Process id of Blender, for measurements of its cost."""
        return self._process.pid

    def close(self) -> None:
        """End the process; this also happens when the object is released."""
        self._end()

    def shoot(
        self,
        scene: FrameScene,
        camera: PinholeCamera,
        view: CameraFrame | RigidTransform,
        shots: Sequence[Shot],
        seed: int,
    ) -> list[Picture]:
        """Return linear radiance of each shot; see `renderer.ReferenceTracer.shoot`.

        Raises:
            FrameMismatchError: the pose does not map `camera` to `world`.
            LightSimError: Blender failed.
        """
        pose = camera_pose(view)
        self._load(scene)
        out = Path(self._folder.name) / "picture.npy"
        images = []
        for number, shot in enumerate(shots):
            request = _camera_request(camera, pose) | self._light_request(shot)
            request |= {
                "do": "shot",
                "out": str(out),
                "samples": shot.samples,
                "bounces": shot.bounces,
                "surfaces": shot.surfaces,
                "is_antialiased": shot.is_antialiased,
                "seed": (seed + SEED_STEP * number) % (1 << 31),
            }
            self._ask(request)
            # Files, because pictures through a pipe would have to be encoded in JSON.
            images.append(np.load(out))
        return images

    def _load(self, scene: FrameScene) -> None:
        """Send the meshes that have changed since the last call."""
        static = scene.static
        # By identity: the static scene is one object for all frames of a log.
        if static is not self._static:
            self._ask({"do": "remove", "prefix": ""})
            for k, (mesh, normals) in enumerate(zip(static.meshes, static.normals, strict=True)):
                self._add(f"static{k}", mesh, normals, k < len(static.camera_meshes))
            self._static, self._scene = static, None
        if scene is not self._scene:
            self._ask({"do": "remove", "prefix": "actor"})
            for k, (mesh, normals) in enumerate(
                zip(scene.actors, scene.actor_normals, strict=True)
            ):
                self._add(f"actor{k}", mesh, normals, True)
            self._scene = scene

    def _add(
        self, name: str, mesh: TriMesh, normals: Float32[np.ndarray, "_ 3"], is_visible: bool
    ) -> None:
        if len(mesh.faces) == 0:
            return
        path = Path(self._folder.name) / "mesh.npz"
        # A mesh without texture has no array for it.
        arrays = vars(corner_mesh(mesh, normals)).items()
        np.savez(path, **{key: array for key, array in arrays if array is not None})
        self._ask({"do": "mesh", "name": name, "path": str(path), "is_visible": is_visible})

    def _light_request(self, shot: Shot) -> dict[str, Any]:
        # The sun is a lamp of its own: in the dome it would be a few bright texels, and noisy.
        rest, sun = split_sun(shot.dome)
        path = Path(self._folder.name) / "sky.npz"
        light = rest if shot.has_sky else np.zeros_like(rest)
        np.savez(path, light=light, seen=shot.dome.radiance)
        return {"sky": str(path), "sun": _sun_request(sun) if shot.has_sun else None}

    def _ask(self, request: dict[str, Any]) -> None:
        """Send one request and wait until it is done.

        Raises:
            LightSimError: the request failed, or the process ended.
        """
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        try:
            self._process.stdin.write(json.dumps(request) + "\n")
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
                got=" ".join(f"{reply['error']} {self._last_words()}".split()),
                remedy="Check its bpy (4.5) and the free memory, or choose another --renderer.",
            )

    def _last_words(self) -> str:
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


def _camera_request(camera: PinholeCamera, pose: RigidTransform) -> dict[str, Any]:
    return {
        "size_px": [camera.width_px, camera.height_px],
        "intrinsics_px": [camera.fx, camera.fy, camera.cx, camera.cy],
        "world_from_camera": pose.matrix.tolist(),
    }


def _sun_request(sun: Sun | None) -> dict[str, Any] | None:
    if sun is None:
        return None
    return {
        "direction": sun.direction_world.tolist(),
        "irradiance": sun.irradiance.tolist(),
        "angular_radius_deg": sun.angular_radius_deg,
    }
