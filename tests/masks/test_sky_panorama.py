"""The sky as seen from several places: what agrees with it, what hides it, what it cannot tell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lightsim.core.camera import PinholeCamera
from lightsim.core.frames import RigidTransform
from lightsim.core.sensors import CameraFrame
from lightsim.masks.certain_sky import CertainSky, log_ratios
from lightsim.masks.sky import _classified, _gather, _segment, estimate_sky_matte
from lightsim.masks.sky_panorama import (
    CameraSky,
    Kind,
    SkyPanorama,
    SkyView,
    frames_apart,
    panoramas,
)
from lightsim.masks.sky_regions import ImageEvidence, region_graph

CAMERA = PinholeCamera("front", 480, 270, 240.0, 240.0, 240.0, 135.0)
PLACES_M = np.arange(0.0, 12.0, 2.0)
LOOKING_Y = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Camera x is world x, camera y is world -z."""
WIRES_M = (5.2, 5.8)
"""Heights over x = 0 of two wires 10 m away, which rise by a tenth."""


def pose(x_m: float, rotation: np.ndarray = LOOKING_Y) -> RigidTransform:
    return RigidTransform.from_rotation("world", "camera", rotation, np.array([x_m, 0.0, 1.6]))


def rays(x_m: float) -> np.ndarray:
    return pose(x_m).rotate(CAMERA.directions(CAMERA.pixel_centres()))


def is_cloud(directions: np.ndarray) -> np.ndarray:
    """Bars of cloud, steep in the picture, that reach from the wires to high above them."""
    azimuth = np.degrees(np.arctan2(directions[..., 0], directions[..., 1]))
    return (np.abs((azimuth + 6.0) % 30.0 - 15.0) < 4.0) & (directions[..., 2] > 0.25)


def heights_over_wires_m(x_m: float) -> np.ndarray:
    """Of each pixel's ray 10 m away, over where the wires would be at x = 0."""
    d = rays(x_m)
    return 1.6 + 10.0 * d[..., 2] / d[..., 1] - 0.1 * (x_m + 10.0 * d[..., 0] / d[..., 1])


def roof_m(x_m: np.ndarray) -> np.ndarray:
    """Of the houses 20 m away."""
    return np.where(np.abs(x_m - 18.0) < 4.0, 10.0, 4.6)


