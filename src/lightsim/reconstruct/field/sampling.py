"""Where samples lie along training rays, and whose field each one belongs to."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

NEAREST_M = 0.5
_FARTHEST_M = 200.0


# Not measured alone; training as a whole is (docs/benchmarks/reconstruction.md).

# Samples around the expected surface.
_NEAR_SAMPLES = 8
# Samples between the sensor and there.
_FREE_SAMPLES = 4
# Half width of the band around the expected surface, times (1 + t / 40).
_NEAR_HALF_M = 0.4
# Samples of a ray in occupied space: UniSim's steps of 20 cm in 5 m of it, which half of the rays
# of street 0 have. The expected depth is that of the sample behind the surface, so that the field
# puts its zero level half a step too near: 16 samples put it 20 cm before the returns.
_MARCHED_SAMPLES = 25
# Actors' boxes are sampled so much more densely than occupied space: UniSim's steps of 5 and 20 cm.
_BOX_DENSITY = 4.0


@dataclass(frozen=True, eq=False)
class RayBatch:
    """Rays of one step as tensors; see `ray_pool.RayPool` for the meaning."""

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
        """Rays of LiDAR returns; the others are camera pixels."""
        return self.camera < 0

    def owner(self, t: Float[Tensor, "r s"]) -> Int[Tensor, "r s"]:
        """Which slot's box each distance lies in; -1 outside all boxes."""
        inside = (t[:, :, None] >= self.slot_span_m[:, None, :, 0]) & (
            t[:, :, None] <= self.slot_span_m[:, None, :, 1]
        )
        inside &= (self.slot_actor >= 0)[:, None, :]
        first = inside.to(torch.int64).argmax(dim=2)
        return torch.where(inside.any(dim=2), first, torch.full_like(first, -1))

    def points(self, t: Float[Tensor, "r s"]) -> tuple[Float[Tensor, "n 3"], Int[Tensor, " n"]]:
        """Samples as points of their own field, flat: metres in frame `world` or `actor`, and the
        actor's number (-1: the background)."""
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
    """Sorted sample distances: in occupied space, where rays know it (the paper's field); else some
    in a band around the expected surface (the measured return of a LiDAR ray), some in the free
    space before it.

    Rays without occupied space are sampled evenly in the logarithm of the distance; those without
    an expected surface through the first actor box they pass, else the same.
    """
    if rays.occupied_m.shape[1]:
        return _in_occupied_space(rays, generator)
    near, free = _NEAR_SAMPLES, _FREE_SAMPLES
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
    start = (centre - half).clamp(min=NEAREST_M)
    in_band = (
        start[:, None]
        + _stratified(count, near, generator, centre)
        * ((centre + half - start).clamp(min=0.05)[:, None])
    )
    in_free = NEAREST_M + _stratified(count, free, generator, centre) * (start - NEAREST_M)[:, None]
    guided = torch.cat([in_free, in_band], dim=1)
    steps = _stratified(count, near + free, generator, centre)
    return torch.where(has_centre[:, None], guided, _blind(steps))


def _in_occupied_space(rays: RayBatch, generator: torch.Generator) -> Float[Tensor, "r s"]:
    """Stratified over all stretches of each ray that are occupied or in boxes of actors."""
    has_box = (rays.slot_actor >= 0)[..., None]
    boxes = torch.where(has_box, rays.slot_span_m.clamp(min=NEAREST_M), 0.0)
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
    return torch.where(until[:, -1:] > 0, t.sort(dim=1).values, _blind(steps))


def _blind(steps: Float[Tensor, "r s"]) -> Float[Tensor, "r s"]:
    """Distances evenly in their logarithm."""
    return torch.exp(torch.log(torch.tensor(_FARTHEST_M)) * steps.clamp(min=0.0)) * 1.0


def _stratified(
    rows: int, count: int, generator: torch.Generator, like: Float[Tensor, " r"]
) -> Float[Tensor, "r s"]:
    """One random number in each of `count` equal parts of [0, 1], ascending."""
    jitter = torch.rand((rows, count), generator=generator).to(like.device)
    return (torch.arange(count, device=like.device) + jitter) / max(count, 1)
