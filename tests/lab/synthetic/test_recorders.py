"""Streets recorded as by other vehicles: what the readers return is what the street is."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lightsim.core.reading import LogReading
from lightsim.core.solar import angle_between_deg, direction_enu
from lightsim.datasets.reader import read_log
from lightsim.progress import SilentProgress
from lightsim.store.images import write_jpeg
from lightsim_lab.synthetic import as_kitti, as_nuscenes
from lightsim_lab.synthetic.lidar import scan
from lightsim_lab.synthetic.plan import StreetConfig, plan_street
from lightsim_lab.synthetic.rig import SWEEP_S, mount_cameras, world_from_ego
from lightsim_lab.synthetic.street import Street, build_street
from lightsim_lab.synthetic.truth import stem_of

CONFIG = StreetConfig(frame_count=6, azimuth_count=40, sway=1.0)


@pytest.fixture(scope="module")
def street() -> Street:
    return build_street(plan_street(0), CONFIG.ego_speed_m_s)


@pytest.fixture(scope="module")
def pictures(street: Street, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The pictures of a log, all black."""
    log = tmp_path_factory.mktemp("street") / "log"
    black = np.zeros((CONFIG.height_px, CONFIG.width_px, 3), np.uint8)
    for mounted in mount_cameras(street.plan, CONFIG):
        folder = log / "camera" / mounted.camera.name
        folder.mkdir(parents=True)
        for k in range(CONFIG.frame_count):
            write_jpeg(folder / f"{stem_of(k)}.jpg", black)
    return log


def test_nuscenes_reads_back_the_street(
    street: Street, pictures: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(as_nuscenes, "_COLUMNS", 40)
    scene = as_nuscenes.record_as_nuscenes(street, CONFIG, pictures, tmp_path, SilentProgress())
    place = f"{street.plan.latitude_deg},{street.plan.longitude_deg}"
    log = read_log(LogReading(source=str(tmp_path), scene=scene, place=place))
    local = as_nuscenes.Localisation.of(street, CONFIG)
    assert len(log.cameras) == 6
    assert len(log.sweeps) == 2 * CONFIG.frame_count - 1
    for frame in log.frames_of("CAM_FRONT"):
        (mounted,) = (m for m in mount_cameras(street.plan, CONFIG)
                      if m.camera.name == "front_camera")  # fmt: skip
        time_s = SWEEP_S * int(frame.stem) + mounted.time_offset_s
        expected = local.recorded(time_s) @ mounted.ego_from_camera
        at = frame.world_from_camera.translation_m + log.origin_m
        np.testing.assert_allclose(at, expected.translation_m, atol=2e-3)
    # Returns of the fifth sweep: moved by the localisation's error, each at its own time.
    time_s = 4 * as_nuscenes.HDL32E.sweep_s
    settings = replace(CONFIG, azimuth_count=40)
    rng = np.random.default_rng([street.plan.seed, 22, 4])
    found = scan(street, settings, time_s, rng, as_nuscenes.HDL32E)
    moved = local.recorded(time_s) @ local.true(time_s).inverse()
    near = np.linalg.norm(
        local.true(time_s).inverse().apply(found.points_world)[:, :2], axis=1
    ) > 2.5  # fmt: skip
    sweep = sorted(log.sweeps, key=lambda lazy: lazy.time_ns)[4].load()
    read = sweep.points_world + np.array(log.origin_m)
    expected_points = moved.apply(found.points_world[near])
    distance = np.abs(read[:, None] - expected_points).max(axis=2).min(axis=0)
    assert distance.max() < 5e-3
    # A column lasts 1.25 ms here; its middle is the time that the scan used.
    nearest = np.abs(read[:, None] - expected_points).max(axis=2).argmin(axis=0)
    error_s = sweep.time_offset_s[nearest] - found.offset_s[near]
    assert np.abs(error_s).max() < 0.00126
    sun = None if log.geo is None else log.geo.direction_at(log.frames[0].time_ns)
    assert sun is not None
    true_sun = street.plan.sun
    assert log.geo is not None
    position = log.geo.sun_at(log.frames[0].time_ns)
    assert position is not None
    assert position.elevation_deg == pytest.approx(true_sun.elevation_deg, abs=0.05)
    assert position.azimuth_deg == pytest.approx(true_sun.azimuth_deg, abs=0.05)


def test_kitti_reads_back_the_street(street: Street, pictures: Path, tmp_path: Path) -> None:
    """Poses have six degrees of freedom, so points agree with the street itself."""
    drive = as_kitti.record_as_kitti(street, CONFIG, pictures, tmp_path)
    log = read_log(LogReading(source=str(drive)))
    turn = street.plan.enu_from_world
    start = world_from_ego(street.plan, CONFIG, mount_cameras(street.plan, CONFIG)[0].time_offset_s)
    k = 3
    sweep = next(lazy for lazy in log.sweeps if int(lazy.stem) == k).load()
    found = scan(
        street, CONFIG, SWEEP_S * k, np.random.default_rng([street.plan.seed, 24, k])
    )  # fmt: skip
    # KITTI's world starts at the unit's first position, which is the ego's within centimetres.
    offset = (turn @ start).translation_m
    read = sweep.points_world + np.array(log.origin_m)
    expected = turn.apply(found.points_world)
    shift = np.array([offset[0], offset[1], 0.0])
    distance = np.linalg.norm(read[:, None] + shift - expected, axis=2).min(axis=0)
    assert np.median(distance) < 0.03
    assert np.quantile(distance, 0.95) < 0.1
    towards = None if log.geo is None else log.geo.direction_at(log.frames[0].time_ns)
    assert towards is not None
    sun = street.plan.sun
    assert angle_between_deg(towards, direction_enu(sun.azimuth_deg, sun.elevation_deg)) < 0.05
