"""Surface samples within pixels, so that edges are anti-aliased."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32, Int64, UInt8

from lightsim.core.buffers import GBuffers
from lightsim.core.camera import PinholeCamera
from lightsim.core.frames import RigidTransform
from lightsim.core.mesh import MATTE_ROUGHNESS
from lightsim.core.rows import Rows
from lightsim.core.sensors import CameraFrame
from lightsim.render.gbuffers import BAND_RAYS, PrimaryHits, cast_primary_rays, surface_material
from lightsim.render.scene import FrameScene
from lightsim.render.transport.faces import TransportConfig

# Cosine above which neighbouring normals count as one surface (18 degrees). Chosen; sensitivity not
# measured.
_SAME_NORMAL = 0.95


@dataclass(frozen=True, eq=False)
class SurfacePoints(Rows):
    """Some of the samples, with the attributes of their surface.

    Args:
        rows: among the samples.
        towards_camera: unit vectors.
    """

    rows: Int64[np.ndarray, " k"]
    normal_world: Float32[np.ndarray, "k 3"]
    base_colour: Float32[np.ndarray, "k 3"]
    towards_camera: Float32[np.ndarray, "k 3"]
    depth_z_m: Float32[np.ndarray, " k"]
    roughness: Float32[np.ndarray, " k"]
    metallic: Float32[np.ndarray, " k"]


@dataclass(frozen=True, eq=False)
class PixelSamples:
    """Surfaces at `per_pixel` points of every pixel, without samples that show the sky.

    Args:
        per_pixel: points of each pixel.
        pixel: flat number of the pixel of each sample.
        number: of the sample within its pixel.
        ray_starts_world: of each sample, see core.buffers.GBuffers.
        base_colour: mean over the samples of a pixel; 0 without a surface.
        coverage: fraction of each pixel's samples that show a surface.
        edge: samples of pixels that show more than one surface; the samples of other pixels lie on
            the surface at the pixel's centre.
        glossy: samples on surfaces that reflect.
    """

    per_pixel: int
    pixel: Int32[np.ndarray, " n"]
    number: UInt8[np.ndarray, " n"]
    ray_starts_world: Float32[np.ndarray, "n 3"]
    base_colour: Float32[np.ndarray, "h w 3"]
    coverage: Float32[np.ndarray, "h w"]
    edge: SurfacePoints
    glossy: SurfacePoints

    @property
    def fraction(self) -> Float32[np.ndarray, " p"]:
        """Weight of a sample in the mean of its pixel's surface samples, for each pixel."""
        count = np.bincount(self.pixel, minlength=self.coverage.size)
        return (1.0 / np.maximum(count, 1)).astype(np.float32)

    def add_means(
        self,
        image: Float32[np.ndarray, "h w c"],
        rows: Int64[np.ndarray, " k"] | slice,
        values: Float32[np.ndarray, "k c"],
        fraction: Float32[np.ndarray, " p"],
    ) -> Float32[np.ndarray, "h w c"]:
        """Add each pixel's values times `fraction` to `image` in place, and return it."""
        from lightsim.render.transport.kernels import add_to_pixels

        add_to_pixels(self.pixel[rows], fraction, values, image.reshape(fraction.size, -1))
        return image

    @property
    def black(self) -> Float32[np.ndarray, "h w 3"]:
        """Image of zeros."""
        return np.zeros((*self.coverage.shape, 3), dtype=np.float32)


