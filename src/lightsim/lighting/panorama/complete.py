"""The stitched panorama as an LDR picture, with holes (input of the sky network) or completed."""

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

# Range of the median linear value of the observed pixels in the panoramas that the networks were
# trained on.
_LEVELS = (0.08, 0.3)


def exposed_ldr(panorama: Panorama) -> tuple[Float32[np.ndarray, "h w 3"], float]:
    """Return the panorama in sRGB, holes black, and its exposure.

    The exposure is a factor on radiance: the linear value 1, where pixels clip, is the scene
    radiance 1 / exposure.

    Raises:
        InputError: no pixel was observed, or all observed pixels are black.
    """
    exposure = choose_exposure(panorama)
    ldr = srgb_from_linear(panorama.radiance * np.float32(exposure))
    ldr[panorama.is_clipped] = 1.0
    ldr[~panorama.is_seen] = 0.0
    return ldr, exposure


def completed_ldr(
    panorama: Panorama, weights: Mapping[str, torch.Tensor] | None
) -> tuple[Float32[np.ndarray, "h w 3"], float]:
    """Return the panorama in sRGB with its holes filled (`complete_panorama`), and its exposure.

    Raises:
        InputError: see `exposed_ldr`.
    """
    ldr, exposure = exposed_ldr(panorama)
    return complete_panorama(ldr, panorama.is_seen, weights), exposure


def choose_exposure(panorama: Panorama) -> float:
    """Return the factor nearest to 1 that moves the median of the observed pixels into the
    networks' range.

    If the panorama has clipped pixels, the factor is at least 1, because their radiance is only
    known up to the clipping value.

    Raises:
        InputError: see `exposed_ldr`.
    """
    seen = luminance(panorama.radiance[panorama.is_seen])
    middle = float(np.median(seen)) if seen.size else 0.0
    if middle <= 0:
        raise InputError(
            "the panorama is black or empty, so no exposure can be chosen",
            got=f"{seen.size} observed pixels of median luminance {middle:.3g}",
            expected="observed pixels of median luminance above 0",
            remedy="Check the pictures and the ego vehicle masks of the log; in a single picture,"
            " give pixels that were not observed alpha 0.",
        )
    exposure = float(np.clip(1.0, _LEVELS[0] / middle, _LEVELS[1] / middle))
    return max(exposure, 1.0) if panorama.is_clipped.any() else exposure
