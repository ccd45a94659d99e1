"""The synthetic street: deterministic geometry, true numbers, and a log that reads."""

from __future__ import annotations

import hashlib
import json
import shutil
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from lightsim.core.camera import PinholeCamera
from lightsim.core.dome import Sun, find_sun, irradiance
from lightsim.core.frames import RigidTransform
from lightsim.core.reading import LogReading
from lightsim.core.solar import angle_between_deg, direction_world, solar_position
from lightsim.datasets.reader import read_log
from lightsim.errors import InputError
from lightsim.progress import SilentProgress
from lightsim.store.artefact import write_json
from lightsim.store.hdr import read_sky
from lightsim.store.images import read_exr
from lightsim_lab.synthetic import generate, shipped_street, synthesize
from lightsim_lab.synthetic.generate import Variation, guides_at
from lightsim_lab.synthetic.geometry import Snapshot
from lightsim_lab.synthetic.guides import Guides, render_guides
from lightsim_lab.synthetic.lidar import scan
from lightsim_lab.synthetic.plan import StreetConfig, config_of, plan_street
from lightsim_lab.synthetic.rig import MountedCamera, mount_cameras, street_from_ego
from lightsim_lab.synthetic.sensor import camera_isp
from lightsim_lab.synthetic.shapes import rectangle, tube
from lightsim_lab.synthetic.skies import (
    FurtherSkies,
    build_sky,
    drawn_sky_specs,
    environment,
    sky_specs,
)
from lightsim_lab.synthetic.street import (
    Street,
    build_background,
    build_participants,
    build_street,
)
from lightsim_lab.synthetic.textures import Finish, brick, constant
from lightsim_lab.synthetic.tracer import PathTracer

_MAX_BYTES = 12_000_000


@pytest.fixture(scope="module")
def street() -> Street:
    return build_street(plan_street(3), 13.0)


def _digest(seed: int) -> str:
    plan = plan_street(seed)
    actors = build_participants(plan, 13.0)
    parts = [*build_background(plan), *(part for actor in actors for part in actor.parts)]
    digest = hashlib.sha256(json.dumps([a.actor_id for a in actors]).encode())
    for part in parts:
        digest.update(part.material.encode() + part.vertices.tobytes() + part.faces.tobytes())
    return digest.hexdigest()


def test_a_seed_fixes_the_street_and_another_seed_changes_it() -> None:
    digests = [_digest(3), _digest(3), _digest(4)]
    assert digests[0] == digests[1] != digests[2]
    first, again = (brick(np.random.default_rng(1), (0.4, 0.2, 0.1)) for _ in range(2))
    np.testing.assert_array_equal(first.base_colour, again.base_colour)
    with pytest.raises(InputError, match="seed"):
        plan_street(-1)


def test_fast_traffic_replaces_the_oncoming_cars_and_nothing_else() -> None:
    plan = plan_street(3)
    usual = {actor.actor_id: actor for actor in build_participants(plan, 13.0)}
    fast = build_participants(plan, 13.0, has_fast_traffic=True)
    column = [actor for actor in fast if actor.actor_id not in usual]
    assert len(usual) - (len(fast) - len(column)) == 3
    assert len(column) >= 10
    assert len({actor.speed_m_s for actor in column}) == 1
    assert 15.0 <= column[0].speed_m_s <= 18.0
    order = sorted(column, key=lambda actor: actor.start_m[0])
    for behind, before in pairwise(order):
        apart_m = before.start_m[0] - behind.start_m[0]
        assert apart_m - (before.size_lwh_m[0] + behind.size_lwh_m[0]) / 2 > 4.0
    words = Variation(has_fast_traffic=True).words
    assert words == " --fast-traffic"
    assert Variation(has_fast_traffic=True).of(config_of("small")).has_fast_traffic


