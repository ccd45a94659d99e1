"""Lens models: closed forms, and pictures that survive distortion and rectification."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import KDTree

from lightsim.datasets.lenses import Lens
from lightsim.datasets.rectify import views_of
from lightsim.errors import InputError

SIZE = (640, 480)
CENTRE = (320.0, 240.0)


def lens(model: str, focal_px: float, *coefficients: float) -> Lens:
    return Lens(model, *SIZE, focal_px, focal_px, *CENTRE, coefficients)


def at_angle(theta: float, phi: float) -> np.ndarray:
    return np.array([[np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)]])


def test_a_brown_lens_has_the_textbook_value() -> None:
    """x = .3, y = .2: r2 = .13, factor 1 - .1 r2 + .05 r2^2; tangential parts by hand."""
    k1, k2, p1, p2 = -0.1, 0.05, 0.001, -0.002
    uv, is_inside = lens("brown", 500.0, k1, k2, p1, p2).project(np.array([[0.6, 0.4, 2.0]]))
    factor = 1 - 0.1 * 0.13 + 0.05 * 0.13**2
    x = 0.3 * factor + 2 * p1 * 0.06 + p2 * (0.13 + 2 * 0.09)
    y = 0.2 * factor + p1 * (0.13 + 2 * 0.04) + 2 * p2 * 0.06
    np.testing.assert_allclose(uv[0], [500 * x + 320, 500 * y + 240], atol=1e-9)
    assert is_inside[0]


@pytest.mark.parametrize("theta", [0.2, 0.9, 1.7])
def test_a_fisheye_is_equidistant_without_coefficients(theta: float) -> None:
    """Kannala-Brandt with zero coefficients: radius = f theta, also beyond 90 degrees."""
    phi = 0.4
    uv, is_inside = lens("kannala_brandt", 120.0).project(at_angle(theta, phi))
    expected = np.array(CENTRE) + 120.0 * theta * np.array([np.cos(phi), np.sin(phi)])
    np.testing.assert_allclose(uv[0], expected, atol=1e-9)
    assert is_inside[0] == (abs(expected - CENTRE) < CENTRE).all()


def test_ftheta_is_a_polynomial_of_the_angle() -> None:
    model = Lens("ftheta", *SIZE, 1.0, 1.0, *CENTRE, (0.0, 150.0, 0.0, -8.0))
    uv, _ = model.project(at_angle(0.7, 0.0))
    assert uv[0, 0] == pytest.approx(320 + 150 * 0.7 - 8 * 0.7**3)


def test_mei_with_xi_one_is_stereographic() -> None:
    """A unit sphere seen from its south pole: radius = f tan(theta / 2)."""
    uv, _ = lens("mei", 300.0, 1.0).project(at_angle(1.2, 0.0))
    assert uv[0, 0] == pytest.approx(320 + 300 * np.tan(0.6))


def test_directions_behind_a_folding_polynomial_are_outside() -> None:
    """With k1 = -.5 the radius is largest at r = .816; directions beyond have a false image."""
    model = lens("brown", 200.0, -0.5)
    _, is_inside = model.project(np.array([[0.7, 0.0, 1.0], [1.3, 0.0, 1.0], [0.0, 0.0, -1.0]]))
    assert is_inside.tolist() == [True, False, False]


@pytest.mark.parametrize(
    ("model", "focal_px", "coefficients", "count"),
    [
        ("brown", 400.0, (-0.2, 0.05, 0.001, 0.0), 1),
        ("kannala_brandt", 250.0, (0.01, -0.005), 2),
        ("mei", 400.0, (1.2, -0.1), 3),
        ("kannala_brandt", 110.0, (), 3),
    ],
)
def test_a_rectified_picture_shows_what_the_lens_saw(
    model: str, focal_px: float, coefficients: tuple[float, ...], count: int
) -> None:
    """The recorded picture has the direction of each pixel as its colour: so have its views."""
    recorded = lens(model, focal_px, *coefficients)
    # The direction of each recorded pixel, by inverting the projection on a fine sphere.
    theta, phi = np.meshgrid(np.linspace(0, 3.1, 900), np.linspace(0, 2 * np.pi, 1500))
    grid = np.stack(
        [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1
    ).reshape(-1, 3)
    uv, is_inside = recorded.project(grid)
    centres = np.stack(np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5), axis=-1)
    _, nearest = KDTree(uv[is_inside]).query(centres.reshape(-1, 2))
    colour = np.round((grid[is_inside][nearest] + 1) * 127).astype(np.uint8)
    colour = colour.reshape(SIZE[1], SIZE[0], 3)
    views = views_of("wide", recorded)
    assert len(views) == count
    for view in views:
        made = view.resampled(colour)
        outside = view.outside(None)
        seen = np.ones(made.shape[:2], bool) if outside is None else ~outside
        directions = view.camera.directions(view.camera.pixel_centres()) @ view.camera_from_view.T
        error = np.abs(made[seen] / 127.0 - 1 - directions[seen])
        # Steps of 8-bit colours are .008. At the edge of the lens the nearest sample is farther.
        assert np.median(error) < 0.012
        assert (error.max(axis=1) < 0.04).mean() > 0.95
    assert {view.camera.name for view in views} <= {"wide", "wide_left", "wide_mid", "wide_right"}


def test_a_lens_without_distortion_keeps_its_picture() -> None:
    (view,) = views_of("front", lens("brown", 500.0, 0.0, 0.0))
    picture = np.arange(480 * 640 * 3, dtype=np.uint64).astype(np.uint8).reshape(480, 640, 3)
    assert view.resampled(picture) is picture
    assert view.outside(None) is None


def test_rows_of_the_recorded_picture_give_the_time() -> None:
    """A slightly distorted picture is read like a pinhole's; a fisheye's side view is read
    obliquely."""
    (view,) = views_of("front", lens("brown", 500.0, -0.05))
    down, across, centre = view.readout(0.03, 0.0)
    assert down == pytest.approx(0.03, rel=0.05)
    assert (abs(across), abs(centre)) == pytest.approx((0.0, 0.0), abs=1e-4)
    left, right = views_of("wide", lens("kannala_brandt", 250.0))
    _, across_s, left_s = left.readout(0.0, 0.04)
    assert across_s > 0
    assert left_s < -0.005
    assert right.readout(0.0, 0.04)[2] == pytest.approx(-left_s, abs=1e-4)


@pytest.mark.parametrize(
    ("model", "coefficients"),
    [("fisheye", ()), ("brown", (np.nan,)), ("kannala_brandt", (0.0,) * 5)],
)
def test_wrong_intrinsics_are_one_error(model: str, coefficients: tuple[float, ...]) -> None:
    with pytest.raises(InputError, match="intrinsics"):
        lens(model, 100.0, *coefficients)
