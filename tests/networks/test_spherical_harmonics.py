"""Lighting of order 2 against integrals that are known."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch.nn import functional

from lightsim.core.dome import irradiance
from lightsim.core.equirect import pixel_directions
from lightsim_lab.baselines.spherical_harmonics import (
    fitted_light,
    project,
    shading,
    turned_to_right,
)

ROWS = 32
AXIS = np.array([2.0, -3.0, 6.0]) / 7


def dome_of(values: np.ndarray) -> torch.Tensor:
    """A grey dome."""
    return torch.from_numpy(values.astype(np.float32)).expand(1, 3, -1, -1)


def normals(count: int = 200) -> torch.Tensor:
    torch.manual_seed(0)
    return functional.normalize(torch.randn(1, 3, 10, count // 10), dim=1)


def along_axis(of: torch.Tensor) -> torch.Tensor:
    return (of * torch.from_numpy(AXIS.astype(np.float32))[:, None, None]).sum(1, keepdim=True)


@pytest.mark.parametrize("power", [0, 1, 2])
def test_polynomial_skies_light_lambert_surfaces_as_integrals_say(power: int) -> None:
    """Radiance 1, 1 + w.a and (w.a)^2 from w: 1, 1 + 2/3 n.a and 1/3 + ((n.a)^2 - 1/3) / 4."""
    cosine = pixel_directions(ROWS) @ AXIS
    radiance = (np.ones_like(cosine), 1 + cosine, cosine**2)[power]
    n = normals()
    c = along_axis(n)
    wanted = (torch.ones_like(c), 1 + 2 / 3 * c, 1 / 3 + (c**2 - 1 / 3) / 4)[power]
    shown = shading(n, project(dome_of(radiance)))
    torch.testing.assert_close(shown, wanted.expand_as(shown), atol=4e-3, rtol=0)


def test_a_hemisphere_is_nearly_of_order_2() -> None:
    """An upper half of radiance 1, against the exact integral, which is (1 + n.up) / 2."""
    is_up = (pixel_directions(ROWS)[..., 2] > 0).astype(np.float32)
    light = project(dome_of(is_up))
    for normal in np.eye(3):
        exact = irradiance(is_up[..., None].repeat(3, -1), normal)[0] / np.pi
        found = shading(torch.from_numpy(normal).float()[None, :, None, None], light)
        assert float(found[0, 0, 0, 0]) == pytest.approx(exact, abs=0.02)


def test_a_dome_that_looks_forward_turns_to_right_forward_up() -> None:
    """A light at the right lies a quarter of the width right of the centre column."""
    radiance = np.zeros((ROWS, 2 * ROWS), np.float32)
    radiance[ROWS // 2 - 1 : ROWS // 2 + 1, 3 * ROWS // 2 - 1 : 3 * ROWS // 2 + 1] = 1
    light = project(turned_to_right(dome_of(radiance)))
    axes = torch.cat([torch.eye(3), -torch.eye(3)]).T[None, :, :, None]
    assert int(shading(axes, light)[0, 0, :, 0].argmax()) == 0


def test_least_squares_find_the_light_of_a_lambert_picture() -> None:
    n = normals(2000)
    torch.manual_seed(1)
    light = torch.randn(1, 9, 3) * 0.1
    light[:, 0] = 2.0
    albedo = 0.2 + 0.6 * torch.rand_like(n)
    found = fitted_light(albedo * shading(n, light), albedo, n)
    torch.testing.assert_close(found, light, atol=2e-2, rtol=2e-2)