def render_samples(
    scene: FrameScene,
    camera: PinholeCamera,
    view: CameraFrame | RigidTransform,
    gbuffers: GBuffers,
    config: TransportConfig,
    is_wanted: Bool[np.ndarray, "h w"] | None = None,
) -> PixelSamples:
    """Return surface samples at `config.pixel_samples` points of every pixel, or of the wanted
    ones.

    Args:
        view: a recorded frame, or the pose world_from_camera of a static camera.
        gbuffers: of the same view, to detect edges.
        is_wanted: pixels to sample; None: all.
    """
    count = config.pixel_samples
    corners = camera.pixel_centres().reshape(-1, 2) - 0.5
    # Samples are counted from the pixel's corner.
    wanted = np.arange(len(corners)) if is_wanted is None else np.flatnonzero(is_wanted)
    offsets = sample_offsets(count)
    band = max(1, BAND_RAYS // count)
    gathered = _SampleAccumulator(gbuffers, count)
    for start in range(0, len(wanted), band):
        pixels = wanted[start : start + band]
        uv = (corners[pixels, None] + offsets).reshape(-1, 2)
        gathered.add(scene, cast_primary_rays(scene, camera, view, uv), pixels, config)
    return gathered.result()


def sample_offsets(count: int) -> Float[np.ndarray, "n 2"]:
    """Return points of the unit square, one in each cell of a grid, no two in one row or column.

    Correlated multi-jittered sampling (Kensler 2013) without jitter; the centre for a single point.
    """
    # Both coordinates have `count` different values, so edges of any direction are resolved finely.
    side = round(np.sqrt(count))
    i, j = np.divmod(np.arange(count), side)
    return np.stack([(i + (j + 0.5) / side) / side, (j + (i + 0.5) / side) / side], axis=1)


class _SampleAccumulator:
    """Samples of the pixels so far, band by band.

    Arrays have their greatest possible length: memory pages that are never written cost nothing.
    """

    def __init__(self, gbuffers: GBuffers, per_pixel: int) -> None:
        size = gbuffers.depth_z_m.size
        self._gbuffers = gbuffers
        self._per_pixel = per_pixel
        self._total = 0
        # One more sample a pixel, for pixels that only their centre hits (`result`).
        self._pixel = np.empty(size * per_pixel + size, dtype=np.int32)
        self._number = np.empty(len(self._pixel), dtype=np.uint8)
        self._position = np.empty((len(self._pixel), 3), dtype=np.float32)
        self._colour = np.zeros((size, 3), dtype=np.float32)
        self._coverage = np.zeros(size, dtype=np.float32)
        self._edges: list[SurfacePoints] = []
        self._glossy: list[SurfacePoints] = []

    def add(
        self,
        scene: FrameScene,
        surfaces: PrimaryHits,
        pixels: Int64[np.ndarray, " p"],
        config: TransportConfig,
    ) -> None:
        """Add the samples of some pixels."""
        local, number = np.divmod(surfaces.rows, self._per_pixel)
        count = np.bincount(local, minlength=len(pixels))
        for c in range(3):
            total = np.bincount(local, surfaces.base_colour[:, c], minlength=len(pixels))
            self._colour[pixels, c] = total / np.maximum(count, 1)
        self._coverage[pixels] = count / self._per_pixel
        is_edge = np.zeros(len(pixels), dtype=bool)
        if self._per_pixel > 1:
            # A silhouette against the sky.
            is_edge = (count > 0) & (count < self._per_pixel)
            is_edge[local[_differs_from_centre(scene, surfaces, pixels[local], self._gbuffers)]] = (
                True
            )
        roughness, metallic = surface_material(scene, surfaces.hits).T
        is_glossy = (roughness < MATTE_ROUGHNESS) & (config.glossy_rays > 0)
        for gathered, chosen in ((self._edges, is_edge[local]), (self._glossy, is_glossy)):
            points = _points(surfaces, np.flatnonzero(chosen), roughness, metallic)
            gathered.append(replace(points, rows=points.rows + self._total))
        self._append(pixels[local], number, surfaces.offset_world)

    def _append(
        self,
        pixel: Int64[np.ndarray, " n"],
        number: Int64[np.ndarray, " n"],
        position: Float32[np.ndarray, "n 3"],
    ) -> None:
        new = slice(self._total, self._total + len(pixel))
        self._pixel[new], self._number[new], self._position[new] = pixel, number, position
        self._total = new.stop

    def result(self) -> PixelSamples:
        """Return all samples; pixels with a surface only at their centre are lit there."""
        buffers = self._gbuffers
        shape = buffers.depth_z_m.shape
        # A thin object can lie between all samples and still hit the centre.
        missed = np.flatnonzero((self._coverage == 0) & buffers.has_surface.reshape(-1))
        positions = buffers.ray_starts_world.reshape(-1, 3)
        self._append(missed, np.zeros_like(missed), positions[missed])
        self._colour[missed] = buffers.base_colour.reshape(-1, 3)[missed]
        return PixelSamples(
            self._per_pixel,
            self._pixel[: self._total],
            self._number[: self._total],
            self._position[: self._total],
            self._colour.reshape(*shape, 3),
            self._coverage.reshape(shape),
            SurfacePoints.joined(self._edges),
            SurfacePoints.joined(self._glossy),
        )


def _differs_from_centre(
    scene: FrameScene, surfaces: PrimaryHits, pixel: Int64[np.ndarray, " n"], gbuffers: GBuffers
) -> Bool[np.ndarray, " n"]:
    """Return the samples that show another surface than the centre of their pixel."""
    from lightsim.render.transport.kernels import SAME_SURFACE_M, SAME_SURFACE_PER_M

    normal = gbuffers.normal_world.reshape(-1, 3)[pixel]
    gap = surfaces.position_world - gbuffers.position_world.reshape(-1, 3)[pixel]
    depth = gbuffers.depth_z_m.reshape(-1)[pixel]
    # Without a surface at the centre the tolerance is 0: all samples count as another surface.
    tolerance = np.where(np.isfinite(depth), SAME_SURFACE_PER_M * depth + SAME_SURFACE_M, 0.0)
    far = np.abs(np.einsum("nc,nc->n", gap, normal)) > tolerance
    bent = np.einsum("nc,nc->n", surfaces.normal_world, normal) < _SAME_NORMAL
    other = scene.actor_index[surfaces.hits.mesh_index] != gbuffers.actor_index.reshape(-1)[pixel]
    return far | bent | other


def _points(
    surfaces: PrimaryHits,
    rows: Int64[np.ndarray, " k"],
    roughness: Float32[np.ndarray, " n"],
    metallic: Float32[np.ndarray, " n"],
) -> SurfacePoints:
    return SurfacePoints(
        rows,
        surfaces.normal_world[rows],
        surfaces.base_colour[rows],
        surfaces.towards_camera[rows],
        surfaces.depth_z_m[rows],
        roughness[rows],
        metallic[rows],
    )
