"""Lighting as real spherical harmonics of order 2: nine coefficients per channel.

The radiance of a Lambert surface under distant light is a quadratic function of its normal, within
1 % on average (Ramamoorthi and Hanrahan 2001, doi:10.1145/383259.383317).
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lightsim.core.equirect import pixel_directions, solid_angles_sr

# Number of functions of order 0 to 2.
COUNT = 9
# Factors from radiance to irradiance / pi by coefficient (Ramamoorthi and Hanrahan 2001, eq. 8).
_BANDS = (1.0, *(2 / 3,) * 3, *(1 / 4,) * 5)
# Ridge of the least-squares fit, relative to the mean diagonal: few distinct normals do not
# determine nine coefficients. Sensitivity not measured.
_RIDGE = 1e-3
# Stride of the pixels in the fit, in pixels; a quarter of them suffices for nine coefficients.
_STEP = 2


def basis(directions: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 9"]:
    """Evaluate the nine functions at unit vectors."""
    x, y, z = directions.unbind(-1)
    first, second = math.sqrt(3 / (4 * math.pi)), math.sqrt(15 / (4 * math.pi))
    values = [
        torch.full_like(x, math.sqrt(1 / (4 * math.pi))),
        first * y,
        first * z,
        first * x,
        second * x * y,
        second * y * z,
        math.sqrt(5 / (16 * math.pi)) * (3 * z * z - 1),
        second * x * z,
        second / 2 * (x * x - y * y),
    ]
    return torch.stack(values, dim=-1)


def shading_basis(normals: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 9"]:
    """Return the factors of the radiance coefficients for a white Lambert surface.

    Their weighted sum is the unoccluded radiance of a surface with the given unit normal.
    """
    return basis(normals) * torch.tensor(_BANDS, dtype=normals.dtype, device=normals.device)


def project(dome: Float[Tensor, "n 3 r c"]) -> Float[Tensor, "n 9 3"]:
    """Project equirectangular radiance, in the frame whose x axis is the centre column's direction.

    The error of the sum over pixels is below 1 % at 32 rows.
    """
    weights = torch.from_numpy(_weights(dome.shape[-2])).to(dome.device)
    return torch.einsum("krc,nxrc->nkx", weights, dome.float())


def turned_to_right(dome: Float[Tensor, "n 3 r c"]) -> Float[Tensor, "n 3 r c"]:
    """Turn a dome with the centre column forward so that this column is to the right.

    Coefficients of the result are in the frame (right, forward, up).
    """
    # A quarter of the width is a rotation by 90 degrees.
    return dome.roll(-(dome.shape[-1] // 4), dims=-1)


def shading(
    normals: Float[Tensor, "n 3 h w"], light: Float[Tensor, "n 9 3"]
) -> Float[Tensor, "n 3 h w"]:
    """Return the radiance of a white Lambert surface; ringing below 0 is clipped."""
    # Half precision is too coarse for products of nine signed terms.
    with torch.autocast(normals.device.type, enabled=False):
        functions = shading_basis(normals.float().movedim(1, -1))
        return torch.einsum("nhwk,nkc->nchw", functions, light.float()).clamp_min(0.0)


def fitted_light(
    picture: Float[Tensor, "n 3 h w"],
    reflected: Float[Tensor, "n 3 h w"],
    normals: Float[Tensor, "n 3 h w"],
) -> Float[Tensor, "n 9 3"]:
    """Fit the lighting to a linear picture by least squares (InverseRenderNet, Yu and Smith 2019,
    doi:10.1109/CVPR.2019.00327, Sec. 3).

    Args:
        reflected: reflected fraction of the unoccluded light, albedo x shadow; 0 excludes a pixel.
    """
    with torch.autocast(picture.device.type, enabled=False):
        few = (..., slice(None, None, _STEP), slice(None, None, _STEP))
        functions = shading_basis(normals[few].float().movedim(1, -1)).flatten(1, 2)
        albedo, seen = (x[few].float().flatten(2) for x in (reflected, picture))
        rows = albedo[..., None] * functions[:, None]
        normal_matrix = rows.mT @ rows
        # The guard keeps the system regular for pictures without valid pixels.
        size = normal_matrix.diagonal(dim1=-2, dim2=-1).mean(-1) + 1e-6
        eye = torch.eye(COUNT, device=picture.device)
        system = normal_matrix + _RIDGE * size[..., None, None] * eye
        found = torch.linalg.solve(system, (rows.mT @ seen[..., None])[..., 0])
        return found.mT


@lru_cache(4)
def _weights(rows: int) -> Float[np.ndarray, "9 r c"]:
    """Return the functions at the centres of a dome's pixels, times the pixels' solid angles."""
    values = basis(torch.from_numpy(pixel_directions(rows))).numpy()
    return np.moveaxis(values * solid_angles_sr(rows)[..., None], -1, 0).astype(np.float32)