@pytest.mark.parametrize("seed", [0, 1, 2, 7])
def test_the_sun_is_that_of_place_and_time_and_crosses_the_street(seed: int) -> None:
    plan = plan_street(seed)
    expected = solar_position(plan.latitude_deg, plan.longitude_deg, plan.start_ns)
    sun = build_sky(sky_specs(plan)[0], plan, 128).sun
    assert sun is not None
    towards = direction_world(expected.azimuth_deg, expected.elevation_deg, plan.enu_from_world)
    assert angle_between_deg(sun.direction_world, towards) < 1e-6
    assert 35.0 < expected.elevation_deg < 50.0
    along = plan.world_from_street.rotation[:, 0]
    flat = np.array([*towards[:2], 0.0]) / np.linalg.norm(towards[:2])
    assert 0.5 - 1e-9 <= abs(float(np.cross(along, flat)[2])) <= 0.87


def test_actor_boxes_are_tight(street: Street) -> None:
    for actor in street.participants:
        points = np.concatenate([part.vertices for part in actor.parts])
        extent = np.stack([points.min(axis=0), points.max(axis=0)])
        half = np.array(actor.size_lwh_m) / 2
        np.testing.assert_allclose(extent, np.stack([-half, half]), atol=1e-4)


def test_gains_have_geometric_mean_one(street: Street) -> None:
    gains = np.stack([m.gain for m in mount_cameras(street.plan, StreetConfig())])
    np.testing.assert_allclose(np.exp(np.log(gains).mean(axis=0)), 1.0, atol=1e-12)
    assert 0.03 < np.log(gains).std() < 0.2


def test_drawn_suns_stand_anywhere_and_more_of_them_keep_the_first(street: Street) -> None:
    specs = drawn_sky_specs(street.plan, 200)
    suns = [spec.sun for spec in specs if spec.sun is not None]
    assert len({spec.name for spec in specs}) == len(suns) == 200
    turns = np.radians([sun.azimuth_deg for sun in suns])
    assert np.hypot(np.cos(turns).mean(), np.sin(turns).mean()) < 0.15
    heights = np.array([sun.elevation_deg for sun in suns])
    assert heights.min() >= 10.0
    assert heights.max() <= 60.0
    assert specs[:3] == drawn_sky_specs(street.plan, 3)
    with pytest.raises(InputError, match="drawn-suns"):
        FurtherSkies(drawn_suns=-1)


def test_skies_keep_their_energy(street: Street) -> None:
    up = np.array([0.0, 0.0, 1.0])
    for spec in (*sky_specs(street.plan), *drawn_sky_specs(street.plan, 4)):
        sky = build_sky(spec, street.plan)
        expected = sky.sky_irradiance()
        assert (sky.sun is None) == (spec.sun is None), spec.name
        if sky.sun is not None:
            expected = expected + sky.sun.irradiance * sky.sun.direction_world[2]
            found = find_sun(sky.dome(128).radiance)
            assert found is not None
            assert angle_between_deg(found.direction_world, sky.sun.direction_world) < 0.7
        np.testing.assert_allclose(irradiance(sky.dome(128).radiance, up), expected, rtol=0.01)


def test_sweep_lies_on_the_surfaces(street: Street) -> None:
    config = replace(StreetConfig(), azimuth_count=60)
    returns = scan(street, config, 0.2, np.random.default_rng(0))
    world_from_ego = street.plan.world_from_street @ street_from_ego(0.2 * config.ego_speed_m_s)
    local = world_from_ego.inverse().apply(returns.points_world)
    is_road = (np.abs(local[:, 1] + 1.7) < 3.0) & (np.abs(local[:, 2]) < 0.2)
    assert len(returns.points_world) > 2000
    assert is_road.sum() > 300
    assert abs(float(np.median(local[is_road, 2]))) < 0.01
    assert ((returns.offset_s > -0.1) & (returns.offset_s <= 0)).all()


