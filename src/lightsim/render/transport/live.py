"""A traced frame kept on a device and lit there: the sun moves, nothing goes through the host.

`render.transport.light` does the same sums in numba and numpy. What is uploaded for a further sun
are the directions of its disc; for a further sky also the sky's cells.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float32, Int, Int32, UInt16
from torch.nn.functional import embedding_bag

from lightsim.core.buffers import GBuffers
from lightsim.core.dome import Sun
from lightsim.errors import InputError
from lightsim.render.casters.mitsuba import MitsubaBackend
from lightsim.render.scene import FrameScene
from lightsim.render.transport.faces import FaceSamples, TransportConfig
from lightsim.render.transport.kernels import BLOCKED
from lightsim.render.transport.live_sun import DeviceSunRays
from lightsim.render.transport.matrix import PointTransport, TransportMatrix
from lightsim.render.transport.sky import EnvironmentCells


@dataclass(frozen=True, eq=False)
class LiveLight:
    """One sky's light on a frame, as tensors on its device; as `core.buffers.ShadowBuffers`,
    irradiance / pi. Images are made when asked for; pixels without a surface are 0.

    Args:
        frame: what is lit.
        sun_cosine: of the pixels with a surface, 0 where the sun stands behind.
        sun_seen: visible fraction of the disc.
        sun_colour: irradiance / pi of the sun on a surface that faces it.
        sky: light of the sky with visibility, then without.
        bounce: light of other surfaces.
    """

    frame: LiveFrame
    sun_cosine: Float32[torch.Tensor, " p"]
    sun_seen: Float32[torch.Tensor, " p"]
    sun_colour: Float32[torch.Tensor, "3"]
    sky: tuple[Float32[torch.Tensor, "p 3"], Float32[torch.Tensor, "p 3"]]
    bounce: Float32[torch.Tensor, "p 3"]

    @property
    def sun_visibility(self) -> Float32[torch.Tensor, "h w"]:
        """Fraction of the solar disc seen."""
        return self.frame.as_image(self.sun_seen[:, None])[..., 0]

    @property
    def shaded(self) -> Float32[torch.Tensor, "h w 3"]:
        """All light: sun and sky with visibility, and bounce."""
        return self.frame.as_image(self._shaded)

    @property
    def radiance(self) -> Float32[torch.Tensor, "h w 3"]:
        """Base colour times `shaded`: what a camera sees, but for reflections and the sky."""
        return self.frame.as_image(self._shaded * self.frame.base_colour)

    @property
    def unshadowed(self) -> Float32[torch.Tensor, "h w 3"]:
        """Sun and sky without visibility and without bounce."""
        return self.frame.as_image(self._sun(self.sun_cosine) + self.sky[1])

    @property
    def ratio(self) -> Float32[torch.Tensor, "h w 3"]:
        """Shadow ratio S on direct light; 1 where no light arrives."""
        direct = self._sun(self.sun_cosine * self.sun_seen) + self.sky[0]
        whole = self._sun(self.sun_cosine) + self.sky[1]
        ratio = torch.where(whole > 0, direct / whole, torch.ones_like(whole))
        return self.frame.as_image(ratio, 1.0)

    @cached_property
    def _shaded(self) -> Float32[torch.Tensor, "p 3"]:
        return self._sun(self.sun_cosine * self.sun_seen) + self.sky[0] + self.bounce

    def _sun(self, fraction: Float32[torch.Tensor, " p"]) -> Float32[torch.Tensor, "p 3"]:
        return fraction[:, None] * self.sun_colour


class LiveFrame:
    """A traced frame on a device; call it with skies.

    Light belongs to pixel centres, as relighting uses it: no anti-aliasing and no reflections.
    The table may have been traced by any caster. The arrays of a sky must not change in place.
    """

    def __init__(
        self,
        table: TransportMatrix,
        scene: FrameScene,
        gbuffers: GBuffers,
        config: TransportConfig,
        backend: MitsubaBackend = "cuda",
    ) -> None:
        """
        Args:
            table: from `trace_transport` with the same scene, buffers and config, without samples.
            backend: "cuda" (OptiX, torch on CUDA) or "llvm" (the processor).

        Raises:
            InputError: the table has samples of pixels, or the device is not usable here.
        """
        if table.detail is not None:
            raise InputError(
                "a frame on a device is lit at pixel centres",
                got="a light transport matrix with samples of pixels",
                remedy="Trace it without samples, or light it by render.light.",
            )
        has_surface = gbuffers.has_surface
        starts, normals = gbuffers.ray_starts_world, gbuffers.normal_world
        faces = table.points.faces
        self.rays = DeviceSunRays(
            scene.meshes, starts[has_surface], normals[has_surface], faces, config, backend
        )
        self.device = self.rays.device
        self._shape = has_surface.shape
        self._pixel = self._upload(table.pixel)
        self._spread = self._upload(table.upsampling.rows), self._upload(table.upsampling.weights)
        self.base_colour = self._upload(gbuffers.base_colour[has_surface])
        self._faces = _DeviceFaces(faces, self.device)
        self._points = _DevicePoints(table.points, self.device)
        self._sky: SkySums | None = None

    def __call__(self, sky: EnvironmentCells) -> LiveLight:
        """Light under a sky of `prepare_sky`.

        The sky's own sums are kept for the next call, and taken again only where `sky.radiance`
        is another array: for the same sky with a moved sun, call with `replace(sky, sun=...)`.
        On CUDA the sums may still run when this returns; torch's own rules of order hold.
        """
        sums = self.sky_sums(sky)
        sun = sky.sun
        bounce = self.upsampling(self.bounce(sums, sun))
        if sun is None:
            dark = torch.zeros(self.rays.pixel_count, device=self.device)
            black = torch.zeros(3, device=self.device)
            return LiveLight(self, dark, dark, black, sums.pixels, bounce)
        cosine, seen = self.rays.of_pixels(sun)
        return LiveLight(self, cosine, seen, self._sun_colour(sun), sums.pixels, bounce)

    @property
    def held_bytes(self) -> int:
        """Of the device's memory, without ray casting structures and what a call needs."""
        tensors = [self._pixel, *self._spread, self.base_colour]
        tensors += [*self._faces.tensors, *self._points.tensors]
        if self._sky is not None:
            tensors += [self._sky.faces, *self._sky.pixels]
        return self.rays.held_bytes + sum(t.numel() * t.element_size() for t in tensors)

    def sky_sums(self, sky: EnvironmentCells) -> SkySums:
        """All that does not depend on the sun."""
        if self._sky is None or self._sky.made_from is not sky.radiance:
            cells = self._upload(sky.radiance)
            both = self.upsampling(torch.cat(self._points.sky(cells), dim=1))
            pixels = both[:, :3].contiguous(), both[:, 3:].contiguous()
            self._sky = SkySums(sky.radiance, self._faces.sky(cells), pixels)
        return self._sky

    def bounce(self, sums: SkySums, sun: Sun | None) -> Float32[torch.Tensor, "t 3"]:
        """Light of other surfaces on the traced points."""
        arriving = sums.faces
        if sun is not None:
            arriving = arriving + self.rays.of_faces(sun)[:, None] * self._sun_colour(sun)
        return self._points.bounce(self._faces.radiosity(arriving))

    def upsampling(self, values: Float32[torch.Tensor, "t c"]) -> Float32[torch.Tensor, "p c"]:
        """Values of the traced points at all pixels with a surface."""
        rows, weights = self._spread
        if not len(rows):
            return values.new_zeros((0, values.shape[1]))
        return embedding_bag(rows, values, mode="sum", per_sample_weights=weights)

    def as_image(
        self, values: Float32[torch.Tensor, "p c"], elsewhere: float = 0.0
    ) -> Float32[torch.Tensor, "h w c"]:
        """Values of the pixels with a surface in their places."""
        height, width = self._shape
        image = values.new_full((height * width, values.shape[1]), elsewhere)
        return image.index_copy_(0, self._pixel, values).reshape(height, width, -1)

    def _sun_colour(self, sun: Sun) -> Float32[torch.Tensor, "3"]:
        return self._upload((sun.irradiance / np.pi).astype(np.float32))

    def _upload(self, values: Float32[np.ndarray, "*n"] | Int[np.ndarray, "*n"]) -> torch.Tensor:
        return torch.from_numpy(values).to(self.device)


