"""Kinds of actors and their one numbering."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lightsim.core.actors import ActorKind, ActorTrack
from lightsim.core.frames import Trajectory
from lightsim.core.log import DrivingLog
from lightsim.core.scenario import ActorPlacement, Scenario
from lightsim.core.twin import ActorAsset
from lightsim.geometry.surface import make_mesh


def _track(actor_id: str) -> ActorTrack:
    pose = Trajectory("world", "actor", np.array([0], dtype=np.int64), np.eye(4)[None])
    return ActorTrack(actor_id, ActorKind.CAR, np.ones(3), pose, False)


def test_a_kind_is_at_most_one_of_vehicle_two_wheeler_and_person() -> None:
    for kind in ActorKind:
        assert kind.is_vehicle + kind.is_person <= 1
        assert not kind.is_rigid_body or not kind.is_person
        assert kind.is_rigid_body or not kind.is_vehicle
    assert ActorKind.CONE.is_rigid_body
    names = ("is_vehicle", "is_person", "is_rigid_body")
    assert not any(getattr(ActorKind.OTHER, name) for name in names)


def test_a_label_is_the_kinds_by_default() -> None:
    assert _track("a").label == "car"
    assert replace(_track("a"), label="Emergency Vehicle").label == "Emergency Vehicle"


def test_an_actor_without_shape_keeps_its_number_free() -> None:
    tracks = tuple(_track(actor_id) for actor_id in "cab")
    ego = Trajectory("world", "ego", np.array([0], dtype=np.int64), np.eye(4)[None])
    log = DrivingLog("log", {}, (), (), ego, tracks, None, {})
    mesh = make_mesh("actor", np.eye(3), np.arange(3)[None])
    placements = (ActorPlacement(ActorAsset("b", ActorKind.CAR, mesh), tracks[2]),)
    scenario = Scenario("s", (), placements, tracks=log.actors)
    assert scenario.number_by_actor == log.number_by_actor == {"c": 0, "a": 1, "b": 2}
