"""Blender's Cycles as a reference renderer (paper, Sec. 4), in a separate process."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from lightsim.core.camera import PinholeCamera
from lightsim.core.dome import split_sun
from lightsim.core.frames import RigidTransform
from lightsim.core.mesh import TriMesh
from lightsim.core.sensors import CameraFrame
from lightsim.render.gbuffers import camera_pose
from lightsim.render.reference.blender import Blender, camera_request, sun_request
from lightsim.render.reference.corner_mesh import corner_mesh
from lightsim.render.reference.renderer import SEED_STEP, Picture, Shot
from lightsim.render.scene import FrameScene, StaticScene


class Cycles:
    """Reference renderer by Cycles on the CPU. A rolling shutter is rendered at its middle row.

    Args:
        python: see `blender.Blender`.

    Raises:
        MissingDependencyError: that interpreter has no bpy.
    """

    def __init__(self, python: str | Path | None = None) -> None:
        self._blender = Blender(python)
        self._static: StaticScene | None = None
        self._scene: FrameScene | None = None

    @property
    def pid(self) -> int:
        """Process id of Blender, for measurements of its cost."""
        return self._blender.pid

    def close(self) -> None:
        """End the process; this also happens when the object is released."""
        self._blender.close()

    def render_shots(
        self,
        scene: FrameScene,
        camera: PinholeCamera,
        view: CameraFrame | RigidTransform,
        shots: Sequence[Shot],
        seed: int,
    ) -> list[Picture]:
        """Return linear radiance of each shot; see `renderer.ReferenceTracer.render_shots`.

        Raises:
            FrameMismatchError: the pose does not map `camera` to `world`.
            LightSimError: Blender failed.
        """
        pose = camera_pose(view)
        self._load(scene)
        images = []
        for number, shot in enumerate(shots):
            request = camera_request(camera, pose) | self._light_request(shot)
            request |= {
                "samples": shot.samples,
                "bounces": shot.bounces,
                "surfaces": shot.surfaces,
                "is_antialiased": shot.is_antialiased,
                "seed": (seed + SEED_STEP * number) % (1 << 31),
            }
            images.append(self._blender.render(request))
        return images

    def _load(self, scene: FrameScene) -> None:
        """Send the meshes that have changed since the last call."""
        static = scene.static
        # By identity: the static scene is one object for all frames of a log.
        if static is not self._static:
            self._blender.request({"do": "remove", "prefix": ""})
            for k, (mesh, normals) in enumerate(zip(static.meshes, static.normals, strict=True)):
                self._add(f"static{k}", mesh, normals, k < len(static.camera_meshes))
            self._static, self._scene = static, None
        if scene is not self._scene:
            self._blender.request({"do": "remove", "prefix": "actor"})
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
        # A mesh without texture has no array for it.
        arrays = vars(corner_mesh(mesh, normals)).items()
        path = self._blender.write("mesh", {k: array for k, array in arrays if array is not None})
        self._blender.request({"do": "mesh", "name": name, "path": path, "is_visible": is_visible})

    def _light_request(self, shot: Shot) -> dict[str, Any]:
        # The sun is a separate lamp: in the dome it would be a few bright texels, and noisy.
        rest, sun = split_sun(shot.dome)
        light = rest if shot.has_sky else np.zeros_like(rest)
        path = self._blender.write("sky", {"light": light, "seen": shot.dome.radiance})
        return {"sky": path, "sun": sun_request(sun) if shot.has_sun else None}
