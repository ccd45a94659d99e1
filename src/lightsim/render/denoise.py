"""Removal of sampling noise with Intel Open Image Denoise (extra `denoise`)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32

from lightsim.errors import InputError, LightSimError, need


def check_installed() -> None:
    """Check that the denoiser is installed, before the first frame is rendered.

    Raises:
        MissingDependencyError: pyoidn is not installed.
    """
    need("pyoidn", extra="denoise")


def denoise(
    image: Float32[np.ndarray, "h w 3"],
    base_colour: Float32[np.ndarray, "h w 3"],
    normal_world: Float32[np.ndarray, "h w 3"],
) -> Float32[np.ndarray, "h w 3"]:
    """Return the image without noise, guided by noise-free buffers (Afra, Open Image Denoise,
    2019-).

    Args:
        image: linear radiance or irradiance / pi, any scale.
        base_colour: in [0, 1]; all 1 if the image has the base colour divided out (white surfaces).
        normal_world: unit vectors, 0 without a surface.

    Raises:
        MissingDependencyError: pyoidn is not installed.
        InputError: the image is not finite.
        LightSimError: the library failed.
    """
    pyoidn = need("pyoidn", extra="denoise")
    # One value that is not finite would corrupt its neighbourhood without an error of the library.
    is_finite = np.isfinite(image).all(axis=2)
    if not is_finite.all():
        raise InputError(
            "the image to denoise has infinite or undefined values",
            got=f"{int((~is_finite).sum())} such pixels",
            expected="none",
        )
    try:
        cleaned = pyoidn.denoise(
            np.ascontiguousarray(image),
            albedo=np.clip(base_colour, 0, 1),
            normal=np.ascontiguousarray(normal_world),
            hdr=True,
            # Albedo and normals come from primary rays and have no noise: they are not denoised
            # first.
            clean_aux=True,
        )
    except RuntimeError as error:
        raise LightSimError(
            "Open Image Denoise failed", got=error, remedy="Render without --denoise."
        ) from error
    return np.maximum(cleaned, 0).astype(np.float32)
