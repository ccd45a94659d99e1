"""What pixels show between their centres, so that edges are averaged, not stair-stepped."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32, Int64, UInt8

from lightsim.core.buffers import GBuffers
from lightsim.core.camera import PinholeCamera
from lightsim.core.casting import RayHits
from lightsim.core.frames import RigidTransform
from lightsim.core.sensors import CameraFrame
from lightsim.render.faces import TransportConfig
from lightsim.render.gbuffers import BAND_RAYS, GBufferConfig, SeenSurfaces, see
from lightsim.render.scene import FrameScene

_SAME_NORMAL = 0.95
"""Cosine above which neighbouring normals count as one surface."""


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Some of the samples, with all that is known of their surface.

    Args:
        rows: among the samples.
        towards_camera: unit.
    """

    rows: Int64[np.ndarray, " k"]
    position_world: Float32[np.ndarray, "k 3"]
    normal_world: Float32[np.ndarray, "k 3"]
    base_colour: Float32[np.ndarray, "k 3"]
    towards_camera: Float32[np.ndarray, "k 3"]
    depth_z_m: Float32[np.ndarray, " k"]
    roughness: Float32[np.ndarray, " k"]
    metallic: Float32[np.ndarray, " k"]


@dataclass(frozen=True, eq=False)
class PixelSamples:
    """Surfaces at `per_pixel` points of every pixel. Samples that see the sky are left out.

    Args:
        per_pixel: how many points were looked at.
        pixel: flat number of the pixel of each sample.
        number: of the sample within its pixel.
        position_world: of each sample.
        base_colour: mean over the samples of a pixel; 0 without a surface.
        coverage: share of each pixel's samples that show a surface.
        edge: samples of pixels that show more than one surface; the samples of other pixels lie
            on the surface at the pixel's centre.
        glossy: samples on surfaces that reflect.
    """

    per_pixel: int
    pixel: Int32[np.ndarray, " n"]
    number: UInt8[np.ndarray, " n"]
    position_world: Float32[np.ndarray, "n 3"]
    base_colour: Float32[np.ndarray, "h w 3"]
    coverage: Float32[np.ndarray, "h w"]
    edge: SurfacePoints
    glossy: SurfacePoints

    @property
    def share(self) -> Float32[np.ndarray, " p"]:
        """Weight of a sample in the mean of its pixel's surface samples, for each pixel."""
        count = np.bincount(self.pixel, minlength=self.coverage.size)
        return (1.0 / np.maximum(count, 1)).astype(np.float32)

    def pixel_mean(
        self,
        rows: Int64[np.ndarray, " k"] | slice,
        values: Float32[np.ndarray, "k c"],
        share: Float32[np.ndarray, " p"],
    ) -> Float32[np.ndarray, "h w c"]:
        """Sum of each pixel's values times `share`."""
        from lightsim.render.transport_kernels import add_to_pixels

        out = np.zeros((self.coverage.size, values.shape[1]), dtype=np.float32)
        add_to_pixels(self.pixel[rows], share, values, out)
        return out.reshape(*self.coverage.shape, -1)


