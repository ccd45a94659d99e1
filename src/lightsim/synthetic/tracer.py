"""Path tracing of the street with Mitsuba: glossy paint and glass, several bounces, soft sun."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32

from lightsim.core.camera import PinholeCamera
from lightsim.core.dome import Sun
from lightsim.core.frames import RigidTransform
from lightsim.synthetic.shapes import Part
from lightsim.synthetic.textures import Finish

_MAX_DEPTH = 6
_MIN_LLVM = 17
_DEPTH_OF_RUSSIAN_ROULETTE = 100
_SUN_DISTANCE_M = 2.0e5
"""Far enough that the sun's direction changes by 0.03 degrees over 100 m."""
_PASSES = 6
_OUTLIER = 2.5
"""A pass may exceed the median of all passes by this factor: sun that panes and paint throw onto
other surfaces reaches a path tracer as rare, very bright samples, and is left out."""


def choose_variant() -> str:
    """`llvm_ad_rgb` where DRJIT_LIBLLVM_PATH names an LLVM of at least version 17, else
    `scalar_rgb`.

    Versions 14 to 16 cannot translate Mitsuba's kernels for every processor and end the process,
    and Mitsuba by itself takes the first one it finds; so LLVM is used only when named.
    """
    named = Path(os.environ.get("DRJIT_LIBLLVM_PATH", "")).name
    version = re.search(r"LLVM(?:-|\.so\.)(\d+)", named)
    return "llvm_ad_rgb" if version and int(version.group(1)) >= _MIN_LLVM else "scalar_rgb"


@dataclass(frozen=True, eq=False)
class Placed:
    """Parts of the background or of one actor, with the key under which they can be moved."""

    key: str
    parts: tuple[Part, ...]


