"""Path tracing of the street with Blender's Cycles, in a separate process."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from lightsim.core.camera import PinholeCamera
from lightsim.core.dome import Sun
from lightsim.core.frames import RigidTransform
from lightsim.render.reference.blender import Blender, camera_request, sun_request
from lightsim_lab.synthetic.guides import Guides
from lightsim_lab.synthetic.shapes import Part
from lightsim_lab.synthetic.textures import Finish
from lightsim_lab.synthetic.tracing import BOUNCES, Placed, traced

# Weight of Blender's coat at clearcoat 1: Burley's clearcoat has a quarter of the reflectance of
# Blender's coat, a physical layer of lacquer.
_COAT_WEIGHT = 0.25
# Roughness of the coat: its square, 0.006, is the width of the lobe of Mitsuba's `clearcoat_gloss`
# 0.95.
_COAT_ROUGHNESS = 0.08
# Seeds of Blender are below this number.
_SEEDS = 1 << 31


class CyclesTracer:
    """Path-traced scene under one sky, with Blender's Principled BSDF.

    Args:
        background: static parts, frame `world`.
        actors: parts of each actor, in its own frame.
        sky: radiance of the sky without its sun, frame `world` (CONVENTIONS: Sky domes).
        python: interpreter that has bpy (`lightsim.render.reference.blender.Blender`).

    Raises:
        MissingDependencyError: that interpreter has no bpy.
    """

    variant = "cycles"

    def __init__(
        self,
        background: Sequence[Part],
        actors: Sequence[Placed],
        finishes: Mapping[str, Finish],
        sky: Float32[np.ndarray, "h w 3"],
        sun: Sun | None,
        python: Path | None = None,
    ) -> None:
        self._blender = Blender(python)
        self._actors = {placed.key: placed.parts for placed in actors}
        self._last: dict[str, bytes] = {}
        named = {f"static{i}": part for i, part in enumerate(background)}
        named |= {f"{p.key}_{j}": part for p in actors for j, part in enumerate(p.parts)}
        for name in dict.fromkeys(part.material for part in named.values()):
            self._add_finish(name, finishes[name])
        for name, part in named.items():
            self._add_part(name, part, finishes[part.material])
        path = self._blender.write("sky", {"light": sky, "seen": sky})
        lamp = sun_request(sun)
        # Sent only with the first image: loading a sky takes longer than a small image.
        self._light: dict[str, Any] = {"sky": path, "sun": lamp and {**lamp, "has_disc": True}}

    def place(self, world_from_actors: Mapping[str, RigidTransform]) -> None:
        """Set the poses of the named actors."""
        for key, pose in world_from_actors.items():
            if self._last.get(key) == pose.matrix.tobytes():
                continue
            self._last[key] = pose.matrix.tobytes()
            matrix = pose.matrix.tolist()
            for j in range(len(self._actors[key])):
                request = {"do": "place", "name": f"{key}_{j}", "world_from_object": matrix}
                self._blender.request(request)

    def render(
        self,
        camera: PinholeCamera,
        margin_px: tuple[int, int],
        world_from_camera: RigidTransform,
        samples: int,
        seed: int,
        guides: Guides | None = None,
    ) -> Float32[np.ndarray, "h w 3"]:
        """Render the radiance in scene units, box filtered over each pixel.

        Args:
            margin_px: unused, as Blender takes the principal point of `camera`.
            samples: light paths per pixel.
            guides: guides of this view for denoising; None: no denoising.
        """
        view = camera_request(camera, world_from_camera)

        def one_pass(count: int, number: int) -> Float32[np.ndarray, "h w 3"]:
            request = view | self._light | {"samples": count, "seed": number % _SEEDS}
            self._light = {}
            return self._blender.render(
                request | {"bounces": BOUNCES, "surfaces": "principled", "is_antialiased": True}
            )

        return traced(one_pass, samples, seed, guides)

    def _add_finish(self, name: str, finish: Finish) -> None:
        # Keys are the names of Blender's inputs.
        inputs = {
            "Specular IOR Level": finish.specular,
            "Metallic": finish.metallic,
            "Coat Weight": _COAT_WEIGHT * finish.clearcoat,
            "Coat Roughness": _COAT_ROUGHNESS,
        }
        roughness = np.repeat(finish.roughness[..., None], 3, axis=2)
        path = self._blender.write(
            "finish", {"Base Color": finish.base_colour, "Roughness": roughness}
        )
        self._blender.request({"do": "finish", "name": name, "path": path, "inputs": inputs})

    def _add_part(self, name: str, part: Part, finish: Finish) -> None:
        corners = part.faces.ravel()
        uv = (part.uv_m / np.asarray(finish.extent_m)).astype(np.float32)
        path = self._blender.write("part", {"vertices": part.vertices[corners], "uv": uv[corners]})
        self._blender.request({"do": "part", "name": name, "path": path, "finish": part.material})
