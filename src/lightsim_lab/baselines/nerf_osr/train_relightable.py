"""Training of the relightable field on the pixels of one recording."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32, Int64
from torch import Tensor
from torch.nn import functional

from lightsim.errors import InputError
from lightsim.networks.loop import Learner, LoopConfig, Loss, Session, run_training
from lightsim.reconstruct.field.hash_grid.sparse_adam import SparseAdam
from lightsim.reconstruct.field.ray_pool import RayPool
from lightsim_lab.baselines.nerf_osr.relightable import (
    ENCODING_POWER,
    FieldRays,
    RelightableField,
)

# Learning rate of the hash table; as usual for Adam on hash grids (Mueller et al. 2022,
# arXiv:2201.05989).
_TABLE_RATE = 1e-2
# Learning rate of the other parameters; sensitivity not measured.
_HEAD_RATE = 2e-3
# Prime that separates the seeds of steps of different trainings.
_STEP_SEED = 1_000_003
# Standard deviation of the noise on the lighting that shadows depend on, as in the paper.
_LIGHT_NOISE = 0.01
# Weight of the squared darkness of shadows: albedo must explain dark pixels if it can, as in the
# paper.
_SHADOW_WEIGHT = 1e-3
# Weight of the distance to the LiDAR surface, in half bands; sensitivity not measured.
_DEPTH_WEIGHT = 0.02


@dataclass(frozen=True, eq=False)
class FieldPixels:
    """Pixels that show the static background.

    Args:
        point: intersection of the ray with the LiDAR surface, metres, frame `world`.
        direction: unit vector.
        colour: sRGB pixel values in [0, 1].
        gain: camera gain on linear radiance.
    """

    point: Float32[np.ndarray, "n 3"]
    direction: Float32[np.ndarray, "n 3"]
    colour: Float32[np.ndarray, "n 3"]
    gain: Float32[np.ndarray, "n 3"]

    @staticmethod
    def of(pool: RayPool, gains: Float32[np.ndarray, "c 3"]) -> FieldPixels:
        """Select the camera rays that end on the static background, neither sky nor actor boxes.

        Args:
            gains: camera gains by camera index.

        Raises:
            InputError: no ray remains.
        """
        # A ray that enters an actor's box before the surface shows the actor.
        is_behind_box = (pool.slot_actor >= 0) & (
            pool.slot_span_m[..., 0] < pool.surface_m[:, None]
        )
        keep = np.isfinite(pool.surface_m) & (pool.sky < 0.5) & ~is_behind_box.any(axis=1)
        if not keep.any():
            raise InputError(
                "no pixel shows the static background",
                remedy="Choose frames that show the street.",
            )
        rays = pool.rows(keep)
        point = rays.origin + rays.surface_m[:, None] * rays.direction
        return FieldPixels(point, rays.direction, rays.colour, gains[rays.camera])

    def __len__(self) -> int:
        return len(self.point)

    def rows(self, index: Int64[np.ndarray, " k"]) -> tuple[Tensor, ...]:
        """Return the selected pixels as tensors: point, direction, colour, gain."""
        arrays = (self.point, self.direction, self.colour, self.gain)
        return tuple(torch.from_numpy(array[index]) for array in arrays)


def train_relightable(
    field: RelightableField,
    pixels: FieldPixels,
    steps: int,
    batch: int,
    seed: int,
    session: Session,
) -> int:
    """Train in place from the last checkpoint on; return the number of steps done."""
    table = SparseAdam(field.table, learning_rate=_TABLE_RATE)
    # The small epsilon is usual for hash grids, whose gradients are tiny.
    dense = torch.optim.Adam(field.dense_parameters, lr=_HEAD_RATE, eps=1e-15)

    def losses(_: int, draw: int) -> Iterator[Loss]:
        # One generator per step: a continued training draws the same rays as an uninterrupted one.
        generator = torch.Generator().manual_seed(seed * _STEP_SEED + draw)
        index = torch.randint(0, len(pixels), (batch,), generator=generator).numpy()
        loss, terms = relightable_loss(field, pixels.rows(index), generator)
        yield "field", loss, terms

    loop = LoopConfig(steps, final_fraction=0.1, largest_gradient=None)
    learners = {"field": Learner(field, (table, dense))}
    return run_training(learners, losses, loop, session, "train the field")


def relightable_loss(
    field: RelightableField, pixels: tuple[Tensor, ...], generator: torch.Generator
) -> tuple[Float[Tensor, ""], dict[str, Tensor]]:
    """Return the loss, and its terms: squared error of pixel values, a penalty on shadows, and the
    distance of the surface from LiDAR."""
    point, direction, colour, gain = pixels
    # Noise on the lighting makes shadows depend on it smoothly, so that other lights are possible.
    noise = _LIGHT_NOISE * torch.randn(field.light.shape, generator=generator)
    shown = field(FieldRays(point, direction), field.light + noise, generator)
    # Pixel values are encoded: a gain on linear radiance multiplies them by its root.
    made = shown.pixels(field.light) * gain ** (1 / ENCODING_POWER)
    terms = {
        "mse": (made - colour).square().mean(),
        "shadow": (1 - shown.shadow).square().mean(),
        "depth": functional.smooth_l1_loss(
            shown.depth_m / field.config.half_band_m, torch.zeros_like(shown.depth_m)
        ),
    }
    total = terms["mse"] + _SHADOW_WEIGHT * terms["shadow"] + _DEPTH_WEIGHT * terms["depth"]
    terms["psnr_db"] = -10 * torch.log10(terms["mse"].detach().clamp_min(1e-12))
    return total, terms
