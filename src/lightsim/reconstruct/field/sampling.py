"""Sample distances along training rays, and the field (background or actor) of each sample."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

# The values below were not measured alone; training as a whole is
# (docs/benchmarks/reconstruction.md).

# Least sample distance, in metres.
_NEAREST_M = 0.5
# Greatest sample distance of rays without an expected surface, in metres.
_FARTHEST_M = 200.0
# Number of samples around the expected surface.
_NEAR_SAMPLES = 8
# Number of samples in the free space before it.
_FREE_SAMPLES = 4
# Half width in metres of the band around the expected surface at distance t, over (1 + t / 40).
_NEAR_HALF_M = 0.4
# Number of samples of a ray in occupied space: UniSim's steps of 20 cm in 5 m of occupied space,
# the median on street 0. The expected depth is that of the sample behind the surface, so the zero
# level of the field is half a step (10 cm) too near; fewer samples increase this offset.
_MARCHED_SAMPLES = 25
# Sample density in boxes of actors relative to occupied space: UniSim's steps of 5 and 20 cm.
_BOX_DENSITY = 4.0


@dataclass(frozen=True, eq=False)
class RayBatch:
    """Rays of one step as tensors; attributes as in `ray_pool.RayPool`."""

    origin: Float[Tensor, "r 3"]
    direction: Float[Tensor, "r 3"]
    slot_actor: Int[Tensor, "r 2"]
    slot_span_m: Float[Tensor, "r 2 2"]
    slot_origin: Float[Tensor, "r 2 3"]
    slot_direction: Float[Tensor, "r 2 3"]
    surface_m: Float[Tensor, " r"]
    occupied_m: Float[Tensor, "r k 2"]
    colour: Float[Tensor, "r 3"]
    camera: Int[Tensor, " r"]
    sky: Float[Tensor, " r"]
    return_m: Float[Tensor, " r"]
    label: Int[Tensor, " r"]

    @property
    def is_lidar(self) -> Bool[Tensor, " r"]:
        """Return the mask of LiDAR rays; the others are camera rays."""
        return self.camera < 0

    def owner(self, t: Float[Tensor, "r s"]) -> Int[Tensor, "r s"]:
        """Return the slot whose box contains each sample distance; -1 outside all boxes."""
        inside = (t[:, :, None] >= self.slot_span_m[:, None, :, 0]) & (
            t[:, :, None] <= self.slot_span_m[:, None, :, 1]
        )
        inside &= (self.slot_actor >= 0)[:, None, :]
        first = inside.to(torch.int64).argmax(dim=2)
        return torch.where(inside.any(dim=2), first, torch.full_like(first, -1))

    def points(self, t: Float[Tensor, "r s"]) -> tuple[Float[Tensor, "n 3"], Int[Tensor, " n"]]:
        """Return samples as a flat list of points in the frames of their fields.

        Points are in metres, frame `world` or `actor`; the second result is the actor's number, -1
        for the background.
        """
        slot = self.owner(t)
        points = self.origin[:, None] + t[:, :, None] * self.direction[:, None]
        actor = torch.full_like(slot, -1)
        row, column = torch.nonzero(slot >= 0, as_tuple=True)
        if len(row):
            s = slot[row, column]
            local = self.slot_origin[row, s] + t[row, column, None] * self.slot_direction[row, s]
            points = points.index_put((row, column), local)
            actor = actor.index_put((row, column), self.slot_actor[row, s].to(actor.dtype))
        return points.reshape(-1, 3), actor.reshape(-1)


def place_samples(rays: RayBatch, generator: torch.Generator) -> Float[Tensor, "r s"]:
    """Return sorted sample distances along each ray, in metres.

    With occupied space (the paper's field), samples lie inside it. Otherwise they lie in a band
    around the expected surface, which is the measured return of a LiDAR ray, and in the free space
    before it. Without an expected surface, the band is the first actor box along the ray. Rays
    with none of these are sampled uniformly in the logarithm of the distance.
    """
    if rays.occupied_m.shape[1]:
        return _in_occupied_space(rays, generator)
    count = len(rays.origin)
    centre = torch.where(rays.is_lidar, rays.return_m, rays.surface_m)
    half = _NEAR_HALF_M * (1 + centre / 40)
    span = rays.slot_span_m[:, 0]
    through_box = ~torch.isfinite(centre) & (rays.slot_actor[:, 0] >= 0)
    centre = torch.where(through_box, span.mean(dim=1), centre)
    half = torch.where(through_box, (span[:, 1] - span[:, 0]) / 2, half)
    has_centre = torch.isfinite(centre)
    centre = torch.where(has_centre, centre, torch.ones_like(centre))
    half = torch.where(has_centre, half, torch.ones_like(half))
    start = (centre - half).clamp(min=_NEAREST_M)
    in_band = (
        start[:, None]
        + _stratified(count, _NEAR_SAMPLES, generator, centre)
        * ((centre + half - start).clamp(min=0.05)[:, None])
    )
    in_free = _stratified(count, _FREE_SAMPLES, generator, centre) * (start - _NEAREST_M)[:, None]
    in_free = _NEAREST_M + in_free
    guided = torch.cat([in_free, in_band], dim=1)
    steps = _stratified(count, _NEAR_SAMPLES + _FREE_SAMPLES, generator, centre)
    return torch.where(has_centre[:, None], guided, _unguided(steps))


def _in_occupied_space(rays: RayBatch, generator: torch.Generator) -> Float[Tensor, "r s"]:
    """Stratified samples over all intervals of each ray in occupied space or in actor boxes."""
    # The inverse of the cumulative density maps uniform samples to distances.
    has_box = (rays.slot_actor >= 0)[..., None]
    boxes = torch.where(has_box, rays.slot_span_m.clamp(min=_NEAREST_M), 0.0)
    stretches = torch.cat([boxes, rays.occupied_m], dim=1)
    density = torch.ones_like(stretches[0, :, 0])
    density[: boxes.shape[1]] = _BOX_DENSITY
    mass = density * (stretches[..., 1] - stretches[..., 0]).clamp(min=0.0)
    until = mass.cumsum(dim=1)
    steps = _stratified(len(mass), _MARCHED_SAMPLES, generator, until[:, -1])
    place = steps * until[:, -1:]
    chosen = torch.searchsorted(until, place, right=True).clamp(max=mass.shape[1] - 1)
    beyond = place - (until - mass).gather(1, chosen)
    t = stretches[..., 0].gather(1, chosen) + beyond / density[chosen]
    return torch.where(until[:, -1:] > 0, t.sort(dim=1).values, _unguided(steps))


def _unguided(steps: Float[Tensor, "r s"]) -> Float[Tensor, "r s"]:
    """Distances from 1 m to `_FARTHEST_M`, uniform in the logarithm; `steps` in [0, 1]."""
    return torch.exp(torch.log(torch.tensor(_FARTHEST_M)) * steps)


def _stratified(
    rows: int, count: int, generator: torch.Generator, like: Float[Tensor, " r"]
) -> Float[Tensor, "r s"]:
    """One random number in each of `count` equal parts of [0, 1], ascending; device of `like`."""
    jitter = torch.rand((rows, count), generator=generator).to(like.device)
    return (torch.arange(count, device=like.device) + jitter) / max(count, 1)
