"""Scenes for Mitsuba 3: meshes, emitters, sensor.

Common to the path tracer, the ray caster, the clear sky and the synthetic street's renderer. Each
of them has its own material model: the street's ground truth must not come from the material model
of the evaluated method.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Float32, Shaped

from lightsim.core.camera import PinholeCamera
from lightsim.core.dome import Sun
from lightsim.core.frames import RigidTransform

# Distance of the sun's disc, in metres: its direction then changes by 0.03 degrees over 100 m.
_SUN_DISTANCE_M = 2.0e5
# Rotation from Mitsuba's environment map, whose pole is along y, to frame `world` (z up).
_WORLD_FROM_MAP = [
    [0.0, 0.0, 1.0, 0.0],
    [1.0, 0.0, 0.0, 0.0],
    [0.0, 1.0, 0.0, 0.0],
    [0.0, 0.0, 0.0, 1.0],
]
# Mitsuba's cameras have x to the left and y up; frame `camera` has x to the right and y down.
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
    """Return a Mitsuba mesh.

    Args:
        mi: from `mitsuba_with`.
        name: in the scene.
        parameters: `vertex_positions` [n, 3], `faces` [m, 3], and optionally `vertex_normals` [n,
            3] or `vertex_texcoords` [n, 2].
        bsdf: its material; None for a mesh that only blocks rays.
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
    # Attributes come first: the update of the parameters below registers them too.
    for key, value in (attributes or {}).items():
        body.add_attribute(key, 1 if value.ndim == 1 else value.shape[1], value.ravel())
    scene_parameters = mi.traverse(body)
    for key, value in parameters.items():
        kind = type(scene_parameters[key])
        scene_parameters[key] = kind(np.ascontiguousarray(value).ravel())
    scene_parameters.update()
    return body


def bitmap(
    mi: Any, image: Float32[np.ndarray, "h w c"], wrap_mode: Literal["clamp", "repeat"]
) -> dict[str, Any]:
    """Return a texture of linear values, looked up bilinearly."""
    return {
        "type": "bitmap",
        "bitmap": mi.Bitmap(np.ascontiguousarray(image)),
        "raw": True,
        "filter_type": "bilinear",
        "wrap_mode": wrap_mode,
    }


def environment_map(mi: Any, radiance: Float32[np.ndarray, "h w 3"]) -> dict[str, Any]:
    """Return an emitter in frame `world`, with its first and last row at the poles
    (`rows_at_poles`)."""
    return {
        "type": "envmap",
        "bitmap": mi.Bitmap(np.ascontiguousarray(radiance)),
        "to_world": mi.ScalarTransform4f(_WORLD_FROM_MAP),
    }


def rows_at_poles(radiance: Float32[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "r w 3"]:
    """Return 2h + 1 rows, for which Mitsuba interpolates like `core.equirect.sample_bilinear`."""
    height = len(radiance)
    rows = np.empty((2 * height + 1, *radiance.shape[1:]), dtype=np.float32)
    rows[1::2] = radiance
    rows[2:-1:2] = (radiance[1:] + radiance[:-1]) / 2
    rows[0], rows[-1] = radiance[0], radiance[-1]
    return rows


def sun_disc(mi: Any, sun: Sun, around_world: Float[np.ndarray, "3"]) -> dict[str, Any]:
    """Return an emitting disc of the sun's angular size as observed from a point.

    One light source is sampled with far less noise than a few bright texels of the sky, and it is
    visible in images and reflections.

    Args:
        mi: from `mitsuba_with`.
        sun: direction, irradiance and size.
        around_world: the point, in metres.
    """
    radius = np.radians(sun.angular_radius_deg)
    towards = sun.direction_world / np.linalg.norm(sun.direction_world)
    # Any direction that is not nearly parallel to the sun's.
    up = [1.0, 0.0, 0.0] if abs(towards[0]) < 0.9 else [0.0, 1.0, 0.0]
    place = mi.ScalarTransform4f().look_at(
        origin=(around_world + _SUN_DISTANCE_M * towards).tolist(),
        target=around_world.tolist(),
        up=up,
    )
    # Irradiance of a uniform disc of angular radius r is radiance x pi x sin(r)^2.
    radiance = sun.irradiance.astype(np.float64) / (np.pi * np.sin(radius) ** 2)
    return {
        "type": "disk",
        "to_world": place @ mi.ScalarTransform4f().scale(_SUN_DISTANCE_M * float(np.tan(radius))),
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": radiance.tolist()}},
    }


def path_traced(mi: Any, contents: Mapping[str, Any], bounces: int) -> Any:
    """Return a scene for Mitsuba's `path` integrator.

    Next-event estimation with multiple importance sampling (Veach & Guibas 1995,
    doi:10.1145/218380.218498).

    Args:
        mi: from `mitsuba_with`.
        contents: meshes and emitters by name.
        bounces: reflections from surface to surface before the light; 0 is direct light only.
    """
    # Russian roulette starts beyond every depth in use: it adds noise, and paths here are short.
    integrator = {"type": "path", "max_depth": bounces + 2, "rr_depth": 10_000}
    return mi.load_dict({"type": "scene", "integrator": integrator, **contents})


def perspective_sensor(
    mi: Any,
    camera: PinholeCamera,
    margin_px: tuple[int, int],
    world_from_camera: RigidTransform,
) -> Any:
    """Return a camera with a box filter over each pixel.

    Args:
        mi: from `mitsuba_with`.
        camera: with equal focal lengths.
        margin_px: offset (u, v) of the principal point from the centre: the image is a crop of a
            larger, centred one.
        world_from_camera: its pose.
    """
    right, down = abs(margin_px[0]), abs(margin_px[1])
    width, height = camera.width_px + 2 * right, camera.height_px + 2 * down
    return mi.load_dict(
        {
            "type": "perspective",
            "fov_axis": "x",
            "fov": float(np.degrees(2 * np.arctan(width / (2 * camera.fx)))),
            # No surface of a street is nearer to a camera; the sun's disc is within the far clip.
            "near_clip": 0.05,
            "far_clip": 10 * _SUN_DISTANCE_M,
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
    """Return vectors in the layout of Mitsuba's compiled variants: three arrays.

    The values are read from memory, so they never become literals of a kernel, which would be
    compiled anew for every value.
    """
    values = np.ascontiguousarray(np.asarray(rows, dtype=np.float32).T)
    return mi.Vector3f(*(mi.Float(column) for column in values))
