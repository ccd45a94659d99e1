"""Streets whose ego vehicle stands: its way, its body in LiDAR and cameras, and cross traffic."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lightsim_lab.synthetic.generate import Variation, snapshot_at
from lightsim_lab.synthetic.lidar import scan
from lightsim_lab.synthetic.plan import StreetConfig, config_of, plan_street
from lightsim_lab.synthetic.rig import ego_way_m, mount_cameras, world_from_ego
from lightsim_lab.synthetic.street import Street, build_street
from lightsim_lab.synthetic.styles.crossing import is_crossed


@pytest.fixture(scope="module")
def street() -> Street:
    return build_street(plan_street(5), 13.0, is_standing=True)


def test_the_ego_vehicle_stands_starts_or_stops() -> None:
    config = replace(config_of("medium"), standing="stand")
    times_s = np.linspace(-0.1, 3.9, 41)

    def way_m(config: StreetConfig) -> np.ndarray:
        return np.array([ego_way_m(config, time_s) for time_s in times_s.tolist()])

    assert np.ptp(way_m(config)) < 0.3
    start = way_m(replace(config, standing="start"))
    assert (start[times_s <= 2.0] == 0).all()
    assert 3.0 < start[-1] < 4.0
    stop = way_m(replace(config, standing="stop"))
    is_middle = (times_s > 1.4) & (times_s < 2.6)
    assert (stop[is_middle] == 0).all()
    assert stop[0] < -1.5
    assert stop[-1] > 1.5
    assert (np.diff(stop) >= 0).all()
    assert Variation(standing="stop").words == " --standing stop"
    assert Variation(standing="stop").of(config).standing == "stop"


@pytest.mark.parametrize("standing", ["stand", "stop"])
def test_the_lidar_sees_bonnet_roof_and_boot_at_one_place_of_the_ego_vehicle(
    street: Street, standing: str
) -> None:
    config = Variation(standing=standing).of(replace(config_of("medium"), azimuth_count=200))  # pyright: ignore[reportArgumentType]
    body = np.concatenate([part.vertices for part in street.ego_body])
    for time_s in (0.3, 2.0):
        returns = scan(street, config, time_s, np.random.default_rng(0))
        pose = world_from_ego(street.plan, config, time_s)
        # Points of each firing are tested at their own time: the vehicle moves .2 m in a sweep.
        local = np.stack([
            world_from_ego(street.plan, config, time_s + offset).inverse().apply(point[None])[0]
            for point, offset in zip(returns.points_world, returns.offset_s.tolist(), strict=True)
            if np.linalg.norm(point - pose.translation_m) < 4.5
        ])  # fmt: skip
        is_own = ((local > body.min(axis=0) - 0.1) & (local < body.max(axis=0) + 0.1)).all(axis=1)
        is_own &= local[:, 2] > 0.5
        for low, high, top in ((1.9, 3.4, 1.3), (-1.0, 1.3, 1.75), (-2.5, -1.5, 1.3)):
            part = local[is_own & (local[:, 0] > low) & (local[:, 0] < high)]
            assert len(part) > 8
            assert part[:, 2].max() < top + 0.1


def test_front_and_back_cameras_see_the_body(street: Street) -> None:
    config = Variation(standing="stand").of(config_of("small"))
    snapshot = snapshot_at(street, config, 0.5)
    found = {}
    for mounted in mount_cameras(street.plan, config):
        camera = mounted.camera.scaled(0.25)
        pose = world_from_ego(street.plan, config, 0.5) @ mounted.ego_from_camera
        directions = pose.rotate(camera.directions(camera.pixel_centres().reshape(-1, 2)))
        origins = np.broadcast_to(pose.translation_m, directions.shape).copy()
        hits = snapshot.intersect(origins, directions)
        is_own = hits.is_hit & (snapshot.actor[hits.face] == len(street.participants))
        found[mounted.camera.name] = float(is_own.mean())
    for name in ("front_left_camera", "front_right_camera", "back_camera"):
        assert 0.05 < found[name] < 0.3


def test_cars_cross_a_free_junction_ahead_of_the_ego_vehicle(street: Street) -> None:
    crossing = [a for a in street.participants if abs(np.sin(a.heading_rad)) > 0.9]
    before, after = ([a.street_from_actor(t).translation_m[1] for a in crossing] for t in (0, 3.9))
    assert sum(np.sign(y0) != np.sign(y1) for y0, y1 in zip(before, after, strict=True)) >= 2
    for actor in street.participants:
        x, half_m = actor.start_m[0], actor.size_lwh_m[0] / 2
        is_waiting = actor.kind.is_vehicle and actor not in crossing
        assert not (is_waiting and is_crossed(x - half_m, x + half_m))
        assert not is_waiting or actor.speed_m_s == 0
