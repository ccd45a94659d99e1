"""The data of the lighting networks: skies, street transport, masks, batches."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lightsim.core.dome import irradiance
from lightsim.core.equirect import pixel_directions, uv_from_directions
from lightsim.errors import InputError
from lightsim.lighting.sample import LightingData, PanoramaData
from lightsim.store.images import write_png
from lightsim_lab.synthetic.finishes import make_finishes
from lightsim_lab.synthetic.geometry import Snapshot
from lightsim_lab.synthetic.plan import plan_street
from lightsim_lab.synthetic.street import Street, build_background
from lightsim_lab.training.hdr_skies import measured_sky, read_pool, read_split, shrunk, sky_mask
from lightsim_lab.training.ldr_panoramas import read_ldr_pool
from lightsim_lab.training.lighting_cache import read_cache, write_cache
from lightsim_lab.training.lighting_data import LightingSet
from lightsim_lab.training.near_duplicates import check_split, sky_pairs
from lightsim_lab.training.procedural_skies import UpperSky, rotated_sky, with_sun_raised
from lightsim_lab.training.rigs import RIGS, MaskConfig, mask_of, rig_mask
from lightsim_lab.training.street_panoramas import (
    HORIZON_AZIMUTHS,
    StreetView,
    ViewTracer,
    light_view,
)

HEIGHT = 64
SPLIT = "name,split,group,tier,scene,reason\n"


def test_shrinking_keeps_irradiance_in_every_direction(rng: np.random.Generator) -> None:
    image = rng.random((64, 128, 3)).astype(np.float32) ** 4
    small = shrunk(image, 16)
    up = np.array([0.0, 0.0, 1.0])
    assert small.shape == (16, 32, 3)
    np.testing.assert_allclose(irradiance(small, up), irradiance(image, up), rtol=0.01)


def test_measured_sky_keeps_the_suns_energy(sunny_radiance: np.ndarray) -> None:
    sky = measured_sky(sunny_radiance, "a", None, 16)
    assert sky.sun is not None
    assert sky.entry.tier == "A"
    level = np.median(sunny_radiance[:32, :, 0])
    np.testing.assert_allclose(sky.sun.irradiance * level, 5.0, rtol=0.1)
    assert sky.sun.elevation_deg == pytest.approx(30.0, abs=1.0)


def test_sky_mask_finds_a_dark_wall() -> None:
    panorama = np.full((32, 64, 3), 1.0, np.float32)
    panorama[10:16, 20:40] = 0.1
    assert (sky_mask(panorama, is_all_sky=False) == (panorama[:16, :, 0] > 0.5)).all()
    assert sky_mask(panorama, is_all_sky=True).all()


def test_a_group_on_several_sides_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "split.csv"
    path.write_text(SPLIT + "a,train,g,A,ground,\nb,test,g,A,ground,\n")
    with pytest.raises(InputError, match="several sides"):
        read_split(path)
    path.write_text(SPLIT + "a,train,g,X,ground,\n")
    with pytest.raises(InputError, match="tier of 'a'"):
        read_split(path)


def test_the_written_split_covers_every_file(shared_data: Path) -> None:
    entries = read_split(Path(__file__).resolve().parents[3] / "benchmarks" / "hdri_split.csv")
    names = {p.stem for p in (shared_data / "hdri").iterdir() if p.suffix in (".hdr", ".exr")}
    assert set(entries) == names
    for side in ("validation", "test"):
        held_out = [entry for entry in entries.values() if entry.split == side]
        assert sum(entry.tier == "A" for entry in held_out) >= 3
        assert len(held_out) == 8


@pytest.mark.slow
def test_the_written_split_parts_no_near_duplicates(shared_data: Path) -> None:
    entries = read_split(Path(__file__).resolve().parents[3] / "benchmarks" / "hdri_split.csv")
    skies = read_pool(shared_data / "hdri", entries, 32)
    check_split(skies)
    copies = [pair for pair in sky_pairs(skies) if pair.is_near_duplicate]
    assert len(copies) == 2
    assert all(pair.first.entry.group == pair.second.entry.group for pair in copies)


def test_a_turned_mirrored_and_brighter_copy_is_a_near_duplicate(cache_path: Path) -> None:
    skies = {sky.entry.name: sky for sky in read_cache(cache_path).skies}
    a, b = skies["a"], skies["b"]
    entry = replace(a.entry, name="copy", split="test")
    copy = replace(a, entry=entry, rest=3.0 * np.roll(a.rest[:, ::-1], 18, axis=1))
    first, second, *_ = sky_pairs([a, b, copy])
    assert {first.first.entry.name, first.second.entry.name} == {"a", "copy"}
    assert first.distance < 1e-3
    assert first.correlation == pytest.approx(1.0, abs=1e-3)
    assert not second.is_near_duplicate
    with pytest.raises(InputError, match="near-duplicates"):
        check_split([a, b, copy])
    check_split([a, b])


def open_ground(height_px: int) -> StreetView:
    """Level white ground and nothing else."""
    half = height_px * height_px
    pixel = np.arange(half, 2 * half).astype(np.uint16)
    cosine_rows = np.arcsin(np.sqrt((np.arange(64) + 0.5) / 64))
    rows = np.minimum((cosine_rows / np.pi * height_px).astype(np.int64), height_px // 2 - 1)
    columns = np.arange(64) * 7 % (2 * height_px)
    cells = 2 * half + rows * 2 * height_px + columns
    fraction = np.zeros((height_px, 2 * height_px), np.uint8)
    fraction[height_px // 2 :] = 255
    return StreetView(
        pixel,
        np.full((half, 3), 255, np.uint8),
        np.tile(np.array([0, 0, 127], np.int8), (half, 1)),
        np.repeat(cells[:, None], half, axis=1).astype(np.uint16),
        np.zeros((64, half), np.uint8),
        fraction,
    )


def test_white_open_ground_shows_irradiance_over_pi() -> None:
    rest = np.full((16, 64, 3), 0.7, np.float32)
    sun = np.array([2.0, 1.5, 1.0])
    upper = UpperSky(rest, np.array([0.6, 0.0, 0.8]), sun)
    linear, sky_seen = light_view(open_ground(32), upper)
    expected = 0.7 + 0.8 * sun / np.pi
    np.testing.assert_allclose(linear[20], np.tile(expected, (64, 1)), rtol=1e-4)
    assert sky_seen.all()
    np.testing.assert_array_equal(linear[:16], rest)


def test_turning_a_sky_turns_its_sun_with_it() -> None:
    rest = np.zeros((16, 64, 3), np.float32)
    direction = np.array([np.cos(0.5), 0.0, np.sin(0.5)])
    u, v = uv_from_directions(direction[None])[0]
    rest[int(v * 32), int(u * 64)] = 1.0
    for columns, flip in ((5, False), (40, True)):
        turned = rotated_sky(UpperSky(rest, direction, np.ones(3)), columns, flip=flip)
        spot = np.argwhere(turned.rest[..., 0] > 0)[0]
        u, v = uv_from_directions(turned.sun_direction[None])[0]
        assert abs(u * 64 - spot[1] - 0.5) <= 1.0
        assert int(v * 32) == spot[0]


def test_raising_a_sky_moves_its_bright_row() -> None:
    rest = np.zeros((90, 360, 3), np.float32)
    rest[60] = 1.0  # at 29.5 degrees
    e = np.radians(29.5)
    upper = UpperSky(rest, np.array([np.cos(e), 0.0, np.sin(e)]), np.ones(3))
    raised = with_sun_raised(upper, 40.5)
    assert int(raised.rest[:, 0, 0].argmax()) == 49
    assert np.degrees(np.arcsin(raised.sun_direction[2])) == pytest.approx(40.5)
    assert (raised.sun_irradiance > 1.0).all()


def test_rigs_see_a_band_about_the_horizon(rng: np.random.Generator) -> None:
    exact = MaskConfig(tilt_deg=0.0, scale=0.0, border=0.0, holes=0.0)
    for rig in RIGS:
        mask = mask_of(rig, 64, rng, exact)
        assert mask[32, 64], rig.name
        assert not mask[:16].any()
        assert mask[31:33].mean() > 0.5
    first = rig_mask(64, np.random.default_rng(5))
    assert (first == rig_mask(64, np.random.default_rng(5))).all()


def test_batches_are_consistent_and_repeatable(cache_path: Path) -> None:
    data = LightingSet.load(cache_path)
    assert isinstance(data, LightingData)
    assert data.height_px == HEIGHT
    batch = data.batch(12, 3, 4, only_sunny=False)
    again = data.batch(12, 3, 4, only_sunny=False)
    for name in vars(batch):
        np.testing.assert_array_equal(getattr(batch, name), getattr(again, name))
    assert batch.front.shape[1:] == (40, 64, 3)
    assert batch.panorama.min() >= 0
    assert batch.panorama.max() <= 1
    peak = np.einsum("nhwc,c->nhw", batch.sky, [0.2126, 0.7152, 0.0722]).reshape(12, -1)
    np.testing.assert_allclose(np.log(peak.max(axis=1)), batch.log_peak, rtol=1e-3)
    brightest = pixel_directions(HEIGHT)[: HEIGHT // 2].reshape(-1, 3)[peak.argmax(axis=1)]
    angle = np.degrees(np.arccos(np.clip((brightest * batch.sun_direction).sum(1), -1, 1)))
    assert (angle[batch.is_sunny] < 0.8 * 180 / HEIGHT).all()


def test_only_sunny_batches_are_sunny(cache_path: Path) -> None:
    batch = LightingSet.load(cache_path).batch(10, 0, 0, only_sunny=True)
    assert batch.is_sunny.all()


def test_ldr_panoramas_train_the_inpainting(cache_path: Path, tmp_path: Path) -> None:
    colours = {"a": 200, "b": 100, "unnamed": 50}
    for name, level in colours.items():
        (tmp_path / name).mkdir()
        picture = np.full((80, 160, 3), level, np.uint8)
        write_png(tmp_path / name / f"{name}.png", picture)
    split = read_split(cache_path.parent / "split.csv")
    pool = read_ldr_pool(tmp_path, split, HEIGHT)
    assert [p.side for p in pool] == ["train", "validation", "train"]
    assert [int(p.srgb8.mean()) for p in pool] == [200, 100, 50]
    write_cache(tmp_path / "cache.npz", replace(read_cache(cache_path), ldr=pool))
    cache = read_cache(tmp_path / "cache.npz")
    found = LightingSet(cache, ldr_fraction=1.0).panoramas(16, 0, 0)
    assert {round(255 * float(p.mean())) for p in found.panorama} == {200, 50}
    held_out = LightingSet(cache, "validation", ldr_fraction=1.0).panoramas(2, 0, 0)
    np.testing.assert_allclose(held_out.panorama * 255, 100, rtol=1e-6)
    # Without LDR panoramas the inpainting draws what the sky networks draw.
    plain, batch = LightingSet.load(cache_path), LightingSet.load(cache_path)
    assert isinstance(plain, PanoramaData)
    expected = batch.batch(3, 1, 2, only_sunny=False)
    np.testing.assert_array_equal(plain.panoramas(3, 1, 2).panorama, expected.panorama)
    write_png(tmp_path / "a" / "a.png", np.zeros((80, 80, 3), np.uint8))
    with pytest.raises(InputError, match="twice as wide"):
        read_ldr_pool(tmp_path, split, HEIGHT)


def test_fixed_views_show_held_out_skies_only(cache_path: Path) -> None:
    views = LightingSet.load(cache_path, "validation").fixed_views(4)
    assert views.names == ("b",) * 4
    assert views.own_scene.tolist() == [True, False, True, False]
    np.testing.assert_allclose(
        np.degrees(np.arcsin(views.batch.sun_direction[:, 2])), 50.0, atol=1.5
    )


def test_a_broken_cache_is_named(tmp_path: Path, cache_path: Path) -> None:
    path = tmp_path / "cache.npz"
    with pytest.raises(InputError, match="cannot open"):
        LightingSet.load(path)
    path.write_bytes(cache_path.read_bytes()[:2000])
    with pytest.raises(InputError, match="damaged"):
        LightingSet.load(path)
    np.savez(path, other=np.zeros(3))
    with pytest.raises(InputError, match="no training cache"):
        LightingSet.load(path)


def test_street_shadows_agree_with_rays(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = plan_street(100)
    background = build_background(plan)
    snapshot = Snapshot(Street(plan, background, (), make_finishes(rng, 20.0, 11.0, 3.2)), [])
    eye_street = np.array([10.0, -1.7, 2.0])
    eye = plan.world_from_street.apply(eye_street[None])[0]
    directions = plan.world_from_street.rotate(pixel_directions(16).reshape(-1, 3))
    hits = snapshot.intersect(np.broadcast_to(eye, directions.shape), directions)
    tracer = ViewTracer(snapshot, plan.world_from_street, 16, 4, rng)
    monkeypatch.setattr(tracer, "_free_position", lambda _: (eye, hits))
    view = tracer.trace()
    azimuth, elevation = 2 * np.pi * 10 / HORIZON_AZIMUTHS, np.radians(45.0)
    flat = np.cos(elevation)
    sun = np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])
    linear, _ = light_view(view, UpperSky(np.zeros((8, 32, 3), np.float32), sun, 10 * np.ones(3)))
    towards = plan.world_from_street.rotate(sun)
    pixel = view.pixel.astype(np.int64)
    normals = hits.normal_world[pixel]
    points = eye + hits.distance_m[pixel, None] * directions[pixel]
    lit = snapshot.sun_visibility(points, normals, towards[None])
    expected = view.albedo / 255 * (lit * np.maximum(normals @ towards, 0))[:, None] * 10 / np.pi
    # What exceeds direct sunlight is bounce; shadows that differ lie at borders.
    excess = linear.reshape(-1, 3)[pixel] - expected
    assert (excess > -0.02).all(axis=1).mean() > 0.9
    assert np.median(excess) < 0.1
    assert 0.1 < (expected.max(axis=1) > 0.1).mean() < 0.9
