"""Light on arbitrary surface points (mesh vertices, surfels), for intrinsic decomposition."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float32

from lightsim.core.dome import SkyDome
from lightsim.render.scene import FrameScene
from lightsim.render.transport.faces import FaceSamples, FaceTable, hashed_shifts
from lightsim.render.transport.light import face_radiosity, table_sums
from lightsim.render.transport.lobes import Lobes, sun_in_lobes
from lightsim.render.transport.matrix import TransportConfig, static_face_table, trace_points
from lightsim.render.transport.sky import EnvironmentCells, prepare_sky
from lightsim.render.transport.sun import sun_in_scene, unshadowed_sun

# Points in memory at once, with some 100 rays each. Not measured alone.
_TILE_POINTS = 1 << 16


@dataclass(frozen=True)
class IrradianceConfig:
    """Settings of the light on surface points."""

    transport: TransportConfig = field(default_factory=lambda: TransportConfig(sky_rays=64))
    """Numbers of rays; pixel settings are ignored."""
    unseen_albedo: float | None = None
    """Grey albedo of unobserved sides, which reflect one bounce. With a number, the colours of the
    meshes are recorded radiance, which other surfaces receive as bounce light: it includes all
    bounces and requires no base colour, the unknown of the decomposition. None: no bounce light."""


@dataclass(frozen=True, eq=False)
class PointIrradiance:
    """Light on n points.

    Args:
        sun_visibility: visible fraction of the solar disc, 0 if the surface faces away from it.
        sky_visibility: sky view factor, the cosine-weighted open fraction of the hemisphere.
        sun: irradiance / pi of the sun, RGB.
        sky: irradiance / pi of the open sky.
        sky_part: fraction of `sky` from the requested part of the dome; 0 without one.
        bounce: irradiance / pi of other surfaces.
        reflected: radiance that the points' specular lobes reflect, of sky and other surfaces; 0
            without lobes.
        reflected_part: fraction of `reflected` from the requested part of the dome.
        reflected_sun: radiance of the sun that the lobes reflect, without visibility.
    """

    sun_visibility: Float32[np.ndarray, " n"]
    sky_visibility: Float32[np.ndarray, " n"]
    sun: Float32[np.ndarray, "n 3"]
    sky: Float32[np.ndarray, "n 3"]
    sky_part: Float32[np.ndarray, "n 3"]
    bounce: Float32[np.ndarray, "n 3"]
    reflected: Float32[np.ndarray, "n 3"]
    reflected_part: Float32[np.ndarray, "n 3"]
    reflected_sun: Float32[np.ndarray, "n 3"]

    @property
    def irradiance_over_pi(self) -> Float32[np.ndarray, "n 3"]:
        """RGB of sun, sky and bounce: the radiance of a white Lambert surface."""
        return self.sun + self.sky + self.bounce

    @staticmethod
    def zeros(count: int) -> PointIrradiance:
        """Return zero light, to be filled in."""
        one, two = (np.zeros(count, dtype=np.float32) for _ in range(2))
        return PointIrradiance(
            one, two, *(np.zeros((count, 3), dtype=np.float32) for _ in range(7))
        )


def irradiance_at(
    surface: Lobes,
    scene: FrameScene,
    dome: SkyDome,
    config: IrradianceConfig | None = None,
    seed: int = 0,
    faces: FaceTable | None = None,
    part_of_dome: SkyDome | None = None,
) -> PointIrradiance:
    """Return the light of a dome on surface points, in frame `world`.

    Scenes without actors come from `render.scene.without_actors`.

    Args:
        surface: points with lobes (`Lobes.none_on` for none); no ray is traced for points that do
            not reflect.
        faces: from `static_face_table` with the same scene, rays and seed; it grows, which makes
            many small calls cheap.
        part_of_dome: a dome without sun whose light is returned separately.
    """
    config = config or IrradianceConfig()
    rays = config.transport
    if config.unseen_albedo is None:
        # Without the bounce the faces' own rays are not needed.
        rays = replace(rays, face_rays=0)
    cells = prepare_sky(dome)
    part_cells = None if part_of_dome is None else prepare_sky(part_of_dome)
    # The table is common to all tiles, and only their faces are traced.
    table = static_face_table(scene, rays, seed) if faces is None else faces
    found = PointIrradiance.zeros(len(surface))
    for start in range(0, len(surface), _TILE_POINTS):
        part = slice(start, start + _TILE_POINTS)
        numbers = np.arange(start, min(start + _TILE_POINTS, len(surface)), dtype=np.int64)
        tile = _tile(
            surface.chosen(part),
            hashed_shifts(numbers, seed),
            scene,
            (cells, part_cells, table),
            replace(config, transport=rays),
        )
        for name, values in vars(tile).items():
            getattr(found, name)[part] = values
    return found


def _tile(
    surface: Lobes,
    shifts: Float32[np.ndarray, "n 2"],
    scene: FrameScene,
    light: tuple[EnvironmentCells, EnvironmentCells | None, FaceTable],
    config: IrradianceConfig,
) -> PointIrradiance:
    points, normals = surface.ray_starts_world, surface.normal_world
    cells, part_cells, face_table = light
    table = trace_points(scene, surface, shifts, config.transport, face_table)
    radiosity = _radiosity(table.faces, scene, cells, config.unseen_albedo)
    sums = table_sums(table, cells, radiosity)
    visibility = np.zeros(len(points), dtype=np.float32)
    sun, sky_part, reflected, reflected_part, reflected_sun = (
        np.zeros((len(points), 3), dtype=np.float32) for _ in range(5)
    )
    if cells.sun is not None:
        visibility = sun_in_scene(scene, points, normals, cells.sun, config.transport)
        sun = unshadowed_sun(normals, cells.sun) * visibility[:, None]
    if table.reflections is not None:
        reflected = table.reflections.light(cells, radiosity)
        if cells.sun is not None:
            reflected_sun = sun_in_lobes(surface, cells.sun)
    # The part of the dome costs sums only, with the same rays and without bounce.
    if part_cells is not None:
        dark = np.zeros_like(radiosity)
        sky_part = table_sums(table, part_cells, dark)[:, :3]
        if table.reflections is not None:
            reflected_part = table.reflections.light(part_cells, dark)
    return PointIrradiance(
        visibility,
        table.sky_view_factor,
        sun,
        sums[:, :3],
        sky_part,
        sums[:, 3:6],
        reflected,
        reflected_part,
        reflected_sun,
    )


def _radiosity(
    faces: FaceSamples, scene: FrameScene, cells: EnvironmentCells, unseen_albedo: float | None
) -> Float32[np.ndarray, "f 3"]:
    """Return the radiance of each face: the recorded one, or one grey bounce for unobserved
    faces."""
    if unseen_albedo is None:
        return np.zeros_like(faces.base_colour)
    # Confidence 0: no camera observed this side, so its colour is not a radiance.
    grey = replace(faces, base_colour=np.full_like(faces.base_colour, unseen_albedo))
    is_seen = faces.confidence[:, None] > 0
    return np.where(is_seen, faces.base_colour, face_radiosity(grey, scene, cells))
