"""scenario.json: a scenario, and the actors' boxes of every frame as labels."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, get_args

from lightsim.core.actors import ActorKind, ActorTrack
from lightsim.core.camera import PinholeCamera
from lightsim.core.frames import RigidTransform, Trajectory
from lightsim.core.scenario import (
    ActorPlacement,
    FrameSource,
    Scenario,
    ScenarioFrame,
    placed_elsewhere,
)
from lightsim.core.sensors import CameraFrame
from lightsim.core.sky_choice import SkyChoice
from lightsim.core.twin import ActorAsset, DigitalTwin
from lightsim.errors import ArtefactError
from lightsim.store.artefact import write_json
from lightsim.store.entries import Entries

SCENARIO_NAME = "scenario.json"
_VERSION = 1


def write_scenario(folder: Path, scenario: Scenario, **found: Any) -> None:
    """Write FOLDER/scenario.json, the form in which SCENARIO.json is given, and more: the whole
    scenario, and what making it `found` (facts of the sky, settings), for people."""
    sky, ego = scenario.sky, scenario.ego
    write_json(
        folder / SCENARIO_NAME,
        {
            "version": _VERSION,
            "name": scenario.name,
            "sky": None if sky is None else sky.sky,
            "sky_yaw_deg": None if sky is None else sky.yaw_deg,
            "sky_scale": None if sky is None else sky.scale,
            "move_sun": None if sky is None else sky.move_sun,
            "sun_factor": None if sky is None else sky.sun_factor,
            "edits": scenario.edits,
            "seed": scenario.seed,
            "notes": scenario.notes,
            **found,
            "cameras": scenario.cameras,
            "ego": None if ego is None else _poses(ego),
            "actors": [_actor(scenario, track) for track in scenario.tracks],
            "frames": [_frame(scenario, frame) for frame in scenario.frames],
        },
    )


def _poses(trajectory: Trajectory) -> dict[str, Any]:
    name = f"{trajectory.dst}_from_{trajectory.src}"
    return {"times_ns": trajectory.times_ns, name: trajectory.matrices}


def _box(scenario: Scenario, track: ActorTrack) -> dict[str, Any]:
    return {
        "actor_id": track.actor_id,
        "number": scenario.number_by_actor[track.actor_id],
        "kind": track.kind,
        "label": track.label,
        "size_lwh_m": track.size_lwh_m,
    }


def _actor(scenario: Scenario, track: ActorTrack) -> dict[str, Any]:
    assets = [p.asset.actor_id for p in scenario.placements if p.track is track]
    return {
        **_box(scenario, track),
        "is_moving": track.is_moving,
        "is_removed": track.actor_id in scenario.removed,
        "asset": assets[0] if assets else None,
        **_poses(track.trajectory),
    }


def _frame(scenario: Scenario, frame: ScenarioFrame) -> dict[str, Any]:
    return {
        "camera": frame.camera_name,
        "frame": frame.stem,
        "source": frame.source,
        "time_ns": frame.time_ns,
        "world_from_camera": frame.world_from_camera.matrix,
        "actors": [
            {
                **_box(scenario, track),
                "world_from_actor": track.world_from_actor(frame.time_ns).matrix,
            }
            for track in scenario.tracks_at(frame.time_ns)
        ],
    }


def read_scenario(
    folder: Path, twin: DigitalTwin, inserted: Mapping[str, ActorAsset] = MappingProxyType({})
) -> Scenario:
    """The scenario of FOLDER/scenario.json; assets and recorded images are those of `twin`.

    Args:
        inserted: assets that are not the twin's, by the name that the file gives them.

    Raises:
        ArtefactError: the file is missing or broken, or names what the twin does not have.
    """
    value = Entries.of_file(folder / SCENARIO_NAME)
    if value.number("version") != _VERSION:
        raise _unknown(folder, "version of scenario.json", f"{value.number('version'):g}")
    actors = value.objects("actors")
    tracks = tuple(_read_track(actor) for actor in actors)
    placements = tuple(_read_placements(actors, tracks, {**twin.assets.actors, **inserted}, folder))
    of_log = (ActorPlacement(twin.assets.actors[t.actor_id], t) for t in twin.log.actors
              if t.actor_id in twin.assets.actors)  # fmt: skip
    recorded = {(f.camera_name, f.stem): f for f in twin.log.frames}
    cameras = value.object("cameras")
    return Scenario(
        value.text("name"),
        tuple(_read_frame(frame, recorded, folder) for frame in value.objects("frames")),
        placements,
        tracks,
        {name: _read_camera(cameras.object(name)) for name in cameras},
        None if value.is_null("ego") else _read_poses(value.object("ego"), "ego"),
        _read_sky(value),
        tuple(edit.mapping() for edit in value.objects("edits")),
        int(value.whole_numbers("seed", ())),
        frozenset(t.actor_id for a, t in zip(actors, tracks, strict=True) if a.flag("is_removed")),
        placed_elsewhere(tuple(of_log), placements),
        value.texts("notes"),
    )


def _unknown(folder: Path, what: str, got: str) -> ArtefactError:
    return ArtefactError(
        f"there is no such {what}",
        where=folder / SCENARIO_NAME,
        got=got,
        remedy="Read it with the twin that it was made from.",
    )


def _read_sky(value: Entries) -> SkyChoice | None:
    if value.is_null("sky"):
        return None
    return SkyChoice(
        value.text("sky"),
        value.number("sky_yaw_deg"),
        value.text("sky_scale"),
        value.text("move_sun"),
        value.number("sun_factor"),
    )


def _read_camera(value: Entries) -> PinholeCamera:
    size = [int(value.whole_numbers(name, ())) for name in ("width_px", "height_px")]
    return PinholeCamera(
        value.text("name"), *size, *(value.number(name) for name in ("fx", "fy", "cx", "cy"))
    )


def _read_poses(value: Entries, src: str) -> Trajectory:
    times_ns = value.whole_numbers("times_ns", (None,))
    matrices = value.numbers(f"world_from_{src}", (len(times_ns), 4, 4))
    return Trajectory("world", src, times_ns, matrices)


def _read_track(value: Entries) -> ActorTrack:
    return ActorTrack(
        value.text("actor_id"),
        value.member("kind", ActorKind),
        value.numbers("size_lwh_m", (3,)),
        _read_poses(value, "actor"),
        value.flag("is_moving"),
        value.text("label"),
    )


def _read_placements(
    actors: tuple[Entries, ...],
    tracks: tuple[ActorTrack, ...],
    assets: Mapping[str, ActorAsset],
    folder: Path,
) -> list[ActorPlacement]:
    placements = []
    for value, track in zip(actors, tracks, strict=True):
        if value.is_null("asset"):
            continue
        asset = value.text("asset")
        if asset not in assets:
            raise _unknown(folder, "asset in the twin", asset)
        placements.append(ActorPlacement(assets[asset], track))
    return placements


def _read_frame(
    value: Entries, recorded: Mapping[tuple[str, str], CameraFrame], folder: Path
) -> ScenarioFrame:
    name = (value.text("camera"), value.text("frame"))
    if name not in recorded:
        raise _unknown(folder, "frame in the log", "/".join(name))
    pose = RigidTransform("world", "camera", value.numbers("world_from_camera", (4, 4)))
    return ScenarioFrame(
        *name,
        int(value.whole_numbers("time_ns", ())),
        pose,
        recorded[name].load_srgb8,
        recorded[name].shutter,
        source=value.word("source", get_args(FrameSource)),
    )
