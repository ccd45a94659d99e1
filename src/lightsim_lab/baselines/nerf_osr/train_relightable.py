"""Training of the field that can be relit, on the pixels of one recording."""

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
from lightsim_lab.baselines.nerf_osr.relightable import FieldRays, RelightableField

_TABLE_RATE, _HEAD_RATE = 1e-2, 2e-3
_STEP_SEED = 1_000_003
_LIGHT_NOISE = 0.01
"""On the lighting that shadows depend on (theirs)."""
_SHADOW_WEIGHT = 1e-3
"""Of the squared darkness of shadows: what albedo explains is no shadow (theirs)."""
_DEPTH_WEIGHT = 0.02
"""Of the distance to the surface that LiDAR tells of, in half bands."""


@dataclass(frozen=True, eq=False)
class FieldPixels:
    """Pixels that show what never moves.

    Args:
        point: where their rays meet the surface that LiDAR tells of, metres, frame `world`.
        direction: unit.
        colour: sRGB pixel values in [0, 1].
        gain: of the pixels' cameras on linear radiance.
    """

    point: Float32[np.ndarray, "n 3"]
    direction: Float32[np.ndarray, "n 3"]
    colour: Float32[np.ndarray, "n 3"]
    gain: Float32[np.ndarray, "n 3"]

    @staticmethod
    def of(pool: RayPool, gains: Float32[np.ndarray, "c 3"]) -> FieldPixels:
        """Of camera rays: no sky, nothing in an actor's box.

        Args:
            gains: by number of the camera.

        Raises:
            InputError: no ray is left.
        """
        is_behind_box = (pool.slot_actor >= 0) & (
            pool.slot_span_m[..., 0] < pool.surface_m[:, None]
        )
        keep = np.isfinite(pool.surface_m) & (pool.sky < 0.5) & ~is_behind_box.any(axis=1)
        if not keep.any():
            raise InputError(
                "no pixel shows a surface that never moves",
                remedy="Choose frames that show the street.",
            )
        rays = pool.rows(keep)
        point = rays.origin + rays.surface_m[:, None] * rays.direction
        return FieldPixels(point, rays.direction, rays.colour, gains[rays.camera])

    def __len__(self) -> int:
        return len(self.point)

    def rows(self, index: Int64[np.ndarray, " k"]) -> tuple[Tensor, ...]:
        """Some of the pixels, as tensors."""
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
    """Train in place from the checkpointer's last state on; the steps done."""
    table = SparseAdam(field.table, learning_rate=_TABLE_RATE)
    dense = torch.optim.Adam(field.dense_parameters, lr=_HEAD_RATE, eps=1e-15)

    def losses(_: int, draw: int) -> Iterator[Loss]:
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
    """Squared error of pixel values; shadows only where they are needed; surfaces where LiDAR has
    them."""
    point, direction, colour, gain = pixels
    noise = _LIGHT_NOISE * torch.randn(field.light.shape, generator=generator)
    shown = field(FieldRays(point, direction), field.light + noise, generator)
    # A gain on light is its root on pixel values.
    made = shown.pixels(field.light) * gain ** (1 / 2.2)
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