def test_sun_visibility_of_a_disc() -> None:
    plan = plan_street(0)
    finishes = {"grey": _grey()}
    plate = rectangle("grey", (-1.0, -1.0, 2.0), (2.0, 0, 0), (0, 2.0, 0))
    floor = rectangle("grey", (-5.0, -5.0, 0.0), (10.0, 0, 0), (0, 10.0, 0))
    snapshot = Snapshot(Street(plan, (floor, plate), (), finishes), [])
    points = plan.world_from_street.apply(np.array([[0.0, 0.0, 0.0], [3.0, 3.0, 0.0]]))
    up = np.repeat([[0.0, 0.0, 1.0]], 2, axis=0)
    visible = snapshot.sun_visibility(points, up, np.array([[0.0, 0.0, 1.0]]))
    np.testing.assert_array_equal(visible, [0.0, 1.0])


def test_texture_lookup_repeats_and_interpolates() -> None:
    texture = np.arange(8, dtype=np.float32).reshape(2, 4, 1) * np.ones(3, np.float32)
    finish = Finish(texture, (4.0, 2.0), constant(0.5))
    uv = np.array([[0.5, 0.5], [4.5, 2.5], [1.0, 0.5], [2.5, 1.5]])
    np.testing.assert_allclose(finish.look_up(uv)[:, 0], [0.0, 0.0, 0.5, 6.0])


def test_the_sensor_clips_and_its_noise_is_one_per_cent_or_two(rng: np.random.Generator) -> None:
    grey = np.full((200, 200, 3), 0.18, dtype=np.float32)
    clean, noisy = camera_isp(grey, np.ones(3), None), camera_isp(grey, np.ones(3), rng)
    assert np.unique(clean).tolist() == [118]
    assert 0.5 < noisy.std() < 1.5
    assert camera_isp(grey * 100, np.ones(3), rng).min() == 255


def _grey() -> Finish:
    return Finish(np.full((2, 2, 3), 0.6, dtype=np.float32), (1.0, 1.0), constant(1.0))


def test_path_tracer_casts_a_poles_shadow_away_from_the_sun() -> None:
    """The pin of CONVENTIONS: a sun at azimuth A throws the shadow towards A + 180 degrees."""
    plan = plan_street(5)
    sky = build_sky(sky_specs(plan)[0], plan, 64)
    towards = direction_world(200.0, 45.0, plan.enu_from_world)
    sun = Sun(towards, np.full(3, 4.0, dtype=np.float32))
    floor = rectangle("grey", (-20.0, -20.0, 0.0), (40.0, 0, 0), (0, 40.0, 0))
    pole = tube("grey", (0, 0, 0), (0, 0, 3.0), (0.2, 0.2))
    finishes = {"grey": _grey()}
    tracer = PathTracer([floor, pole], [], finishes, environment(sky, 32), sun, "scalar_rgb")
    camera = PinholeCamera("above", 64, 36, 80.0, 80.0, 32.0, 18.0)
    down = np.diag([1.0, -1.0, -1.0])
    position = np.array([0.0, 0.0, 10.0])
    pose = RigidTransform.from_rotation("world", "camera", down, position)
    image = tracer.render(camera, (0, 0), pose, 60, 0)[..., 1].astype(np.float64)
    rays = pose.rotate(camera.directions(camera.pixel_centres()).reshape(-1, 3))
    ground = position - rays * (position[2] / rays[:, 2:])
    offset = ground[:, :2]
    is_ring = (np.hypot(*offset.T) > 0.7) & (np.hypot(*offset.T) < 2.0)
    is_dark = image.ravel() < 0.6 * np.median(image)
    shadow = offset[is_ring & is_dark].mean(axis=0)
    angle = np.degrees(np.arctan2(*np.flip(shadow)) - np.arctan2(-towards[1], -towards[0]))
    assert abs((angle + 180) % 360 - 180) < 3.0


