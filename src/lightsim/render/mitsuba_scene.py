"""Scenes for Mitsuba 3: meshes, emitters, sensor.

Path tracer, ray caster, clear sky and the synthetic street's renderer all build on this. What a
surface is made of stays with each of them: the street's truth must come from another material
model than the method's own.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Float32, Shaped

from lightsim.core.camera import PinholeCamera
from lightsim.core.dome import Sun
from lightsim.core.frames import RigidTransform

# The sun's direction then changes by 0.03 degrees over 100 m.
_SUN_DISTANCE_M = 2.0e5
# Beyond every depth in use: Russian roulette would add noise, and no path here is long.
_NO_ROULETTE = 10_000
# No surface of a street stands nearer to a camera.
_NEAR_CLIP_M = 0.05
_FAR_CLIP_M = 10 * _SUN_DISTANCE_M
# Mitsuba's environment map has its pole along y, ours along z.
_WORLD_FROM_MAP = [
    [0.0, 0.0, 1.0, 0.0],
    [1.0, 0.0, 0.0, 0.0],
    [0.0, 1.0, 0.0, 0.0],
    [0.0, 0.0, 0.0, 1.0],
]
# Mitsuba's cameras have x to the left and y up.
_CAMERA_FROM_MITSUBA = np.diag([-1.0, -1.0, 1.0, 1.0])


def make_mesh(
    mi: Any,
    name: str,
    parameters: Mapping[str, Shaped[np.ndarray, "..."]],
    bsdf: Any = None,
    attributes: Mapping[str, Float32[np.ndarray, "..."]] | None = None,
    *,
    is_faceted: bool = False,
) -> Any:
    """A Mitsuba mesh.

    Args:
        mi: from `mitsuba_with`.
        name: in the scene.
        parameters: `vertex_positions` [n, 3], `faces` [m, 3], and `vertex_normals` [n, 3] or
            `vertex_texcoords` [n, 2] where there are some.
        bsdf: its material; None for a mesh that only stops rays.
        attributes: `vertex_...` or `face_...`, [n] or [n, k], for the material to look up.
        is_faceted: shaded with the normals of its faces.
    """
    properties = mi.Properties()
    properties["face_normals"] = is_faceted
    if bsdf is not None:
        properties["bsdf"] = bsdf
    body = mi.Mesh(
        name,
        len(parameters["vertex_positions"]),
        len(parameters["faces"]),
        has_vertex_normals="vertex_normals" in parameters,
        has_vertex_texcoords="vertex_texcoords" in parameters,
        props=properties,
    )
    # Attributes come first: the last update of the parameters makes all of it known.
    for key, value in (attributes or {}).items():
        body.add_attribute(key, 1 if value.ndim == 1 else value.shape[1], value.ravel())
    kept = mi.traverse(body)
    for key, value in parameters.items():
        kept[key] = type(kept[key])(np.ascontiguousarray(value).ravel())
    kept.update()
    return body


def bitmap(
    mi: Any, image: Float32[np.ndarray, "h w c"], wrap_mode: Literal["clamp", "repeat"]
) -> dict[str, Any]:
    """A texture of linear values, looked up bilinearly."""
    return {
        "type": "bitmap",
        "bitmap": mi.Bitmap(np.ascontiguousarray(image)),
        "raw": True,
        "filter_type": "bilinear",
        "wrap_mode": wrap_mode,
    }


def environment_map(mi: Any, radiance: Float32[np.ndarray, "h w 3"]) -> dict[str, Any]:
    """An emitter in frame `world`, its first and last row at the poles (`rows_at_poles`)."""
    return {
        "type": "envmap",
        "bitmap": mi.Bitmap(np.ascontiguousarray(radiance)),
        "to_world": mi.ScalarTransform4f(_WORLD_FROM_MAP),
    }


def rows_at_poles(radiance: Float32[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "r w 3"]:
    """2h + 1 rows, with which Mitsuba interpolates as `core.equirect.sample_bilinear` does."""
    height = len(radiance)
    rows = np.empty((2 * height + 1, *radiance.shape[1:]), dtype=np.float32)
    rows[1::2] = radiance
    rows[2:-1:2] = (radiance[1:] + radiance[:-1]) / 2
    rows[0], rows[-1] = radiance[0], radiance[-1]
    return rows


def sun_disc(mi: Any, sun: Sun, around_world: Float[np.ndarray, "3"]) -> dict[str, Any]:
    """A glowing disc of the sun's angular size, seen from around a point.

    One light of its own is sampled far better than a few bright texels of the sky, and it shows
    in pictures and reflections.
    """
    radius = np.radians(sun.angular_radius_deg)
    towards = sun.direction_world / np.linalg.norm(sun.direction_world)
    # Any direction that the sun's is far from.
    up = [1.0, 0.0, 0.0] if abs(towards[0]) < 0.9 else [0.0, 1.0, 0.0]
    place = mi.ScalarTransform4f().look_at(
        origin=(around_world + _SUN_DISTANCE_M * towards).tolist(),
        target=around_world.tolist(),
        up=up,
    )
    radiance = sun.irradiance.astype(np.float64) / (np.pi * np.sin(radius) ** 2)
    return {
        "type": "disk",
        "to_world": place @ mi.ScalarTransform4f().scale(_SUN_DISTANCE_M * float(np.tan(radius))),
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": radiance.tolist()}},
    }


def path_traced(mi: Any, contents: Mapping[str, Any], bounces: int) -> Any:
    """A scene for Mitsuba's `path` integrator (next-event estimation with multiple importance
    sampling; Veach & Guibas 1995, DOI 10.1145/218380.218498).

    Args:
        mi: from `mitsuba_with`.
        contents: meshes and emitters by name.
        bounces: reflections from surface to surface before the light; 0 is direct light alone.
    """
    integrator = {"type": "path", "max_depth": bounces + 2, "rr_depth": _NO_ROULETTE}
    return mi.load_dict({"type": "scene", "integrator": integrator, **contents})


def perspective_sensor(
    mi: Any,
    camera: PinholeCamera,
    margin_px: tuple[int, int],
    world_from_camera: RigidTransform,
) -> Any:
    """A camera with a box filter over each pixel.

    Args:
        mi: from `mitsuba_with`.
        camera: of one focal length.
        margin_px: (u, v) by which the principal point lies off the centre: the picture is a crop
            of a larger, centred one.
        world_from_camera: its pose.
    """
    right, down = abs(margin_px[0]), abs(margin_px[1])
    width, height = camera.width_px + 2 * right, camera.height_px + 2 * down
    return mi.load_dict(
        {
            "type": "perspective",
            "fov_axis": "x",
            "fov": float(np.degrees(2 * np.arctan(width / (2 * camera.fx)))),
            "near_clip": _NEAR_CLIP_M,
            "far_clip": _FAR_CLIP_M,
            "to_world": mi.ScalarTransform4f(
                (world_from_camera.matrix @ _CAMERA_FROM_MITSUBA).tolist()
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
    )


def columns(mi: Any, rows: Float[np.ndarray, "n 3"]) -> Any:
    """Vectors as Mitsuba's compiled variants keep them: three arrays.

    Read from memory, so never part of a kernel's text, which would be compiled anew for every
    value.
    """
    values = np.ascontiguousarray(np.asarray(rows, dtype=np.float32).T)
    return mi.Vector3f(*(mi.Float(column) for column in values))
