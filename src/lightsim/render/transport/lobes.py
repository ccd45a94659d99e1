"""Specular lobes of surface points: rays traced once for all skies, and the sun by its BRDF.

Roughness and metallic are those of the Principled model (Burley 2012). Dielectrics reflect 4 % at
normal incidence, metals their base colour. Asphalt and plaster also have a specular component: at
the grazing angles of cameras on cars, it is a third or more of their radiance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int32, Int64, UInt16

from lightsim.core.buffers import GBuffers
from lightsim.core.dome import Sun
from lightsim.core.equirect import uv_from_directions
from lightsim.core.mesh import MATTE_ROUGHNESS
from lightsim.core.rows import Rows
from lightsim.render.casters.embree import offset_origins
from lightsim.render.transport.faces import TILE_RAYS
from lightsim.render.transport.sides import SideFinder
from lightsim.render.transport.sky import EnvironmentCells

# Least roughness at pixel centres: normals of reconstructed meshes have errors of degrees, with
# which a sharper highlight would sparkle. Chosen; sensitivity not measured.
_MIN_AT_CENTRES = 0.3


@dataclass(frozen=True, eq=False)
class Lobes(Rows):
    """Surface points and their specular lobes.

    Args:
        ray_starts_world: start points of rays.
        normal_world, towards_camera: unit vectors.
        roughness: see `core.mesh.Material`.
        f0: reflectance at normal incidence; 0 for points that do not reflect.
    """

    ray_starts_world: Float32[np.ndarray, "g 3"]
    normal_world: Float32[np.ndarray, "g 3"]
    towards_camera: Float32[np.ndarray, "g 3"]
    roughness: Float32[np.ndarray, " g"]
    f0: Float32[np.ndarray, "g 3"]

    @staticmethod
    def none_on(
        points_world: Float[np.ndarray, "n 3"], normals_world: Float[np.ndarray, "n 3"]
    ) -> Lobes:
        """Return points with diffuse reflection only."""
        nothing = np.zeros((len(points_world), 3), np.float32)
        normals = normals_world.astype(np.float32)
        # The roughness is arbitrary, because F0 = 0 disables the lobe.
        rough = np.ones(len(nothing), np.float32)
        return Lobes(points_world.astype(np.float32), normals, normals, rough, nothing)

    def __len__(self) -> int:
        return len(self.f0)


@dataclass(frozen=True, eq=False)
class LobeTable:
    """Rays drawn from the lobes of points.

    Args:
        directions_uv: of each ray, in 65536ths of the dome's width and height.
        face_rows: row in the frame's faces that the ray meets, -1 for the sky.
        weights: reflected fraction of the ray's radiance, as a factor of F0 and an added constant.
        f0: reflectance at normal incidence.
    """

    directions_uv: UInt16[np.ndarray, "g k 2"]
    face_rows: Int32[np.ndarray, "g k"]
    weights: Float32[np.ndarray, "g k 2"]
    f0: Float32[np.ndarray, "g 3"]

    @property
    def albedo(self) -> Float32[np.ndarray, "g 3"]:
        """Fraction of a uniform light that each point's rays reflect; at most 1."""
        mean = self.weights.mean(axis=1)
        return self.f0 * mean[:, :1] + mean[:, 1:]

    def light(
        self, cells: EnvironmentCells, radiosity: Float32[np.ndarray, "f 3"]
    ) -> Float32[np.ndarray, "g 3"]:
        """Return the radiance that the points reflect of the sky without its sun, and of other
        surfaces."""
        from lightsim.render.transport.glossy_kernels import reflected_light

        assert cells.smooth is not None
        out = np.empty((len(self.f0), 3), dtype=np.float32)
        reflected_light(
            self.directions_uv,
            self.face_rows,
            self.weights,
            self.f0,
            cells.smooth,
            radiosity,
            out,
        )
        return out


