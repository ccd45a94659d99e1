"""The clear sky against published clear-sky light: strength, ratio of sun to sky, and colour."""

from __future__ import annotations

import warnings
from functools import cache

import numpy as np
import pytest

from lightsim.core.colour import luminance
from lightsim.core.dome import irradiance
from lightsim.lighting.sky.clear_sky import SCENE_UNITS_PER_MODEL_UNIT, clear_sky_parts

# Luminance of one scene unit of a clear sky: the model's RGB is spectral radiance in
# W / (m2 sr nm), weighted by CIE y and divided by the sum of y over nanometres, 106.857.
_LUMINANCE_CD_M2 = 683.0 * 106.857 / SCENE_UNITS_PER_MODEL_UNIT
_NM = np.arange(380.0, 781.0)
_RGB_FROM_XYZ = np.linalg.inv(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750],
     [0.0193339, 0.1191920, 0.9503041]]
)  # fmt: skip


def _lobe(peak: float, low: float, high: float) -> np.ndarray:
    return np.exp(-0.5 * ((_NM - peak) * np.where(peak > _NM, low, high)) ** 2)


def _observer() -> np.ndarray:
    """CIE 1931 x, y, z (Wyman et al. 2013, JCGT 2(2), eq. 4)."""
    x = 1.056 * _lobe(599.8, 0.0264, 0.0323) + 0.362 * _lobe(442.0, 0.0624, 0.0374)
    x -= 0.065 * _lobe(501.1, 0.0490, 0.0382)
    y = 0.821 * _lobe(568.8, 0.0213, 0.0247) + 0.286 * _lobe(530.9, 0.0613, 0.0322)
    z = 1.217 * _lobe(437.0, 0.0845, 0.0278) + 0.681 * _lobe(459.0, 0.0385, 0.0725)
    return np.stack([x, y, z], axis=1)


@cache
def _model(elevation_deg: float, turbidity: float) -> tuple[np.ndarray, np.ndarray]:
    """Illuminance of the sun at normal incidence and of the sky on level ground, in lux of R, G
    and B."""
    angle = np.radians(elevation_deg)
    direction = np.array([np.cos(angle), 0.0, np.sin(angle)])
    sky, sun = clear_sky_parts(direction, turbidity, 0.2, 32)
    up = np.array([0.0, 0.0, 1.0])
    return sun.irradiance * _LUMINANCE_CD_M2, irradiance(sky, up) * _LUMINANCE_CD_M2


def _spectral(elevation_deg: float, aerosol: float) -> tuple[np.ndarray, np.ndarray, float]:
    """SPCTRAL2 (Bird & Riordan 1986) of pvlib: lux of sun and sky, and how many times more
    lumens a watt of the sky has than one of the sun."""
    import pvlib

    zenith = 90.0 - elevation_deg
    mass = pvlib.atmosphere.get_relative_airmass(zenith)
    found = pvlib.spectrum.spectrl2(
        zenith, zenith, 0, 0.2, 101325.0, mass, 2.0, 0.3, aerosol, dayofyear=80, alpha=1.3
    )
    lux, watts = [], []
    for kind in ("dni", "dhi"):
        watts.append(np.trapezoid(found[kind].ravel(), found["wavelength"].ravel()))
        spectrum = np.interp(_NM, found["wavelength"].ravel(), found[kind].ravel())
        lux.append(683.0 * _RGB_FROM_XYZ @ (spectrum @ _observer()))
    sun, sky = lux
    efficacy = (luminance(sky) / watts[1]) / (luminance(sun) / watts[0])
    return sun, sky, float(efficacy)


def _aerosol_of(elevation_deg: float, turbidity: float) -> float:
    """Aerosol optical depth at 500 nm at which SPCTRAL2's sun is as bright as the model's."""
    from scipy.optimize import brentq

    wanted = luminance(_model(elevation_deg, turbidity)[0])
    root = brentq(lambda a: luminance(_spectral(elevation_deg, a)[0]) - wanted, -0.1, 1.5)
    assert isinstance(root, float)
    return root


@pytest.mark.parametrize("elevation_deg", [10.0, 30.0, 60.0])
def test_illuminance_is_that_of_a_clear_day(elevation_deg: float) -> None:
    """IES clear sky (IES RP-21, 1984): sun 127.5 klx exp(-0.21 m), sky 0.8 + 15.5 sqrt(sin)."""
    sine = np.sin(np.radians(elevation_deg))
    mass = 1 / (sine + 0.50572 * (elevation_deg + 6.07995) ** -1.6364)
    sun, sky = (luminance(part) for part in _model(elevation_deg, 2.0))
    ies_sun, ies_sky = 127.5e3 * np.exp(-0.21 * mass), 0.8e3 + 15.5e3 * np.sqrt(sine)
    assert sun == pytest.approx(ies_sun, rel=0.4 if elevation_deg < 20 else 0.1)
    assert sky == pytest.approx(ies_sky, rel=0.2)
    assert sun / sky == pytest.approx(ies_sun / ies_sky, rel=0.2)


@pytest.mark.parametrize("turbidity", [2.0, 3.0, 4.0, 6.0])
@pytest.mark.parametrize(("elevation_deg", "factor"), [(10.0, 1.8), (30.0, 1.4), (60.0, 1.45)])
def test_sun_over_sky_is_that_of_published_models(
    elevation_deg: float, factor: float, turbidity: float
) -> None:
    """SPCTRAL2 and the simplified Solis model (Ineichen 2008) in the air that the model's own
    sun tells of. They differ by 1.2 between themselves."""
    import pvlib

    aerosol = _aerosol_of(elevation_deg, turbidity)
    sun, sky = (luminance(part) for part in _model(elevation_deg, turbidity))
    bird_sun, bird_sky, efficacy = _spectral(elevation_deg, aerosol)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        solis = pvlib.clearsky.simplified_solis(
            elevation_deg, aod700=aerosol * 1.4**-1.3, precipitable_water=2.0
        )
    solis_ratio = solis["dni"] / solis["dhi"] / efficacy
    for published in (luminance(bird_sun) / luminance(bird_sky), solis_ratio):
        assert 1 / factor < sun / sky / published < factor


def test_haze_takes_from_the_sun_and_gives_to_the_sky() -> None:
    for elevation_deg in (10.0, 30.0, 60.0):
        light = [_model(elevation_deg, t) for t in (2.0, 3.0, 4.0, 6.0)]
        assert np.all(np.diff([luminance(sun) for sun, _ in light]) < 0)
        assert np.all(np.diff([luminance(sky) for _, sky in light]) > 0)


@pytest.mark.parametrize(("elevation_deg", "tolerance"), [(10.0, 0.15), (30.0, 0.07), (60.0, 0.07)])
def test_the_colour_of_the_sun_is_that_of_its_spectrum(
    elevation_deg: float, tolerance: float
) -> None:
    sun = _model(elevation_deg, 3.0)[0]
    expected = _spectral(elevation_deg, _aerosol_of(elevation_deg, 3.0))[0]
    np.testing.assert_allclose(sun / luminance(sun), expected / luminance(expected), atol=tolerance)


def test_a_high_sun_is_near_d55_and_the_sky_is_blue() -> None:
    sun, sky = _model(60.0, 3.0)
    xyz = np.linalg.inv(_RGB_FROM_XYZ) @ sun
    np.testing.assert_allclose(xyz[:2] / xyz.sum(), [0.3324, 0.3474], atol=0.012)
    assert sky[2] > 1.8 * sky[0]
