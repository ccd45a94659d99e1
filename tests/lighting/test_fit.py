"""The sun's strength from simulated lit and shadowed points."""

from __future__ import annotations

import numpy as np
import pytest

from lightsim.core.colour import luminance
from lightsim.lighting.sky.fit import SunFit, fit_sun
from lightsim.lighting.sun.evidence import LightEvidence

SKY = np.array([0.5, 0.6, 0.8])
SURFACES = np.array([0.3, 0.3, 0.25])
SUN = np.array([3.0, 2.6, 2.0])


def _evidence(
    rng: np.random.Generator, sun_rgb: np.ndarray, noise: float, wrong_fraction: float
) -> LightEvidence:
    """A road with stripes of shade, its albedo varying in patches of a metre."""
    count = 4000
    position = np.column_stack(
        [rng.uniform(0, 60, count), rng.uniform(0, 10, count), np.zeros(count)]
    )
    is_lit = (position[:, 0] % 6.0) < 3.0
    patch = np.floor(position[:, :2]).astype(int)
    albedo = 0.15 + 0.1 * ((patch[:, 0] * 7 + patch[:, 1] * 13) % 10) / 10
    visibility = rng.uniform(0.4, 0.9, count)
    diffuse = visibility[:, None] * SKY + (1 - visibility[:, None]) * SURFACES
    total = diffuse + is_lit[:, None] * 0.6 * sun_rgb
    radiance = albedo[:, None] * total / np.pi * rng.normal(1.0, noise, (count, 1))
    label = np.where(rng.random(count) < wrong_fraction, ~is_lit, is_lit)
    return LightEvidence(
        position,
        np.tile([0.0, 0.0, 1.0], (count, 1)),
        radiance.astype(np.float32),
        np.full(count, 0.6),
        label,
        (1 - visibility[:, None]) * SURFACES,
        np.where(rng.random((count, 64)) < visibility[:, None], 0, -1),
        np.zeros(count, np.int64),
    )


def _fit(evidence: LightEvidence, rng: np.random.Generator, **hints: float) -> SunFit:
    even_sky = np.broadcast_to(SKY / np.pi, (48, 96, 3))
    return fit_sun(evidence, evidence.diffuse_light(even_sky), SKY, rng, **hints)


@pytest.mark.parametrize("wrong_fraction", [0.0, 0.15])
def test_a_known_sun_is_recovered_from_noisy_pairs(rng: np.random.Generator, wrong_fraction: float):
    fit = _fit(_evidence(rng, SUN, 0.1, wrong_fraction), rng)
    assert fit.kind == "direct"
    np.testing.assert_allclose(fit.irradiance, SUN, rtol=0.15)
    assert fit.log_std < 0.25


def test_without_shadows_the_light_is_called_diffused(rng: np.random.Generator):
    fit = _fit(_evidence(rng, 0.0 * SUN, 0.1, 0.0), rng)
    assert fit.kind == "diffused"
    assert luminance(fit.irradiance) < 0.25 * luminance(SKY)
    assert fit.log_std > 0.3


def test_without_pairs_it_says_unknown(rng: np.random.Generator):
    evidence = _evidence(rng, SUN, 0.1, 0.0)
    lit = evidence.is_lit
    one_sided = LightEvidence(
        evidence.position_world[lit],
        evidence.normal_world[lit],
        evidence.radiance[lit],
        evidence.sun_cosine[lit],
        evidence.is_lit[lit],
        evidence.surface_light[lit],
        evidence.sky_cells[lit],
        evidence.group[lit],
    )
    fit = _fit(one_sided, rng)
    assert fit.kind == "unknown"
    assert np.isinf(fit.log_std)


def test_a_prior_from_elsewhere_does_not_move_what_shadows_say_clearly(rng: np.random.Generator):
    evidence = _evidence(rng, SUN, 0.1, 0.15)
    clear = _fit(evidence, rng, sunny_probability=0.98)
    np.testing.assert_allclose(clear.irradiance, SUN, rtol=0.2)
    few = _evidence(rng, 0.0 * SUN, 0.3, 0.0)
    assert _fit(few, rng, sunny_probability=0.02).kind == "diffused"


def test_diffuse_light_takes_each_points_own_part_of_an_uneven_sky(rng: np.random.Generator):
    evidence = _evidence(rng, SUN, 0.1, 0.0)
    sky = np.zeros((96, 192, 3))
    sky[:2] = 1.0
    light = evidence.diffuse_light(sky) - evidence.surface_light
    np.testing.assert_allclose(light[:, 0], np.pi * evidence.sky_visibility, rtol=1e-6)