def draw(x_m: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Blue sky with clouds, two wires, houses, a road; and what is sky."""
    d, over_m = rays(x_m), heights_over_wires_m(x_m)
    image = np.where(is_cloud(d)[..., None], [250.0, 235.0, 225.0], [110.0, 150.0, 210.0])
    is_house = 1.6 + 20 * d[..., 2] / d[..., 1] < roof_m(x_m + 20 * d[..., 0] / d[..., 1])
    image[is_house] = [120.0, 105.0, 95.0]
    is_wire = np.min([np.abs(over_m - z) for z in WIRES_M], axis=0) < 0.045
    image[is_wire] = 40.0
    image[170:] = 90.0
    noisy = image + rng.normal(0.0, 1.5, image.shape)
    return np.clip(np.round(noisy), 0, 255).astype(np.uint8), ~(is_house | is_wire)


def returns(with_wires: bool) -> np.ndarray:
    """Of the houses, and of the wires, measured a little beside them."""
    x = np.linspace(-25, 35, 600)
    houses = [np.stack([x, 0 * x + 20.0, 0 * x + z], axis=1) for z in np.arange(0.2, 10.0, 0.4)]
    points = np.concatenate(houses)
    points = points[points[:, 2] < roof_m(points[:, 0])]
    if with_wires:
        beside = np.linspace(*WIRES_M, 5)[1:-1]
        wires = [np.stack([x, 0 * x + 10.0, z + 0.1 * x], axis=1) for z in beside]
        points = np.concatenate([points, *wires])
    return points.astype(np.float32)


def learnt(rng: np.random.Generator, astray_at: float | None) -> SkyPanorama:
    """From all places; returns of wires fall beside them at one place alone."""
    views = []
    for x in PLACES_M:
        points = returns(with_wires=x == astray_at)
        evidence = _gather(draw(x, rng)[0], CAMERA, pose(x), points, None)
        labels, odds = _classified(evidence, _segment(evidence.lab), None, None)
        views.append(SkyView(evidence, odds[labels]))
    return panoramas({"front": CameraSky.of(views)})["front"]


def test_a_cloud_between_wires_is_sky_though_returns_fall_into_it(
    rng: np.random.Generator,
) -> None:
    image, is_sky = draw(4.0, rng)
    over_m = heights_over_wires_m(4.0)
    strip = is_cloud(rays(4.0)) & is_sky
    strip &= (over_m > WIRES_M[0] + 0.09) & (over_m < WIRES_M[1] - 0.09)
    assert strip.sum() > 200
    points = returns(with_wires=True)
    alone = estimate_sky_matte(image, CAMERA, pose(4.0), points, None).expected
    assert alone[strip].mean() < 0.5
    panorama = learnt(rng, astray_at=4.0)
    found = estimate_sky_matte(image, CAMERA, pose(4.0), points, None, panorama=panorama)
    matte = found.expected
    assert matte[strip].min() > 0.7
    assert (matte <= found.likeliest).all()
    assert found.likeliest[strip].min() > 0.99
    assert not found.likeliest[140:].any()
    assert matte[~is_sky].mean() < 0.02


def test_what_hides_a_sky_that_was_seen_is_none(rng: np.random.Generator) -> None:
    """A dull pane high above all beams, which passes for a cloud."""
    image, _ = draw(4.0, rng)
    pane = (slice(0, 40), slice(180, 300))
    image[pane] = np.clip(rng.normal([150, 150, 154], 1.5, (40, 120, 3)), 0, 255)
    points = returns(with_wires=False)
    alone = estimate_sky_matte(image, CAMERA, pose(4.0), points, None).expected
    assert alone[pane].mean() > 0.9
    panorama = learnt(rng, astray_at=None)
    matte = estimate_sky_matte(image, CAMERA, pose(4.0), points, None, panorama=panorama).expected
    assert matte[3:37, 183:297].max() < 0.1
    assert matte[5:25, :120].min() > 0.9


def test_a_picture_learns_its_sky_from_what_is_surely_sky(rng: np.random.Generator) -> None:
    """A darker pane looks a little like a sky, and would tell so of itself."""
    image, _ = draw(4.0, rng)
    pane = (slice(0, 40), slice(180, 300))
    image[pane] = np.clip(rng.normal([130, 130, 132], 1.5, (40, 120, 3)), 0, 255)
    alone = estimate_sky_matte(image, CAMERA, pose(4.0), returns(with_wires=False), None).expected
    assert alone[pane].max() < 0.1
    assert alone[5:25, :120].min() > 0.9


def gable_beside(gap_deg: float, deepest_deg: float, sky_lab: np.ndarray) -> np.ndarray:
    """Log-likelihood ratios of a pale gable's pixels, right of a sky that ends somewhere: the sky's
    colours from the gable's edge to the left, by degrees; and returns of a house of its colour."""
    azimuth = np.radians(np.arange(len(sky_lab)) * 1.5)
    flat = np.zeros_like(azimuth)
    sky = CertainSky.of(np.stack([np.cos(azimuth), np.sin(azimuth), flat], axis=1), sky_lab)
    beside = np.radians(np.linspace(-gap_deg, -deepest_deg, 200))
    nothing = np.zeros_like(beside)
    directions = np.stack([np.cos(beside), np.sin(beside), nothing], axis=1)
    pale = np.full((200, 3), (88.0, 0.0, -5.0))
    ratio = log_ratios(sky.sky_count(), sky.other_count(directions, pale))
    return sky.against(directions, pale, ratio)


def test_beside_a_clear_sky_what_is_pale_is_none() -> None:
    """A clear sky pales slowly; nothing is told under clouds, nor far from what was seen."""
    steps = np.arange(120.0)
    clear = np.stack([55.0 + 0.1 * steps, 4.0 + 0 * steps, -25.0 + 0.05 * steps], axis=1)
    assert gable_beside(1.5, 20.0, clear).max() < -3.0
    is_cloud = steps % 4 < 2
    clouded = np.where(is_cloud[:, None], [88.0, 0.0, -5.0], clear)
    assert gable_beside(1.5, 20.0, clouded).min() > -2.0
    assert not gable_beside(30.0, 60.0, clear).any()
    assert not gable_beside(1.5, 20.0, np.zeros((0, 3))).any()


def evidence_of(lab: np.ndarray, rotation: np.ndarray) -> ImageEvidence:
    directions = pose(0.0, rotation).rotate(CAMERA.directions(CAMERA.pixel_centres()))
    nothing = np.zeros(lab.shape[:2], bool)
    return ImageEvidence(
        lab=lab.astype(np.float32),
        directions_world=directions.astype(np.float32),
        elevation_deg=np.degrees(np.arcsin(directions[..., 2])).astype(np.float32),
        has_hit=nothing,
        is_scanned=nothing,
        is_silent=nothing,
        is_excluded=directions[..., 2] < 0,
    )


def test_the_same_thing_seen_again_gains_nothing(rng: np.random.Generator) -> None:
    """A wall that every place takes for sky with the same doubt keeps its doubt."""
    lab = np.full((270, 480, 3), (70.0, 2.0, -3.0))
    views = [SkyView(evidence_of(lab, LOOKING_Y), np.full((270, 480), 0.7))] * 4
    sky = CameraSky.of(views)
    ratio = np.where(np.arange(len(sky.sky_count)) < 8, 4.0, -4.0)
    panorama = replace(panoramas({"front": sky})["front"], log_ratio=ratio)
    agreement = panorama.compare(views[0].evidence)
    is_up = views[0].evidence.directions_world[..., 2] > 0
    assert (agreement.kind[is_up] == Kind.SAME).all()
    assert (agreement.kind[~is_up] == Kind.UNKNOWN).all()
    labels = agreement.split(np.zeros((270, 480), np.int64))
    own = agreement.applied_to(labels, np.full(2, 0.7))
    assert own == pytest.approx([0.7, 0.7], abs=1e-6)


def test_directions_are_those_of_the_world(rng: np.random.Generator) -> None:
    """A turned camera meets the same sky at other pixels, across the seam of azimuths as well."""

    def turned(deg: float) -> np.ndarray:
        c, s = np.cos(np.radians(deg)), np.sin(np.radians(deg))
        return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ LOOKING_Y

    def sky(rotation: np.ndarray) -> SkyView:
        evidence = evidence_of(np.zeros((270, 480, 3)), rotation)
        x, y, z = np.moveaxis(evidence.directions_world, -1, 0)
        lab = np.stack([50 + 40 * z, 40 * x, 40 * y], axis=-1)
        return SkyView(evidence_of(lab, rotation), np.full(lab.shape[:2], 6.0))

    camera_sky = CameraSky.of([sky(turned(90.0 + step)) for step in (-8.0, -3.0, 2.0, 7.0)])
    panorama = panoramas({"front": camera_sky})["front"]
    view = sky(turned(93.5))
    agreement = panorama.compare(view.evidence)
    inner = np.zeros((270, 480), bool)
    inner[20:130, 60:420] = True
    error = np.linalg.norm(agreement.expected_lab - view.evidence.lab, axis=-1)
    assert (agreement.kind[inner] == Kind.SAME).all()
    assert error[inner].max() < 0.5
    assert agreement.log_odds[inner] == pytest.approx(6.0, abs=1e-4)


def test_an_edge_of_the_sky_itself_is_none() -> None:
    lab = np.zeros((20, 20, 3), np.float32)
    lab[:, 10:] = [60.0, 5.0, 10.0]
    labels = (np.arange(20) >= 10).astype(np.int64)[None].repeat(20, axis=0)
    even = region_graph(labels, np.zeros_like(lab))
    assert region_graph(labels, lab, lab).agreement_px == pytest.approx(even.agreement_px)
    assert region_graph(labels, lab).agreement_px[0] < 1e-6
    unknown = np.full_like(lab, np.nan)
    assert region_graph(labels, lab, unknown).agreement_px[0] < 1e-6


def test_a_camera_that_stands_still_tells_nothing() -> None:
    def frames(step_m: float, count: int) -> list[CameraFrame]:
        image = np.zeros((2, 2, 3), np.uint8)
        return [
            CameraFrame("front", str(k), k, pose(k * step_m), lambda: image) for k in range(count)
        ]

    assert frames_apart(frames(0.01, 40)) == ()
    assert frames_apart(frames(5.0, 2)) == ()
    apart = frames_apart(frames(0.5, 80))
    places_m = [frame.world_from_camera.translation_m[0] for frame in apart]
    assert len(apart) == 16
    assert places_m[0] == 0.0
    assert places_m[-1] == 39.0
    assert np.diff(places_m).min() >= 2.0
