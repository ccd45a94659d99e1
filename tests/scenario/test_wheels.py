"""Wheels of models: found by their shape, turned by the way."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.render.rendering_scenes import box

from lightsim.core.actors import ActorKind, ActorTrack
from lightsim.core.frames import Trajectory
from lightsim.core.mesh import TriMesh, concatenate_meshes
from lightsim.core.scenario import ActorPlacement
from lightsim.core.twin import ActorAsset
from lightsim.render.scene import placed_meshes
from lightsim.scenario.models import centred, read_model
from lightsim.scenario.shipped_assets import shipped_assets
from lightsim.scenario.wheels import find_wheels, with_wheels
from lightsim_lab.synthetic.shapes import tube

RADIUS_M = 0.35
PLACES = [(x, y) for x in (-1.3, 1.2) for y in (-0.8, 0.8)]


def disc(
    x: float, y: float, radius_m: float = RADIUS_M, sides: int = 24, up_m: float = 0.0
) -> TriMesh:
    z = RADIUS_M + up_m
    part = tube("rubber", (x, y - 0.1, z), (x, y + 0.1, z), (radius_m, radius_m), sides)
    return TriMesh("actor", part.vertices, part.faces, np.full((len(part.vertices), 3), 0.1, "f4"))


def vehicle(*wheels: TriMesh) -> TriMesh:
    body = replace(box((0, 0, 1.0), (4.2, 1.7, 1.2), 0.3), frame="actor")
    return centred(replace(concatenate_meshes([body, *wheels]), frame="actor"))


def test_round_parts_on_the_ground_in_pairs_are_wheels_with_all_that_is_in_them() -> None:
    hubs = [disc(x, y * 1.1, 0.1) for x, y in PLACES]
    mesh = vehicle(*(disc(*place) for place in PLACES), *hubs)
    wheels = find_wheels(mesh)
    centres = np.array([wheel.centre for wheel in wheels])
    middle = (mesh.vertices.max(axis=0)[2] - 1.6) + RADIUS_M
    wanted = np.array([[x, y, middle] for x, y in PLACES])
    np.testing.assert_allclose(centres[np.lexsort(centres.T[[1, 0]])], wanted, atol=1e-3)
    assert [wheel.radius_m for wheel in wheels] == pytest.approx([RADIUS_M] * 4, rel=0.02)
    body = len(box((0, 0, 0), (1, 1, 1)).vertices)
    turning = np.sort(np.concatenate([wheel.vertices for wheel in wheels]))
    assert (turning == np.arange(body, len(mesh.vertices))).all()


def test_treads_around_tyres_turn_with_them_once() -> None:
    treads = [disc(x, y * 1.01, RADIUS_M * 1.02) for x, y in PLACES]
    wheels = find_wheels(vehicle(*(disc(*place) for place in PLACES), *treads))
    assert len(wheels) == 4
    turning = np.concatenate([wheel.vertices for wheel in wheels])
    assert len(np.unique(turning)) == len(turning) == 8 * len(disc(0.0, 0.0).vertices)
    assert find_wheels(vehicle(*(disc(*place) for place in PLACES[:2]), *treads[:2])) == ()


@pytest.mark.parametrize(
    "wheels",
    [
        [disc(*PLACES[0]), disc(*PLACES[1])],
        [disc(*place, sides=4) for place in PLACES],
        [disc(*place, up_m=0.6) for place in PLACES],
    ],
    ids=["one pair", "square", "in the air"],
)
def test_what_is_not_round_or_not_in_pairs_or_not_on_the_ground_is_no_wheel(
    wheels: list[TriMesh],
) -> None:
    feet = replace(box((0, 0, 0.2), (3.0, 0.2, 0.4), 0.3), frame="actor")
    assert find_wheels(vehicle(feet, *wheels)) == ()


def test_wheels_roll_on_the_road() -> None:
    """The point of the tyre that touches the ground stands still; the axle goes with the car. After
    a whole turn everything is as it was; backwards it turns back."""
    asset = with_wheels(ActorAsset("car", ActorKind.CAR, vehicle(*(disc(*p) for p in PLACES))))
    radius_m = asset.wheels[0].radius_m
    times_ns = np.array([0, 1_000_000_000, 2_000_000_000], dtype=np.int64)
    for yaw in (0.0, 2.0):
        c, s = np.cos(yaw), np.sin(yaw)
        poses = np.tile(np.eye(4), (3, 1, 1))
        poses[:, :2, :2] = [[c, -s], [s, c]]
        poses[:, :2, 3] = np.outer([0.0, 2 * np.pi * radius_m, 0.0], [c, s])
        path = Trajectory("world", "actor", times_ns, poses)
        track = ActorTrack("car", ActorKind.CAR, np.array([4.2, 1.8, 1.6]), path, True)
        placement = ActorPlacement(asset, track)

        def in_actor(time_ns: int, placement: ActorPlacement = placement) -> np.ndarray:
            (mesh,) = placed_meshes([placement], time_ns)
            return placement.world_from_actor(time_ns).inverse().apply(mesh.vertices)

        start, turned, quarter = in_actor(0), in_actor(1_000_000_000), in_actor(250_000_000)
        np.testing.assert_allclose(turned, start, atol=1e-5)
        np.testing.assert_allclose(in_actor(1_750_000_000), quarter, atol=1e-5)
        still = np.ones(len(start), bool)
        for wheel in asset.wheels:
            still[wheel.vertices] = False
            x, _, z = (start[wheel.vertices] - wheel.centre).T
            after = quarter[wheel.vertices] - wheel.centre
            # A quarter turn ahead: what was on top is in front, what was in front is below.
            np.testing.assert_allclose(after[:, [0, 2]], np.stack([z, -x], axis=1), atol=1e-5)
        np.testing.assert_allclose(quarter[still], start[still], atol=1e-5)
        ground = path.at(10_000_000).translation_m[:2] - path.at(0).translation_m[:2]
        wheel = asset.wheels[0]
        low = wheel.vertices[start[wheel.vertices, 2].argmin()]
        world = [placed_meshes([placement], t)[0].vertices[low, :2] for t in (0, 10_000_000)]
        assert np.linalg.norm(world[1] - world[0]) < 0.04 * np.linalg.norm(ground)


def test_cars_and_trucks_that_ship_have_wheels() -> None:
    found = {name: len(asset.wheels) for name, asset in shipped_assets().items()}
    with_four = {"car", "car-red", "car-black", "van", "truck"}
    assert {name for name, count in found.items() if count == 4} == with_four
    assert sum(found.values()) == 4 * len(with_four)


@pytest.mark.parametrize(
    ("name", "radius_m", "count"),
    [("prius_hybrid", 0.305, 4), ("pickup", 0.422, 4), ("suv", 0.467, 4), ("hatchback", 0.321, 4),
     ("ambulance", 0.432, 6), ("construction_barrel", 0, 0), ("jersey_barrier", 0, 0)],
)  # fmt: skip
def test_wheels_of_real_models(name: str, radius_m: float, count: int, shared_data: Path) -> None:
    mesh = read_model(shared_data / "cad" / f"{name}.glb")
    found = [wheel.radius_m for wheel in find_wheels(mesh)]
    assert found == pytest.approx([radius_m] * count, abs=2e-3)