def trace_lobes(
    finder: SideFinder,
    lobes: Lobes,
    shifts: Float32[np.ndarray, "g 2"],
    count: int,
    pattern_part: tuple[Int64[np.ndarray, " g"], int] | None = None,
) -> LobeTable:
    """Trace `count` rays of each point; `face_rows` contains sides (`render.transport.sides`).

    Args:
        shifts: in [0, 1), offsets of each point's pattern of rays.
        pattern_part: part of the pattern that each point uses, and the number of parts; None: all.
    """
    from lightsim.render.transport.glossy_kernels import reflected_rays

    total = len(lobes)
    which, parts = pattern_part or (np.zeros(total, np.int64), 1)
    table = LobeTable(
        np.empty((total, count, 2), dtype=np.uint16),
        np.empty((total, count), dtype=np.int32),
        np.empty((total, count, 2), dtype=np.float32),
        lobes.f0,
    )
    # Alpha is the GGX width: roughness squared, as in the Principled model.
    alphas = _alphas(lobes.roughness)
    tile = max(1, TILE_RAYS // count)
    for start in range(0, total, tile):
        part = slice(start, start + tile)
        normals = lobes.normal_world[part]
        directions = np.empty((len(normals), count, 3), dtype=np.float32)
        reflected_rays(
            normals,
            lobes.towards_camera[part],
            alphas[part],
            shifts[part],
            (which[part], parts, count),
            directions,
            table.weights[part],
        )
        uv = uv_from_directions(directions)
        # 16 bits resolve 0.005 degrees, at a third of the memory of float32 vectors.
        table.directions_uv[part] = np.minimum(uv * 65536.0, 65535.0).astype(np.uint16)
        origins = offset_origins(lobes.ray_starts_world[part], normals)
        sides = finder.met(np.repeat(origins, count, axis=0), directions.reshape(-1, 3))
        table.face_rows[part] = sides.reshape(-1, count)
    # Points with F0 = 0 do not reflect; Schlick's term alone would.
    table.weights[(lobes.f0 <= 0).all(axis=1)] = 0.0
    return table


def normal_reflectance(
    base_colour: Float32[np.ndarray, "g 3"], metallic: Float32[np.ndarray, " g"]
) -> Float32[np.ndarray, "g 3"]:
    """Return F0: 4 % for dielectrics (refractive index 1.5), the base colour for metals."""
    part = metallic[:, None]
    return ((1 - part) * 0.04 + part * base_colour).astype(np.float32)


def sun_in_lobes(lobes: Lobes, sun: Sun) -> Float32[np.ndarray, "g 3"]:
    """Return the radiance of the sun's reflection without occlusion.

    The lobe is widened by the disc, whose radius is halved on half vectors (compare Karis 2013,
    sphere lights), so that a mirror shows a highlight of finite radiance.
    """
    # The variances of lobe and disc add.
    alphas = np.hypot(_alphas(lobes.roughness), np.radians(sun.angular_radius_deg) / 2)
    direction = sun.direction_world / np.linalg.norm(sun.direction_world)
    out = np.empty_like(lobes.f0)
    for start in range(0, len(out), TILE_RAYS):
        part = slice(start, start + TILE_RAYS)
        normals, f0 = lobes.normal_world[part], lobes.f0[part]
        towards = np.broadcast_to(direction.astype(np.float32), normals.shape)
        lobe = specular_lobe(
            normals, lobes.towards_camera[part], towards, alphas[part].astype(np.float32)
        )
        fresnel = f0 * (1 - lobe[:, 1:]) + lobe[:, 1:]
        out[part] = np.where(f0 > 0, fresnel, 0.0) * lobe[:, :1] * sun.irradiance
    return out


def specular_lobe(
    normals: Float32[np.ndarray, "n 3"],
    towards_camera: Float32[np.ndarray, "n 3"],
    towards_light: Float32[np.ndarray, "n 3"],
    alphas: Float32[np.ndarray, " n"],
) -> Float32[np.ndarray, "n 2"]:
    """Return the BRDF without Fresnel times the light's cosine (1/sr), and Schlick's fraction of
    white."""
    from lightsim.render.transport.glossy_kernels import reflectance

    out = np.empty((len(normals), 2), dtype=np.float32)
    reflectance(normals, towards_camera, np.ascontiguousarray(towards_light), alphas, out)
    return out


def _alphas(roughness: Float[np.ndarray, " n"]) -> Float32[np.ndarray, " n"]:
    # The lower bound is a guard against division by 0 for mirrors.
    return np.maximum(np.square(roughness), 1e-3).astype(np.float32)


def pixel_lobes(
    gbuffers: GBuffers, pixel: Int64[np.ndarray, " n"], *, is_rough_only: bool
) -> Lobes | None:
    """Return lobes at the centres of pixels (flat numbers); None if the buffers have no material.

    Args:
        is_rough_only: leave out smooth surfaces, which are traced by samples
            (`render.transport.glossy`); otherwise their lobes are widened to what single points of
            a mesh can resolve.
    """
    if gbuffers.material is None or gbuffers.towards_camera_world is None:
        return None
    roughness, metallic = gbuffers.material.reshape(-1, 2)[pixel].T
    f0 = normal_reflectance(gbuffers.base_colour.reshape(-1, 3)[pixel], metallic)
    if is_rough_only:
        # Their rays are traced by samples, so they must not be counted twice.
        f0[roughness < MATTE_ROUGHNESS] = 0.0
    return Lobes(
        gbuffers.ray_starts_world.reshape(-1, 3)[pixel],
        gbuffers.normal_world.reshape(-1, 3)[pixel],
        gbuffers.towards_camera_world.reshape(-1, 3)[pixel],
        np.maximum(roughness, np.float32(_MIN_AT_CENTRES)),
        f0,
    )
