"""Pictures in overlapping tiles, for networks that mix the whole picture into one latent."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from lightsim.relighting.network.channels import OF_SKIES
from lightsim.relighting.network.features import Batch


def predicted_in_tiles(network: nn.Module, batch: Batch, tile_px: int) -> Float[Tensor, "1 3 h w"]:
    """Return the network's picture, blended from tiles that overlap by half.

    Each tile has the size of the pictures in training. Its weight falls to almost zero at its
    borders, which avoids seams.

    Args:
        network: returns a picture of the size of its planes.
        batch: planes of one picture.
        tile_px: rows and columns of a tile; a smaller picture is one tile in that direction.
    """
    height, width = batch["source"].shape[-2:]
    rows, columns = min(tile_px, height), min(tile_px, width)
    weight = _falling(rows)[:, None] * _falling(columns)
    weight = weight.to(batch["source"].device)
    total = batch["source"].new_zeros(4, height, width)
    starts = _starts(width, columns)
    for top in _starts(height, rows):
        row = [_tile(batch, top, rows, left, columns) for left in starts]
        shown = network({name: torch.cat([tile[name] for tile in row]) for name in batch})
        for left, picture in zip(starts, shown, strict=True):
            part = total[:, top : top + rows, left : left + columns]
            part[:3] += weight * picture
            part[3] += weight
    return (total[:3] / total[3])[None]


def _starts(length: int, tile: int) -> list[int]:
    last = length - tile
    return sorted({*range(0, last, max(tile // 2, 1)), last})


def _tile(batch: Batch, top: int, rows: int, left: int, columns: int) -> Batch:
    """Cut the planes; domes stay whole."""
    window = (..., slice(top, top + rows), slice(left, left + columns))
    return {
        name: plane if name.endswith(OF_SKIES) else plane[window] for name, plane in batch.items()
    }


def _falling(length: int) -> Float[Tensor, " n"]:
    """Return positive weights that fall from the middle to both ends (Hann window)."""
    return torch.hann_window(length + 2, periodic=False)[1:-1]
