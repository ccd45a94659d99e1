"""The stitched panorama as an LDR picture, with holes (what the sky network reads) or without."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float32

from lightsim.core.colour import luminance, srgb_from_linear
from lightsim.core.twin import Panorama
from lightsim.errors import InputError
from lightsim.lighting.panorama.inpaint import complete_panorama

if TYPE_CHECKING:
    import torch

_LEVELS = (0.08, 0.3)


def exposed_ldr(panorama: Panorama) -> tuple[Float32[np.ndarray, "h w 3"], float]:
    """The panorama in sRGB, holes black, and the exposure: a picture's linear value 1, where it
    clips, is the scene radiance 1 / exposure.

    Raises:
        InputError: nothing was seen, or all of it is black.
    """
    exposure = choose_exposure(panorama)
    ldr = srgb_from_linear(panorama.radiance * np.float32(exposure))
    ldr[panorama.is_clipped] = 1.0
    ldr[~panorama.is_seen] = 0.0
    return ldr, exposure


def completed_ldr(
    panorama: Panorama, weights: Mapping[str, torch.Tensor] | None
) -> tuple[Float32[np.ndarray, "h w 3"], float]:
    """As `exposed_ldr`, holes filled (`complete_panorama`).

    Raises:
        InputError: as `exposed_ldr`.
    """
    ldr, exposure = exposed_ldr(panorama)
    return complete_panorama(ldr, panorama.is_seen, weights), exposure


def choose_exposure(panorama: Panorama) -> float:
    """1, or the nearest factor that brings the median of what was seen to the levels that the
    networks were trained on. Where pixels clip it is at least 1, because radiance is known up to
    their value alone.

    Raises:
        InputError: see `exposed_ldr`.
    """
    seen = luminance(panorama.radiance[panorama.is_seen])
    middle = float(np.median(seen)) if seen.size else 0.0
    if middle <= 0:
        raise InputError(
            "the panorama shows nothing, so no exposure fits it",
            got=f"{seen.size} seen pixels of median luminance {middle:.3g}",
            remedy="Check the pictures and the own-car masks of the log; in a picture of its own,"
            " give what was not observed alpha 0.",
        )
    exposure = float(np.clip(1.0, _LEVELS[0] / middle, _LEVELS[1] / middle))
    return max(exposure, 1.0) if panorama.is_clipped.any() else exposure