@dataclass(frozen=True, eq=False)
class SkySums:
    """What a sky without its sun brings: to faces, and to pixels with and without visibility."""

    made_from: Float32[np.ndarray, "c 3"]
    faces: Float32[torch.Tensor, "f 3"]
    pixels: tuple[Float32[torch.Tensor, "p 3"], Float32[torch.Tensor, "p 3"]]


class _DeviceFaces:
    """The faces that rays meet; rays that bring nothing look up a row of zeros at the end."""

    def __init__(self, faces: FaceSamples, device: torch.device) -> None:
        cells, next_rows = faces.sky_cells, faces.next_rows
        self._is_blocked = torch.from_numpy(cells == BLOCKED).to(device)
        self._cells = _indices(cells, device)
        self._colour = torch.from_numpy(faces.base_colour).to(device)
        self._bounces = faces.bounces
        self._next = None
        if next_rows is not None:
            met = np.where(next_rows < 0, len(next_rows), next_rows)
            self._next = torch.from_numpy(met.astype(np.int32)).to(device)

    @property
    def tensors(self) -> list[torch.Tensor]:
        """All that lies on the device."""
        more = [] if self._next is None else [self._next]
        return [self._is_blocked, self._cells, self._colour, *more]

    def sky(self, cells: Float32[torch.Tensor, "c 3"]) -> Float32[torch.Tensor, "f 3"]:
        """Mean of the sky over each face's rays."""
        return _mean_rows(self._cells.masked_fill(self._is_blocked, len(cells)), _padded(cells))

    def radiosity(self, arriving: Float32[torch.Tensor, "f 3"]) -> Float32[torch.Tensor, "f 3"]:
        """What the faces send out of it and, with further bounces, of what others send them."""
        first = self._colour * arriving
        if not self._cells.shape[1]:
            return torch.zeros_like(first)
        if self._next is None:
            return first
        total = first
        for _ in range(self._bounces - 1):
            total = first + self._colour * _mean_rows(self._next, _padded(total))
        return total