def test_guides_are_means_over_the_pixels_area() -> None:
    """Of a plate whose edges cross pixels at known fractions, seen from above."""
    plan = plan_street(5)
    plate = rectangle("grey", (0.0, 0.0, 0.0), (1.03, 0, 0), (0, 0.57, 0))
    snapshot = Snapshot(Street(plan, (plate,), (), {"grey": _grey()}), [])
    # A pixel is 10 cm; the plate begins where two pixels meet.
    camera = PinholeCamera("above", 24, 16, 100.0, 100.0, 4.0, 12.0)
    down = plan.world_from_street.rotation @ np.diag([1.0, -1.0, -1.0])
    pose = RigidTransform.from_rotation("world", "above", down, np.array([0.0, 0.0, 10.0]))
    guides = render_guides(snapshot, camera, pose)
    columns, rows = np.zeros(24), np.zeros(16)
    columns[4:14], columns[14] = 1.0, 0.3
    rows[7:12], rows[6] = 1.0, 0.7
    expected = rows[:, None] * columns
    np.testing.assert_allclose(guides.base_colour[..., 0], 0.6 * expected, atol=0.6 / 16 + 1e-3)
    np.testing.assert_allclose(guides.normal_world[..., 2], expected, atol=1 / 16 + 1e-3)
    inside = guides.base_colour[expected == 1.0]
    np.testing.assert_allclose(inside, 0.6, atol=1e-6)