def render_samples(
    scene: FrameScene,
    camera: PinholeCamera,
    view: CameraFrame | RigidTransform,
    gbuffers: GBuffers,
    config: TransportConfig,
) -> PixelSamples:
    """Look at `config.pixel_samples` points of every pixel.

    Args:
        gbuffers: of the same view, to tell edges.
    """
    count = config.pixel_samples
    width = camera.width_px
    corners = camera.pixel_centres() - 0.5
    offsets = sample_offsets(count)
    band = max(1, BAND_RAYS // (width * count))
    parts = []
    for start in range(0, camera.height_px, band):
        uv = (corners[start : start + band, :, None] + offsets).reshape(-1, 2)
        seen = see(scene, camera, view, uv, GBufferConfig())
        parts.append(_band(scene, seen, start * width, gbuffers, config))
    missed = _missed(parts, gbuffers)
    pixel = np.concatenate([p.pixel for p in parts] + [missed]).astype(np.int32)
    starts = np.cumsum([0] + [len(p.pixel) for p in parts])
    positions = gbuffers.position_world.reshape(-1, 3)
    out = PixelSamples(
        count,
        pixel,
        np.concatenate([p.number for p in parts] + [np.zeros(len(missed), np.uint8)]),
        np.concatenate([p.position_world for p in parts] + [positions[missed]]),
        np.zeros_like(gbuffers.base_colour),
        (np.concatenate([p.count for p in parts]) / np.float32(count))
        .astype(np.float32)
        .reshape(gbuffers.depth_z_m.shape),
        _joined([p.edge for p in parts], starts),
        _joined([p.glossy for p in parts], starts),
    )
    out.base_colour.reshape(-1, 3)[:] = np.concatenate([p.colour for p in parts])
    out.base_colour.reshape(-1, 3)[missed] = gbuffers.base_colour.reshape(-1, 3)[missed]
    return out


def sample_offsets(count: int) -> Float[np.ndarray, "n 2"]:
    """Points of the unit square, one in each cell of a grid, no two in one row or column (Kensler
    2013, correlated multi-jittered sampling, without jitter). The centre for a single one."""
    side = round(np.sqrt(count))
    i, j = np.divmod(np.arange(count), side)
    return np.stack([(i + (j + 0.5) / side) / side, (j + (i + 0.5) / side) / side], axis=1)


@dataclass(frozen=True, eq=False)
class _Band:
    """The samples of some rows of pixels; `count` and `colour` for each pixel of them."""

    pixel: Int64[np.ndarray, " n"]
    number: UInt8[np.ndarray, " n"]
    position_world: Float32[np.ndarray, "n 3"]
    count: Int64[np.ndarray, " p"]
    colour: Float32[np.ndarray, "p 3"]
    edge: SurfacePoints
    glossy: SurfacePoints


def _band(
    scene: FrameScene,
    seen: SeenSurfaces,
    first_pixel: int,
    gbuffers: GBuffers,
    config: TransportConfig,
) -> _Band:
    per_pixel = config.pixel_samples
    width = gbuffers.depth_z_m.shape[1]
    rows_left = gbuffers.depth_z_m.size - first_pixel
    pixels = min(max(1, BAND_RAYS // (width * per_pixel)) * width, rows_left)
    local = seen.rows // per_pixel
    count = np.bincount(local, minlength=pixels)
    colour = np.stack(
        [np.bincount(local, seen.base_colour[:, c], minlength=pixels) for c in range(3)], axis=1
    )
    colour = (colour / np.maximum(count, 1)[:, None]).astype(np.float32)
    is_edge = np.zeros(pixels, dtype=bool)
    if per_pixel > 1:
        is_edge = (count > 0) & (count < per_pixel)
        is_edge[local[_is_unlike(scene, seen, first_pixel + local, gbuffers)]] = True
    roughness, metallic = surface_material(scene, seen.hits)
    is_glossy = (roughness < config.glossy_max_roughness) & (config.glossy_rays > 0)
    parts = [
        _points(seen, np.flatnonzero(chosen), roughness, metallic)
        for chosen in (is_edge[local], is_glossy)
    ]
    number = (seen.rows % per_pixel).astype(np.uint8)
    return _Band(first_pixel + local, number, seen.position_world, count, colour, *parts)


def _is_unlike(
    scene: FrameScene, seen: SeenSurfaces, pixel: Int64[np.ndarray, " n"], gbuffers: GBuffers
) -> Bool[np.ndarray, " n"]:
    """Whether samples show another surface than the centre of their pixel."""
    normal = gbuffers.normal_world.reshape(-1, 3)[pixel]
    gap = seen.position_world - gbuffers.position_world.reshape(-1, 3)[pixel]
    depth = gbuffers.depth_z_m.reshape(-1)[pixel]
    tolerance = np.where(np.isfinite(depth), 0.004 * depth + 0.02, 0.0)
    far = np.abs(np.einsum("nc,nc->n", gap, normal)) > tolerance
    bent = np.einsum("nc,nc->n", seen.normal_world, normal) < _SAME_NORMAL
    other = scene.actor_index[seen.hits.mesh_index] != gbuffers.actor_index.reshape(-1)[pixel]
    return far | bent | other


def surface_material(
    scene: FrameScene, hits: RayHits
) -> tuple[Float32[np.ndarray, " n"], Float32[np.ndarray, " n"]]:
    """Roughness and metallic of faces that cameras see."""
    values = np.zeros((len(hits.face_index), 2), dtype=np.float32)
    order = np.argsort(hits.mesh_index, kind="stable")
    bounds = np.searchsorted(hits.mesh_index[order], np.arange(len(scene.camera_meshes) + 1))
    for k, mesh in enumerate(scene.camera_meshes):
        rows = order[bounds[k] : bounds[k + 1]]
        known = np.array([(m.roughness, m.metallic) for m in mesh.materials], dtype=np.float32)
        if mesh.face_material is None:
            values[rows] = known[0]
        else:
            values[rows] = known[mesh.face_material[hits.face_index[rows]]]
    return values[:, 0], values[:, 1]


def _points(
    seen: SeenSurfaces,
    rows: Int64[np.ndarray, " k"],
    roughness: Float32[np.ndarray, " n"],
    metallic: Float32[np.ndarray, " n"],
) -> SurfacePoints:
    return SurfacePoints(
        rows,
        seen.position_world[rows],
        seen.normal_world[rows],
        seen.base_colour[rows],
        seen.towards_camera[rows],
        seen.depth_z_m[rows],
        roughness[rows],
        metallic[rows],
    )


def _joined(parts: list[SurfacePoints], starts: Int64[np.ndarray, " b"]) -> SurfacePoints:
    names = [f.name for f in fields(SurfacePoints)][1:]
    rows = np.concatenate([p.rows + s for p, s in zip(parts, starts[:-1], strict=True)])
    return SurfacePoints(rows, *(np.concatenate([getattr(p, n) for p in parts]) for n in names))


def _missed(parts: list[_Band], gbuffers: GBuffers) -> Int64[np.ndarray, " m"]:
    """Pixels whose centre alone meets a surface: they keep the light at their centre."""
    count = np.concatenate([p.count for p in parts])
    return np.flatnonzero((count == 0) & gbuffers.has_surface.reshape(-1))