class PathTracer:
    """The scene under one sky. Poses of actors are updated in place (rebuilding leaks memory)."""

    def __init__(
        self,
        background: Sequence[Part],
        actors: Sequence[Placed],
        finishes: Mapping[str, Finish],
        environment: Float32[np.ndarray, "h w 3"],
        sun: Sun | None,
        variant: str | None = None,
    ) -> None:
        import mitsuba

        mi: Any = mitsuba
        self.variant = variant or choose_variant()
        mi.set_variant(self.variant)
        self._mi: Any = mi
        bsdfs = {name: _bsdf(mi, finish) for name, finish in finishes.items()}
        self._actors = {placed.key: placed.parts for placed in actors}
        self._last: dict[str, bytes] = {}
        description: dict[str, Any] = {
            "type": "scene",
            "integrator": {
                "type": "path",
                "max_depth": _MAX_DEPTH,
                "rr_depth": _DEPTH_OF_RUSSIAN_ROULETTE,
            },
            "sky": _emitter(mi, environment),
        }
        if sun is not None:
            description["sun"] = _sun_disc(mi, sun)
        for i, part in enumerate(background):
            finish = finishes[part.material]
            description[f"static{i}"] = _mesh(mi, f"static{i}", part, finish, bsdfs)
        for key, parts in self._actors.items():
            for j, part in enumerate(parts):
                name = f"{key}_{j}"
                finish = finishes[part.material]
                description[name] = _mesh(mi, name, part, finish, bsdfs)
        self._scene = mi.load_dict(description)
        self._parameters = mi.traverse(self._scene)

    def place(self, world_from_actors: Mapping[str, RigidTransform]) -> None:
        """Move the named actors (parts are kept in frame `actor`)."""
        changed = False
        for key, pose in world_from_actors.items():
            if self._last.get(key) == pose.matrix.tobytes():
                continue
            self._last[key] = pose.matrix.tobytes()
            changed = True
            for j, part in enumerate(self._actors[key]):
                name = f"{key}_{j}.vertex_positions"
                kind = type(self._parameters[name])
                self._parameters[name] = kind(part.moved(pose).vertices.ravel())
        if changed:
            self._parameters.update()

    def render(
        self,
        camera: PinholeCamera,
        margin_px: tuple[int, int],
        world_from_camera: RigidTransform,
        samples: int,
        seed: int,
    ) -> Float32[np.ndarray, "h w 3"]:
        """Radiance in scene units, box filtered over each pixel."""
        sensor = self._mi.load_dict(_sensor(self._mi, camera, margin_px, world_from_camera))
        if samples < 4 * _PASSES:
            return self._pass(sensor, samples, seed)
        images = np.stack(
            [self._pass(sensor, samples // _PASSES, seed * _PASSES + k) for k in range(_PASSES)]
        )
        limit = _OUTLIER * np.median(images, axis=0) + 0.02
        return np.minimum(images, limit).mean(axis=0)

    def _pass(self, sensor: Any, samples: int, seed: int) -> Float32[np.ndarray, "h w 3"]:
        image = self._mi.render(self._scene, sensor=sensor, spp=samples, seed=seed)
        return np.array(image, dtype=np.float32)[..., :3]


def _sensor(
    mi: Any,
    camera: PinholeCamera,
    margin_px: tuple[int, int],
    world_from_camera: RigidTransform,
) -> dict[str, Any]:
    """A principal point off the centre is a crop of a larger, centred image."""
    right, down = abs(margin_px[0]), abs(margin_px[1])
    width, height = camera.width_px + 2 * right, camera.height_px + 2 * down
    return {
        "type": "perspective",
        "fov_axis": "x",
        "fov": float(np.degrees(2 * np.arctan(width / (2 * camera.fx)))),
        "near_clip": 0.05,
        "far_clip": 10 * _SUN_DISTANCE_M,
        "to_world": mi.ScalarTransform4f(
            (world_from_camera.matrix @ np.diag([-1.0, -1.0, 1.0, 1.0])).tolist()
        ),
        "film": {
            "type": "hdrfilm",
            "width": width,
            "height": height,
            "crop_offset_x": right - margin_px[0],
            "crop_offset_y": down - margin_px[1],
            "crop_width": camera.width_px,
            "crop_height": camera.height_px,
            "pixel_format": "rgb",
            "component_format": "float32",
            "rfilter": {"type": "box"},
        },
        "sampler": {"type": "independent"},
    }


def _emitter(mi: Any, environment: Float32[np.ndarray, "h w 3"]) -> dict[str, Any]:
    axes = [[0.0, 0.0, 1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
    return {
        "type": "envmap",
        "bitmap": mi.Bitmap(np.ascontiguousarray(environment)),
        "to_world": mi.ScalarTransform4f(axes),
    }


def _sun_disc(mi: Any, sun: Sun) -> dict[str, Any]:
    """A glowing disc of the sun's angular size: one light of its own is sampled far better than a
    few bright texels of the sky, and it shows in pictures and reflections."""
    radius = np.radians(sun.angular_radius_deg)
    towards = sun.direction_world / np.linalg.norm(sun.direction_world)
    helper = [1.0, 0.0, 0.0] if abs(towards[0]) < 0.9 else [0.0, 1.0, 0.0]
    place = mi.ScalarTransform4f().look_at(
        origin=(_SUN_DISTANCE_M * towards).tolist(), target=[0.0, 0.0, 0.0], up=helper
    )
    radiance = sun.irradiance.astype(np.float64) / (np.pi * np.sin(radius) ** 2)
    return {
        "type": "disk",
        "to_world": place @ mi.ScalarTransform4f().scale(_SUN_DISTANCE_M * float(np.tan(radius))),
        "emitter": {
            "type": "area",
            "radiance": {"type": "rgb", "value": radiance.tolist()},
        },
    }


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
    if image.shape[:2] == (1, 1):
        return float(image[0, 0, 0])
    return {
        "type": "bitmap",
        "bitmap": mi.Bitmap(np.ascontiguousarray(image)),
        "raw": True,
        "filter_type": "bilinear",
        "wrap_mode": "repeat",
    }


def _mesh(mi: Any, name: str, part: Part, finish: Finish, bsdfs: Mapping[str, Any]) -> Any:
    properties = mi.Properties()
    properties["bsdf"] = bsdfs[part.material]
    properties["face_normals"] = True
    mesh = mi.Mesh(
        name,
        len(part.vertices),
        len(part.faces),
        has_vertex_normals=False,
        has_vertex_texcoords=True,
        props=properties,
    )
    parameters = mi.traverse(mesh)
    values: dict[str, Float[np.ndarray, "n k"] | np.ndarray] = {
        "vertex_positions": part.vertices,
        "faces": part.faces.astype(np.uint32),
        "vertex_texcoords": (part.uv_m / np.asarray(finish.extent_m)).astype(np.float32),
    }
    for key, value in values.items():
        parameters[key] = type(parameters[key])(np.ascontiguousarray(value).ravel())
    parameters.update()
    return mesh
