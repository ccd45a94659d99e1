"""Light on arbitrary surface points (mesh vertices, surfels), for intrinsic decomposition."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float32

from lightsim.core.dome import SkyDome
from lightsim.render.scene import FrameScene
from lightsim.render.transport.faces import FaceSamples, FaceTable, hashed_shifts
from lightsim.render.transport.light import face_radiosity, light_points, table_sums
from lightsim.render.transport.lobes import Lobes, sun_in_lobes
from lightsim.render.transport.matrix import TransportConfig, static_face_table, trace_points
from lightsim.render.transport.sky import EnvironmentCells, prepare_sky

_TILE_POINTS = 1 << 16


@dataclass(frozen=True)
class IrradianceConfig:
    """Light on surface points."""

    transport: TransportConfig = field(default_factory=lambda: TransportConfig(sky_rays=64))
    """Numbers of rays; pixel settings are not used."""
    unseen_albedo: float | None = None
    """With a number, the colours of the meshes are the radiance that cameras saw, and that is what
    other surfaces send: all bounces are in it, and no base colour is needed, which is what
    decomposition is looking for. Sides that no camera saw reflect one bounce with this grey
    albedo. None leaves the light of other surfaces out."""


@dataclass(frozen=True, eq=False)
class PointIrradiance:
    """Light on n points.

    Args:
        sun_visibility: fraction of the solar disc seen, 0 behind the surface's own horizon.
        sky_visibility: cosine-weighted fraction of the hemisphere that is open.
        sun: irradiance / pi, RGB, that the sun gives.
        sky: the part of the open sky.
        sky_part: of `sky`, that of the part of the dome that was asked for; zero without one.
        bounce: the part of other surfaces.
        reflected: radiance that the points' specular lobes send, of sky and other surfaces; zero
            without lobes.
        reflected_part: of `reflected`, that of the part of the dome that was asked for.
        reflected_sun: the same of the sun, without visibility.
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
        """RGB of sun, sky and bounce; a white Lambert surface shows it."""
        return self.sun + self.sky + self.bounce

    @staticmethod
    def zeros(count: int) -> PointIrradiance:
        """Darkness, to be filled in."""
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
    """Light of a dome on surface points, in frame `world`.

    Scenes without actors come from `render.scene.without_actors`.

    Args:
        faces: what an earlier call with the same scene, rays and seed has traced already
            (`static_face_table`); it grows, which makes many small calls cheap.
        surface: with lobes (`Lobes.none_on` for none); no ray is traced where none reflects.
        part_of_dome: a dome without sun whose light is wanted besides.
    """
    config = config or IrradianceConfig()
    rays = config.transport
    if config.unseen_albedo is None:
        rays = replace(rays, face_rays=0)
    cells = prepare_sky(dome)
    part_cells = None if part_of_dome is None else prepare_sky(part_of_dome)
    table = static_face_table(scene, rays, seed) if faces is None else faces
    found = PointIrradiance.zeros(len(surface))
    for start in range(0, len(surface), _TILE_POINTS):
        part = slice(start, start + _TILE_POINTS)
        numbers = np.arange(start, min(start + _TILE_POINTS, len(surface)), dtype=np.int64)
        tile = _tile(
            surface.at(part),
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
    shared: tuple[EnvironmentCells, EnvironmentCells | None, FaceTable],
    config: IrradianceConfig,
) -> PointIrradiance:
    points, normals = surface.ray_starts_world, surface.normal_world
    cells, part_cells, face_table = shared
    table = trace_points(scene, surface, shifts, config.transport, face_table)
    radiosity = _radiosity(table.faces, scene, cells, config.unseen_albedo)
    lit = light_points(table, radiosity, scene, points, normals, cells, config.transport)
    sky_part, reflected, reflected_part, reflected_sun = (np.zeros_like(lit.sky) for _ in range(4))
    if table.reflections is not None:
        reflected = table.reflections.light(cells, radiosity)
        if cells.sun is not None:
            reflected_sun = sun_in_lobes(surface, cells.sun)
    if part_cells is not None:
        dark = np.zeros_like(radiosity)
        sky_part = table_sums(table, part_cells, dark)[:, :3]
        if table.reflections is not None:
            reflected_part = table.reflections.light(part_cells, dark)
    return PointIrradiance(
        lit.sun_visibility,
        table.sky_view_factor,
        lit.direct_sun,
        lit.sky,
        sky_part,
        lit.bounce,
        reflected,
        reflected_part,
        reflected_sun,
    )


def _radiosity(
    faces: FaceSamples, scene: FrameScene, cells: EnvironmentCells, unseen_albedo: float | None
) -> Float32[np.ndarray, "f 3"]:
    """What each face sends: as it was seen, or one grey bounce where it was not."""
    if unseen_albedo is None:
        return np.zeros_like(faces.base_colour)
    grey = replace(faces, base_colour=np.full_like(faces.base_colour, unseen_albedo))
    is_seen = faces.confidence[:, None] > 0
    return np.where(is_seen, faces.base_colour, face_radiosity(grey, scene, cells))
