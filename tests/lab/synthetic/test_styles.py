"""Styles of the street generator: geometry that stands, actors that fit, and finishes that show."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
import pytest
from scipy.sparse.csgraph import connected_components

from lightsim.core.actors import ActorKind
from lightsim.datasets.pandaset.tracks import KIND_BY_LABEL
from lightsim.errors import InputError
from lightsim_lab.synthetic.generate import Variation, actor_poses_at, street_tracer
from lightsim_lab.synthetic.geometry import Snapshot
from lightsim_lab.synthetic.lidar import scan
from lightsim_lab.synthetic.participants import Participant
from lightsim_lab.synthetic.plan import STYLES, StreetConfig, Style, plan_street
from lightsim_lab.synthetic.rig import mount_cameras, street_from_ego
from lightsim_lab.synthetic.sensor import camera_isp
from lightsim_lab.synthetic.shapes import Part
from lightsim_lab.synthetic.skies import build_sky, sky_specs
from lightsim_lab.synthetic.street import Street, build_participants, build_street, style_of
from lightsim_lab.synthetic.styles import industrial, suburban
from lightsim_lab.synthetic.styles.boulevard import draw_terraces
from lightsim_lab.synthetic.styles.halls import build_hall
from lightsim_lab.synthetic.styles.houses import build_garage, build_house
from lightsim_lab.synthetic.styles.tall_facades import build_tall
from lightsim_lab.synthetic.writer import LABEL_BY_KIND, camera_pose

_NEW = [style for style in STYLES if style != "city"]
_SEED = 21
# Length, width and height of the ego vehicle, in metres.
_EGO_M = (5.0, 2.0, 1.9)


@cache
def street_in(style: Style) -> Street:
    return build_street(plan_street(_SEED, style), 13.0)


@pytest.mark.parametrize("style", _NEW)
def test_a_style_has_materials_and_finishes_of_its_own(style: Style) -> None:
    street = street_in(style)
    parts = [*street.background, *(part for actor in street.participants for part in actor.parts)]
    used = {part.material for part in parts}
    assert used <= set(street.finishes)
    others = [street_in(other) for other in _NEW if other != style]
    assert all(used != {part.material for part in other.background} for other in others)
    # Gloss, matt and metal surfaces.
    roughness = [float(street.finishes[name].roughness.mean()) for name in used]
    assert min(roughness) < 0.25
    assert max(roughness) > 0.8
    assert max(street.finishes[name].metallic for name in used) >= 0.2
    # Path tracing of a street costs no more than three times that of the city's 150,000 triangles.
    assert sum(len(part.faces) for part in parts) < 450_000


@pytest.mark.parametrize("style", _NEW)
def test_a_style_is_reproducible_and_a_seed_changes_it(style: Style) -> None:
    style_of_seed = [plan_street(seed, style) for seed in (_SEED, _SEED, _SEED + 1)]
    first, again, other = ([a.start_m for a in build_participants(p, 13.0)] for p in style_of_seed)
    assert first == again != other
    assert plan_street(_SEED).start_ns != plan_street(_SEED, style).start_ns
    assert Variation(style=style).words == f" --style {style}"
    with pytest.raises(InputError, match="style"):
        plan_street(_SEED, "rural")  # pyright: ignore[reportArgumentType]


def _houses(style: Style) -> list[list[Part]]:
    plan = plan_street(_SEED, style)
    if style == "boulevard":
        return [build_tall(building) for building in draw_terraces(plan)[:4]]
    if style == "industrial":
        return [build_hall(plot.hall) for plot in industrial.draw_plots(plan)]
    lots = suburban.draw_lots(plan)
    return [
        build_house(lot.house, np.random.default_rng(lot.seed))
        + build_garage(lot.house, lot.garage)
        for lot in lots
    ]


@pytest.mark.parametrize("style", _NEW)
def test_every_part_of_a_house_is_connected_to_the_ground(style: Style) -> None:
    for parts in _houses(style):
        pieces = _pieces(parts)
        low, high = pieces[:, 0] - 0.03, pieces[:, 1] + 0.03
        touches = ((low[:, None] < high[None]) & (high[:, None] > low[None])).all(axis=-1)
        count, group = connected_components(touches)
        for number in range(count):
            assert low[group == number, 2].min() < 0.2, parts[0].material


def _pieces(parts: Sequence[Part]) -> np.ndarray:
    """Low and high corner of each box, tube or patch."""
    corners = [(part.vertices.min(axis=0), part.vertices.max(axis=0)) for part in parts]
    return np.array(corners)


@pytest.mark.parametrize("style", _NEW)
@pytest.mark.parametrize("has_fast_traffic", [False, True])
def test_no_actor_overlaps_another_or_the_ego_vehicle(style: Style, has_fast_traffic: bool) -> None:
    actors = build_participants(plan_street(_SEED, style), 13.0, has_fast_traffic)
    for time_s in np.linspace(-0.1, 4.0, 9).tolist():
        boxes = [_footprint(actor, time_s) for actor in actors]
        ego = street_from_ego(13.0 * time_s).translation_m
        half = np.array(_EGO_M) / 2
        boxes.append(np.stack([ego[:2] - half[:2], ego[:2] + half[:2]]))
        low, high = np.stack(boxes, axis=1)
        overlap = ((low[:, None] < high[None]) & (high[:, None] > low[None])).all(axis=-1)
        np.fill_diagonal(overlap, False)
        assert not overlap.any(), (time_s, np.argwhere(overlap).tolist())


def _footprint(actor: Participant, time_s: float) -> np.ndarray:
    pose = actor.street_from_actor(time_s)
    half = np.abs(pose.rotation[:2, :2]) @ np.array(actor.size_lwh_m[:2]) / 2
    return np.stack([pose.translation_m[:2] - half, pose.translation_m[:2] + half])


@pytest.mark.parametrize("style", _NEW)
def test_nothing_blocks_the_path_of_the_ego_vehicle(style: Style) -> None:
    street = street_in(style)
    snapshot = Snapshot(Street(street.plan, street.background, (), street.finishes), [])
    # Along the path from behind the start to beyond the end of the longest log; the path swings by
    # 0.25 m.
    y, z = np.meshgrid(-1.7 + np.linspace(-1.3, 1.3, 14), np.linspace(0.1, 2.4, 12))
    starts = np.stack([np.full(y.size, -12.0), y.ravel(), z.ravel()], axis=-1)
    forward = np.broadcast_to([1.0, 0.0, 0.0], starts.shape)
    turned = street.plan.world_from_street
    hits = snapshot.intersect(turned.apply(starts), turned.rotate(forward))
    assert hits.distance_m.min() > 72.0


@pytest.mark.parametrize("style", ["suburban", "industrial"])
def test_drives_lower_the_kerb(style: Style) -> None:
    street = street_in(style)
    plan = street.plan
    if style == "suburban":
        edge = suburban.kerbside(1, suburban.draw_lots(plan))
    else:
        edge = industrial.kerbside(1, industrial.draw_plots(plan))
    drives = [(x0 + x1) / 2 + 0.1 for x0, x1 in edge.lowered]
    usual = [x0 - 2.6 for x0, _ in edge.lowered]
    heights = _heights(street, [*drives, *usual], edge.kerb_y_m + 0.09)
    np.testing.assert_allclose(heights[: len(drives)], 0.03, atol=1e-3)
    np.testing.assert_allclose(np.median(heights[len(drives) :]), edge.height_m, atol=1e-3)
    behind = _heights(street, drives, edge.outer_y_m - 0.05)
    np.testing.assert_allclose(behind, edge.top_m, atol=0.01)


def _heights(street: Street, x: Sequence[float], y: float) -> np.ndarray:
    """Heights of the static surfaces below 1 m."""
    snapshot = Snapshot(Street(street.plan, street.background, (), street.finishes), [])
    starts = np.array([[at, y, 1.0] for at in x])
    down = np.broadcast_to([0.0, 0.0, -1.0], starts.shape)
    turned = street.plan.world_from_street
    return 1.0 - snapshot.intersect(turned.apply(starts), turned.rotate(down)).distance_m


def test_trams_lorries_and_trailers_have_boxes_of_their_kind() -> None:
    kinds = {style: {actor.kind for actor in street_in(style).participants} for style in _NEW}
    everyday = {ActorKind.CAR, ActorKind.PEDESTRIAN}
    assert kinds["suburban"] == everyday
    assert kinds["boulevard"] == everyday | {ActorKind.RAIL_VEHICLE}
    assert kinds["industrial"] == everyday | {ActorKind.TRUCK, ActorKind.TRAILER}
    assert all(KIND_BY_LABEL[label] is kind for kind, label in LABEL_BY_KIND.items())
    for actor in (actor for style in _NEW for actor in street_in(style).participants):
        points = np.concatenate([part.vertices for part in actor.parts])
        extent = np.stack([points.min(axis=0), points.max(axis=0)])
        half = np.array(actor.size_lwh_m) / 2
        np.testing.assert_allclose(extent, np.stack([-half, half]), atol=1e-4)


@pytest.mark.parametrize("style", _NEW)
def test_sweeps_and_pictures_show_the_street(style: Style) -> None:
    street = street_in(style)
    config = StreetConfig(48, 27, azimuth_count=40, environment_height_px=32)
    returns = scan(street, config, 0.2, np.random.default_rng(0))
    assert len(returns.points_world) > 1200
    front = mount_cameras(street.plan, config)[0]
    tracer = street_tracer(street, config, build_sky(sky_specs(street.plan)[0], street.plan, 64))
    tracer.place(actor_poses_at(street, 0.0))
    pose = camera_pose(street.plan, config, front, 0.0)
    picture = camera_isp(tracer.render(front.camera, front.margin_px, pose, 4, 0), front.gain, None)
    assert 30 < picture.mean() < 220
    assert picture.std() > 15


@pytest.mark.parametrize("style", _NEW)
def test_an_edit_finds_a_free_place_in_a_row_of_the_style(style: Style) -> None:
    street = street_in(style)
    snapshot = Snapshot(Street(street.plan, street.background, (), street.finishes), [])
    turned = street.plan.world_from_street
    for y, heading in style_of(street.plan).car_rows:
        starts = np.array([[x, y, 1.0] for x in np.arange(-24.0, 60.0, 6.0)])
        down = np.broadcast_to([0.0, 0.0, -1.0], starts.shape)
        below = snapshot.intersect(turned.apply(starts), turned.rotate(down))
        np.testing.assert_allclose(below.distance_m, 1.0, atol=1e-3)
        assert heading in (0.0, np.pi)
