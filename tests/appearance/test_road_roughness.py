"""A road's roughness comes back from what it shows before the sun and elsewhere."""

from __future__ import annotations

import numpy as np
import pytest

from lightsim.appearance.intrinsic.light import Reflections, SurfaceLight
from lightsim.appearance.intrinsic.road_roughness import estimate_roughness
from lightsim.core.dome import Sun
from lightsim.render.transport.lobes import Lobes, normal_reflectance, sun_in_lobes
from lightsim.render.transport.sun import unshadowed_sun

_SUN = Sun(np.array([0.0, np.cos(0.5), np.sin(0.5)]), np.full(3, 4.0, np.float32))
_COUNT = 4000


def _towards(rng: np.random.Generator) -> np.ndarray:
    """To cameras all around, 5 to 60 degrees high."""
    high, around = rng.uniform(0.1, 1.05, _COUNT), rng.uniform(0.0, 2 * np.pi, _COUNT)
    level = np.cos(high)
    return np.stack([level * np.cos(around), level * np.sin(around), np.sin(high)], axis=1).astype(
        np.float32
    )


def _fit(true: float, base: np.ndarray, visibility: np.ndarray) -> float | None:
    rng = np.random.default_rng(0)
    up = np.tile(np.array([0.0, 0.0, 1.0], np.float32), (_COUNT, 1))
    towards = _towards(rng)
    f0 = normal_reflectance(np.zeros_like(up), np.zeros(_COUNT, np.float32))

    def sheen(roughness: float) -> np.ndarray:
        return sun_in_lobes(
            Lobes(up, up, towards, np.full(_COUNT, roughness, np.float32), f0), _SUN
        )

    nothing, sky = np.zeros_like(up), np.full_like(up, 0.2)
    light = SurfaceLight(
        unshadowed_sun(up, _SUN),
        np.stack([visibility, visibility], axis=1),
        sky,
        nothing,
        nothing,
        Reflections(np.full_like(up, 0.01), nothing, nothing),
    )
    lit = visibility[:, None]
    diffuse = base[:, None] * (light.sun * lit + sky)
    half = towards + _SUN.direction_world
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    return estimate_roughness(diffuse + 0.01 + lit * sheen(true), light, sheen, half[:, 2])


@pytest.mark.parametrize("true", [0.64, 0.72, 0.85])
def test_the_roughness_comes_back_whatever_the_road_is_painted(true: float) -> None:
    rng = np.random.default_rng(1)
    base = np.where(rng.random(_COUNT) < 0.1, 0.6, 0.18 * np.exp(rng.normal(0.0, 0.1, _COUNT)))
    is_lit = (rng.random(_COUNT) < 0.7).astype(np.float32)
    found = _fit(true, base, is_lit)
    assert found is not None
    assert abs(found - true) < 0.02


def test_a_smoother_road_than_lobes_allow_is_as_smooth_as_they_do() -> None:
    assert _fit(0.4, np.full(_COUNT, 0.18), np.ones(_COUNT, np.float32)) == 0.6


def test_a_road_in_the_shade_tells_nothing() -> None:
    assert _fit(0.7, np.full(_COUNT, 0.18), np.zeros(_COUNT, np.float32)) is None


def test_black_pictures_tell_nothing() -> None:
    up = np.tile(np.array([0.0, 0.0, 1.0], np.float32), (_COUNT, 1))
    nothing, lit = np.zeros_like(up), np.ones((_COUNT, 2), np.float32)
    light = SurfaceLight(up, lit, up, nothing, nothing)
    half = np.linspace(0.5, 1.0, _COUNT)
    assert estimate_roughness(nothing, light, lambda _: nothing, half) is None
