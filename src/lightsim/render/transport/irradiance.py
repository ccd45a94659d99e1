"""Light on arbitrary surface points (mesh vertices, evidence samples), for delighting."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float, Float32

from lightsim.core.dome import SkyDome
from lightsim.render.scene import FrameScene
from lightsim.render.transport.faces import FaceSamples, FaceTable, hashed_shifts
from lightsim.render.transport.light import light_points, light_table
from lightsim.render.transport.sky import SkyCells, prepare_sky
from lightsim.render.transport.table import TransportConfig, static_face_table, trace_points

_TILE_POINTS = 1 << 16


@dataclass(frozen=True)
class IrradianceConfig:
    """Light on surface points."""

    transport: TransportConfig = field(default_factory=lambda: TransportConfig(sky_rays=64))
    """Numbers of rays; pixel settings are not used."""
    bounce_albedo: float | None = None
    """One bounce off surfaces of this grey albedo; None leaves the bounce out. A constant, since
    the true base colour is what delighting is looking for."""


@dataclass(frozen=True, eq=False)
class PointIrradiance:
    """Light on n points.

    Args:
        sun_visibility: fraction of the solar disc seen, 0 behind the surface's own horizon.
        sky_visibility: cosine-weighted fraction of the hemisphere that is open.
        sun: irradiance / pi, RGB, that the sun gives.
        sky: the part of the open sky.
        bounce: the part of other surfaces.
        bounce_of_sky: what of `bounce` is skylight; the rest is sunlight.
    """

    sun_visibility: Float32[np.ndarray, " n"]
    sky_visibility: Float32[np.ndarray, " n"]
    sun: Float32[np.ndarray, "n 3"]
    sky: Float32[np.ndarray, "n 3"]
    bounce: Float32[np.ndarray, "n 3"]
    bounce_of_sky: Float32[np.ndarray, "n 3"]

    @property
    def irradiance_over_pi(self) -> Float32[np.ndarray, "n 3"]:
        """RGB of sun, sky and bounce; a white Lambert surface shows it."""
        return self.sun + self.sky + self.bounce

    @staticmethod
    def zeros(count: int) -> PointIrradiance:
        """Darkness, to be filled in."""
        one, two = (np.zeros(count, dtype=np.float32) for _ in range(2))
        return PointIrradiance(
            one, two, *(np.zeros((count, 3), dtype=np.float32) for _ in range(4))
        )


def irradiance_at(
    points_world: Float[np.ndarray, "n 3"],
    normals_world: Float[np.ndarray, "n 3"],
    scene: FrameScene,
    dome: SkyDome,
    config: IrradianceConfig | None = None,
    seed: int = 0,
    faces: FaceTable | None = None,
) -> PointIrradiance:
    """Light of a dome on surface points with unit normals, in frame `world`.

    Scenes without actors come from `render.scene.without_actors`.

    Args:
        faces: what an earlier call with the same scene, rays and seed has traced already
            (`static_face_table`); it grows, which makes many small calls cheap.
    """
    config = config or IrradianceConfig()
    rays = config.transport
    if config.bounce_albedo is None:
        rays = replace(rays, face_rays=0)
    cells = prepare_sky(dome)
    table = static_face_table(scene, rays, seed) if faces is None else faces
    found = PointIrradiance.zeros(len(points_world))
    for start in range(0, len(points_world), _TILE_POINTS):
        part = slice(start, start + _TILE_POINTS)
        numbers = np.arange(start, min(start + _TILE_POINTS, len(points_world)), dtype=np.int64)
        tile = _tile(
            (points_world[part].astype(np.float32), normals_world[part].astype(np.float32)),
            hashed_shifts(numbers, seed),
            scene,
            (cells, table),
            replace(config, transport=rays),
        )
        for name, values in vars(tile).items():
            getattr(found, name)[part] = values
    return found


def _tile(
    surface: tuple[Float32[np.ndarray, "n 3"], Float32[np.ndarray, "n 3"]],
    shifts: Float32[np.ndarray, "n 2"],
    scene: FrameScene,
    shared: tuple[SkyCells, FaceTable],
    config: IrradianceConfig,
) -> PointIrradiance:
    points, normals = surface
    cells, face_table = shared
    table = trace_points(scene, points, normals, shifts, config.transport, face_table)
    if config.bounce_albedo is not None:
        table = replace(table, faces=_grey(table.faces, config.bounce_albedo))
    lit = light_points(table, scene, points, normals, cells, config.transport)
    bounce_of_sky = lit.bounce
    if cells.sun is not None and config.bounce_albedo is not None:
        no_sun = SkyCells(cells.radiance, None)
        bounce_of_sky = light_table(table, scene.caster, no_sun)[:, 3:6]
    return PointIrradiance(
        lit.sun_visibility, table.openness, lit.direct_sun, lit.sky, lit.bounce, bounce_of_sky
    )


def _grey(faces: FaceSamples, albedo: float) -> FaceSamples:
    return replace(faces, base_colour=np.full_like(faces.base_colour, albedo))
