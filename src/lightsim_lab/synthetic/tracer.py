"""Path tracing of the street with Mitsuba: glossy materials, several bounces, solar disc."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float32

from lightsim.core.camera import PinholeCamera
from lightsim.core.dome import Sun
from lightsim.core.frames import RigidTransform
from lightsim.core.mitsuba_variants import Variant, mitsuba_with, variant_on
from lightsim.render.mitsuba_scene import (
    bitmap,
    environment_map,
    make_mesh,
    path_traced,
    perspective_sensor,
    sun_disc,
)
from lightsim_lab.synthetic.guides import Guides
from lightsim_lab.synthetic.shapes import Part
from lightsim_lab.synthetic.textures import Finish
from lightsim_lab.synthetic.tracing import BOUNCES, Placed, traced


class PathTracer:
    """Path-traced scene under one sky.

    Poses of actors are updated in place, as rebuilding the scene leaks memory.

    Args:
        variant: Mitsuba variant; None: that of the CPU. CUDA is never selected automatically, as
            its noise differs and a street must be the same on every machine.
    """

    def __init__(
        self,
        background: Sequence[Part],
        actors: Sequence[Placed],
        finishes: Mapping[str, Finish],
        environment: Float32[np.ndarray, "h w 3"],
        sun: Sun | None,
        variant: Variant | None = None,
    ) -> None:
        self.variant: Variant = variant or variant_on("cpu")
        self._actors = {placed.key: placed.parts for placed in actors}
        self._last: dict[str, bytes] = {}
        parts = {f"static{i}": part for i, part in enumerate(background)}
        for key, own in self._actors.items():
            parts |= {f"{key}_{j}": part for j, part in enumerate(own)}
        with mitsuba_with(self.variant) as mi:
            bsdfs = {name: _bsdf(mi, finish) for name, finish in finishes.items()}
            contents = {"sky": environment_map(mi, environment)}
            if sun is not None:
                contents["sun"] = sun_disc(mi, sun, np.zeros(3))
            for name, part in parts.items():
                contents[name] = _mesh(mi, name, part, finishes[part.material], bsdfs)
            self._scene = path_traced(mi, contents, BOUNCES)
            self._parameters = mi.traverse(self._scene)

    def place(self, world_from_actors: Mapping[str, RigidTransform]) -> None:
        """Set the poses of the named actors."""
        changed = False
        for key, pose in world_from_actors.items():
            # Only if it moved, because an update of geometry rebuilds its acceleration structure.
            if self._last.get(key) == pose.matrix.tobytes():
                continue
            self._last[key] = pose.matrix.tobytes()
            changed = True
            for j, part in enumerate(self._actors[key]):
                name = f"{key}_{j}.vertex_positions"
                kind = type(self._parameters[name])
                self._parameters[name] = kind(part.transformed(pose).vertices.ravel())
        if changed:
            with mitsuba_with(self.variant):
                self._parameters.update()

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
            samples: light paths per pixel.
            guides: guides of this view for denoising; None: no denoising.
        """
        with mitsuba_with(self.variant) as mi:
            sensor = perspective_sensor(mi, camera, margin_px, world_from_camera)

            def one_pass(count: int, number: int) -> Float32[np.ndarray, "h w 3"]:
                image = mi.render(self._scene, sensor=sensor, spp=count, seed=number)
                return np.array(image, dtype=np.float32)[..., :3]

            return traced(one_pass, samples, seed, guides)


def _bsdf(mi: Any, finish: Finish) -> Any:
    inner: dict[str, Any] = {
        "type": "principled",
        "base_color": _texture(mi, finish.base_colour),
        "roughness": _texture(mi, np.repeat(finish.roughness[..., None], 3, axis=2)),
        "specular": finish.specular,
        "metallic": finish.metallic,
    }
    if finish.clearcoat > 0:
        inner |= {"clearcoat": finish.clearcoat, "clearcoat_gloss": 0.95}
    return mi.load_dict({"type": "twosided", "material": inner})


def _texture(mi: Any, image: Float32[np.ndarray, "h w c"]) -> Any:
    return float(image[0, 0, 0]) if image.shape[:2] == (1, 1) else bitmap(mi, image, "repeat")


def _mesh(mi: Any, name: str, part: Part, finish: Finish, bsdfs: Mapping[str, Any]) -> Any:
    parameters = {
        "vertex_positions": part.vertices,
        "faces": part.faces.astype(np.uint32),
        "vertex_texcoords": (part.uv_m / np.asarray(finish.extent_m)).astype(np.float32),
    }
    return make_mesh(mi, name, parameters, bsdfs[part.material], is_faceted=True)