class _DevicePoints:
    """Rays of the traced points: all for the sky, those that meet faces once more in a row."""

    def __init__(self, points: PointTransport, device: torch.device) -> None:
        is_met = points.face_rows >= 0
        met = points.face_rows[is_met]
        counts = is_met.sum(axis=1)
        # Rows and the places where points begin must have one type.
        whole = np.int32 if len(met) < 2**31 else np.int64
        begin = np.cumsum(counts) - counts
        self._rays = points.sky_cells.shape[1]
        self._cells = _indices(points.sky_cells, device)
        self._is_met = torch.from_numpy(is_met).to(device)
        self._met = torch.from_numpy(met.astype(whole)).to(device)
        self._begin = torch.from_numpy(begin.astype(whole)).to(device)

    @property
    def tensors(self) -> list[torch.Tensor]:
        """All that lies on the device."""
        return [self._cells, self._is_met, self._met, self._begin]

    def sky(
        self, cells: Float32[torch.Tensor, "c 3"]
    ) -> tuple[Float32[torch.Tensor, "t 3"], Float32[torch.Tensor, "t 3"]]:
        """Mean of the sky over each point's rays: open ones, and all."""
        padded = _padded(cells)
        is_open = _mean_rows(self._cells.masked_fill(self._is_met, len(cells)), padded)
        return is_open, _mean_rows(self._cells, padded)

    def bounce(self, radiosity: Float32[torch.Tensor, "f 3"]) -> Float32[torch.Tensor, "t 3"]:
        """Mean light of the faces that each point's rays meet."""
        if not len(self._met):
            return radiosity.new_zeros((len(self._begin), 3))
        return embedding_bag(self._met, radiosity, self._begin, mode="sum") / self._rays


def _indices(cells: UInt16[np.ndarray, "n k"], device: torch.device) -> Int32[torch.Tensor, "n k"]:
    # Torch cannot index with uint16.
    return torch.from_numpy(cells.astype(np.int32)).to(device)


def _padded(values: Float32[torch.Tensor, "v c"]) -> Float32[torch.Tensor, "w c"]:
    return torch.cat([values, values.new_zeros((1, values.shape[1]))])


def _mean_rows(
    rows: Int32[torch.Tensor, "n k"], values: Float32[torch.Tensor, "v c"]
) -> Float32[torch.Tensor, "n c"]:
    if not rows.numel():
        return values.new_zeros((len(rows), values.shape[1]))
    return embedding_bag(rows, values, mode="sum") / rows.shape[1]
