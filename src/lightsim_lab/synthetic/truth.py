"""Ground truth of a synthetic log: skies, buffers, camera gains and geometry."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from lightsim.core.buffers import BACKGROUND, NO_SURFACE
from lightsim.core.camera import PinholeCamera
from lightsim.core.dome import SOLAR_RADIUS_DEG, disc_directions
from lightsim.core.frames import RigidTransform
from lightsim.core.solar import azimuth_elevation
from lightsim.store.atomic import whole_file
from lightsim.store.sky import write_dome
from lightsim_lab.synthetic.geometry import Snapshot
from lightsim_lab.synthetic.lidar import STEP_M
from lightsim_lab.synthetic.plan import StreetConfig
from lightsim_lab.synthetic.rig import MountedCamera
from lightsim_lab.synthetic.shapes import joined
from lightsim_lab.synthetic.skies import Sky
from lightsim_lab.synthetic.street import Street
from lightsim_lab.synthetic.writer import write_json

# Rays per pixel to the solar disc, which give penumbras 16 levels.
_SUN_RAYS = 16


def write_sky(folder: Path, sky: Sky, height_px: int, enu_from_world: RigidTransform) -> None:
    """Write NAME.exr (frame `world`, scene units, with the sun) and NAME.json (exact sun)."""
    folder.mkdir(parents=True, exist_ok=True)
    name = sky.spec.name
    heading_deg = azimuth_elevation(enu_from_world.matrix[:3, 0]).azimuth_deg
    write_dome(folder / f"{name}.exr", sky.dome(height_px).radiance, heading_deg)
    sun = sky.sun
    position = sky.spec.sun
    write_json(
        folder / f"{name}.json",
        {
            "direction_world": None if sun is None else sun.direction_world.tolist(),
            "azimuth_deg": None if position is None else position.azimuth_deg,
            "elevation_deg": None if position is None else position.elevation_deg,
            "irradiance": [0.0, 0.0, 0.0] if sun is None else sun.irradiance.tolist(),
            "sky_irradiance": sky.sky_irradiance().tolist(),
        },
    )


def compute_buffers(
    snapshot: Snapshot,
    camera: PinholeCamera,
    world_from_camera: RigidTransform,
    sky: Sky,
) -> dict[str, Float32[np.ndarray, "h w *c"]]:
    """Compute exact buffers at the pixel centres, by name.

    `depth_z_m` is along the optical axis in steps of 1/512 m, inf without a surface. `normal_world`
    is the face normal towards the camera. `base_colour` is the mean of 2 x 2 points.
    `sun_visibility` is that of the sun of `sky`, 0 on faces that face away from it.
    """
    h, w = camera.height_px, camera.width_px
    origin = world_from_camera.translation_m
    centres = camera.pixel_centres().reshape(-1, 2)
    directions = world_from_camera.rotate(camera.directions(centres))
    origins = np.broadcast_to(origin, directions.shape).copy()
    hits = snapshot.intersect(origins, directions)
    # Third column of the rotation: the optical axis in frame `world`.
    axis = world_from_camera.rotation[:, 2]
    depth = np.where(hits.is_hit, hits.distance_m * (directions @ axis), np.inf)
    colour = np.zeros((h * w, 3))
    for du, dv in ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)):
        shifted = world_from_camera.rotate(camera.directions(centres + np.array([du, dv])))
        colour += snapshot.base_colour(snapshot.intersect(origins, shifted)) / 4
    visibility = np.zeros(h * w)
    seen = hits.is_hit
    if sky.sun is not None:
        points = origin + hits.distance_m[seen, None] * directions[seen]
        disc = disc_directions(sky.sun.direction_world, SOLAR_RADIUS_DEG, _SUN_RAYS)
        visibility[seen] = snapshot.sun_visibility(points, hits.normal_world[seen], disc)
    actor = np.where(seen, snapshot.actor[hits.face], NO_SURFACE)
    # Rounding to steps makes the files compress better than at full precision.
    flat = {
        "depth_z_m": np.round(depth / STEP_M) * STEP_M,
        "normal_world": hits.normal_world,
        "base_colour": np.round(np.where(seen[:, None], colour, 0.0) * 256) / 256,
        "sun_visibility": visibility,
        "actor_index": actor.astype(np.float64),
    }
    shapes = {name: (h, w, 3) if value.ndim == 2 else (h, w) for name, value in flat.items()}
    return {name: value.reshape(shapes[name]).astype(np.float32) for name, value in flat.items()}


def write_truth_json(
    path: Path,
    street: Street,
    config: StreetConfig,
    cameras: Sequence[MountedCamera],
    command: str,
    renderer: Mapping[str, Any],
) -> None:
    """Write gains, place, time, sun, actors in the order of `actor_index`, and the command.

    Args:
        renderer: entries of `renderers.StreetRenderer.record`.
    """
    plan = street.plan
    geometric = azimuth_elevation(
        plan.enu_from_world.rotate(plan.world_from_street.rotate(np.array([1.0, 0.0, 0.0])))
    )
    # The index of the ego vehicle's body, where the street has one.
    own = {"ego_body": len(street.participants)} if street.ego_body else {}
    write_json(
        path,
        {
            "version": 1,
            "command": command,
            "seed": plan.seed,
            **renderer,
            # Omitted for the city, whose truth files are older than the other styles.
            **({} if plan.style == "city" else {"style": plan.style}),
            "camera_gains": {m.camera.name: m.gain.tolist() for m in cameras},
            "latitude_deg": plan.latitude_deg,
            "longitude_deg": plan.longitude_deg,
            "utc_start_ns": plan.start_ns,
            "enu_from_world_yaw_deg": float(np.degrees(plan.enu_from_world.yaw_rad)),
            "street_azimuth_deg": geometric.azimuth_deg,
            "sun_azimuth_deg": plan.sun.azimuth_deg,
            "sun_elevation_deg": plan.sun.elevation_deg,
            "relit_stems": [stem_of(k) for k in config.truth_stems],
            "buffer_stems": [stem_of(k) for k in config.buffer_stems],
            "actor_index": {"background": BACKGROUND, "sky": NO_SURFACE, **own},
            "actors": [actor.actor_id for actor in street.participants],
        },
    )


def write_geometry(path: Path, street: Street) -> None:
    """Write scene.npz: background in frame `world`, each actor in frame `actor`.

    Vertices are rounded to 1/512 m; all other values are exact.
    """
    arrays: dict[str, np.ndarray] = {}
    world_from_street = street.plan.world_from_street
    groups = [("background", [part.transformed(world_from_street) for part in street.background])]
    groups += [(actor.actor_id, list(actor.parts)) for actor in street.participants]
    for name, parts in groups:
        vertices, faces = joined(parts)
        steps = np.round(vertices / STEP_M).astype(np.int32)
        # Vertices that coincide after rounding are merged.
        unique, index = np.unique(steps, axis=0, return_inverse=True)
        arrays[f"{name}/vertices"] = (unique * STEP_M).astype(np.float32)
        arrays[f"{name}/faces"] = index.ravel()[faces].astype(np.int32)
    with whole_file(path) as temporary:
        np.savez_compressed(temporary, allow_pickle=False, **arrays)


def stem_of(index: int) -> str:
    """Return the stem of a frame's or sweep's files: two digits or more, as in PandaSet."""
    return f"{index:02d}"