def test_skies_of_a_pose_share_the_guides_of_their_denoising(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("pyoidn", reason="needs the extra `denoise`")
    config = StreetConfig(48, 27, 2, 10, truth_stems=(1,), buffer_stems=(), dome_height_px=16)
    config = replace(config, samples=1, truth_samples=1, environment_height_px=32)
    monkeypatch.setattr(generate, "config_of", lambda _: config)
    monkeypatch.setattr(generate, "sky_specs", lambda plan: sky_specs(plan)[:2])
    asked = []

    def noted(street: Street, _: StreetConfig, mounted: MountedCamera, time_s: float) -> Guides:
        asked.append((mounted.camera.name, time_s))
        return guides_at(street, config, mounted, time_s)

    monkeypatch.setattr(generate, "guides_at", noted)
    synthesize(tmp_path, seed=3, size="small", progress=SilentProgress(), is_denoised=True)
    assert len(list(tmp_path.rglob("*.jpg"))) == 18
    assert len(asked) == len(set(asked)) == 12


# The street that ships with the package.


def test_shipped_street_is_small_and_says_how_it_was_made() -> None:
    folder = shipped_street()
    assert sum(p.stat().st_size for p in folder.rglob("*") if p.is_file()) <= _MAX_BYTES
    truth = json.loads((folder / "truth" / "truth.json").read_text())
    assert truth["command"] == "lightsim synthesize --seed 0 --size small --denoise"
    actors = build_participants(plan_street(0), StreetConfig().ego_speed_m_s)
    assert truth["actors"] == [actor.actor_id for actor in actors]


def test_shipped_log_reads_and_agrees_with_its_truth() -> None:
    folder = shipped_street()
    log = read_log(LogReading(source=str(folder / "log")))
    truth = json.loads((folder / "truth" / "truth.json").read_text())
    assert len(log.cameras) == 6
    assert len(log.frames) == 6 * len(log.sweeps)
    assert {actor.actor_id for actor in log.actors} == set(truth["actors"])
    assert log.geo is not None
    assert log.geo.enu_from_world is not None
    towards = log.geo.direction_at(log.frames[0].time_ns)
    assert towards is not None
    source = json.loads((folder / "truth" / "skies" / "source.json").read_text())
    assert angle_between_deg(towards, np.array(source["direction_world"])) < 0.05
    for sky in (folder / "truth" / "skies").glob("*.exr"):
        assert read_sky(sky).heading_deg == pytest.approx(log.geo.heading_deg, abs=0.01)


def test_shipped_sweeps_agree_with_the_true_depth() -> None:
    folder = shipped_street()
    log = read_log(LogReading(source=str(folder / "log")))
    stem = json.loads((folder / "truth" / "truth.json").read_text())["buffer_stems"][0]
    sweep = next(s for s in log.sweeps if s.stem == stem).load()
    for path in sorted((folder / "truth" / "depth_z_m").glob(f"*/{stem}.exr")):
        name = path.parent.name
        frame = next(f for f in log.frames_of(name) if f.stem == stem)
        points = frame.world_from_camera.inverse().apply(sweep.points_world.astype(np.float64))
        uv, is_inside = log.cameras[name].project(points)
        column, row = uv[is_inside].astype(np.int64).T
        error = np.abs(read_exr(path)[row, column] - points[is_inside, 2])
        assert is_inside.sum() > 1000
        assert np.median(error) < 0.05, name


def test_shipped_relit_frames_are_complete() -> None:
    folder = shipped_street()
    truth = json.loads((folder / "truth" / "truth.json").read_text())
    for name in ("low_sun", "high_sun", "overcast"):
        facts = json.loads((folder / "truth" / "skies" / f"{name}.json").read_text())
        level = np.array(facts["sky_irradiance"])
        if name != "overcast":
            level = level + facts["direction_world"][2] * np.array(facts["irradiance"])
        dome = read_exr(folder / "truth" / "skies" / f"{name}.exr")
        found_level = irradiance(dome, np.array([0.0, 0.0, 1.0]))
        np.testing.assert_allclose(found_level, level, rtol=0.02, err_msg=name)
        found = {(p.parent.name, p.stem) for p in (folder / f"truth/relit/{name}").glob("*/*.jpg")}
        assert found == {(c, s) for c in truth["camera_gains"] for s in truth["relit_stems"]}


@pytest.mark.slow
def test_a_finished_street_is_kept_and_a_lost_sweep_is_made_again(tmp_path: Path) -> None:
    folder = tmp_path / "street"
    shutil.copytree(shipped_street(), folder)
    lost = folder / "log" / "lidar" / "04.pkl.gz"
    lost.unlink()
    kept = {p: p.read_bytes() for p in folder.rglob("*") if p.suffix in (".jpg", ".gz", ".npz")}
    truth = json.loads((folder / "truth" / "truth.json").read_text())
    progress = SilentProgress()
    synthesize(folder, seed=0, size="small", progress=progress, is_denoised=True)
    assert all(path.read_bytes() == data for path, data in kept.items())
    assert json.loads((folder / "truth" / "truth.json").read_text()) == truth
    again, shipped = (
        next(s for s in read_log(LogReading(source=str(f / "log"))).sweeps if s.stem == "04").load()
        for f in (folder, shipped_street())
    )
    np.testing.assert_allclose(again.points_world, shipped.points_world, atol=0.01)


def test_a_folder_of_another_street_is_refused_and_skies_may_be_added(tmp_path: Path) -> None:
    truth = tmp_path / "truth" / "truth.json"
    truth.parent.mkdir()
    made = "lightsim synthesize --seed 0 --size small --denoise"
    write_json(truth, {"command": made})
    for other in (made + " --renderer cycles", made.replace("0", "1"), made + " --paths 8"):
        with pytest.raises(InputError, match=r"truth\.json.*another command"):
            generate._check_same_street(truth, other)
    for more in (" --more-skies", " --drawn-suns 2", " --sky a.hdr b.hdr", ""):
        generate._check_same_street(truth, made + more)
    with pytest.raises(InputError, match="another --out"):
        synthesize(tmp_path, seed=0, size="benchmark", progress=SilentProgress())
    assert [path.name for path in tmp_path.iterdir()] == ["truth"]


def test_a_missing_street_is_said_clearly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Path, "is_dir", lambda self: False)
    with pytest.raises(InputError, match="synthesize"):
        shipped_street()
