"""Instances and annotations of nuScenes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

from lightsim.core.actors import ActorTrack
from lightsim.core.frame_labels import ActorLabel
from lightsim.core.sensors import LidarSweep
from lightsim.export.nuscenes.names import (
    ATTRIBUTES,
    CATEGORIES,
    CATEGORY_BY_KIND,
    VISIBILITY,
    attribute_of,
    visibility_token,
)
from lightsim.export.nuscenes.samples import Samples
from lightsim.export.nuscenes.tables import Tables, link, pose_entries
from lightsim.export.scenario_log import ScenarioLog, count_returns
from lightsim.progress import Progress


def add_names(tables: Tables) -> None:
    """Add all categories, attributes and levels of visibility."""
    for name in CATEGORIES:
        tables.add("category", tables.token("category", name), {"name": name, "description": ""})
    for name in ATTRIBUTES:
        tables.add("attribute", tables.token("attribute", name), {"name": name, "description": ""})
    for token, (_, level) in VISIBILITY.items():
        row = {"level": level, "description": f"visibility of whole object is {level[1:]} %"}
        tables.add("visibility", token, row)


def add_boxes(
    log: ScenarioLog, samples: Samples, tables: Tables, progress: Progress
) -> Mapping[str, int]:
    """Add the annotations of every sample; return the number of boxes without a category."""
    left_out: Counter[str] = Counter()
    by_actor: dict[str, list[dict[str, Any]]] = {}
    track_by_id: dict[str, ActorTrack] = {track.actor_id: track for track in log.log.actors}
    stems = samples.key_stems.items()
    for stem, time_ns in progress.track(stems, "write boxes", len(samples.key_stems)):
        labels = [
            log.labels(frame).by_actor for frame in log.log.frames if frame.stem == stem
        ]  # fmt: skip
        lazy = log.sweep_by_stem.get(stem)
        sweep = None if lazy is None else lazy.load()
        for track in log.log.actors_at(time_ns):
            if track.kind not in CATEGORY_BY_KIND:
                left_out[str(track.kind)] += 1
                continue
            seen = [of_actor[track.actor_id] for of_actor in labels if track.actor_id in of_actor]
            row = _annotation(tables, track, time_ns, sweep)
            row |= {
                "sample_token": samples.token_of(stem, time_ns),
                "visibility_token": visibility_token(_visibility(seen)),
            }
            token = tables.token("annotation", track.actor_id, stem)
            tables.add("sample_annotation", token, row)
            by_actor.setdefault(track.actor_id, []).append(tables.rows["sample_annotation"][-1])
    for actor_id, rows in by_actor.items():
        link(rows)
        category = CATEGORY_BY_KIND[track_by_id[actor_id].kind]
        row = {
            "category_token": tables.token("category", category),
            "nbr_annotations": len(rows),
            "first_annotation_token": rows[0]["token"],
            "last_annotation_token": rows[-1]["token"],
        }
        tables.add("instance", tables.token("instance", actor_id), row)
    return left_out


def _annotation(
    tables: Tables, track: ActorTrack, time_ns: int, sweep: LidarSweep | None
) -> dict[str, Any]:
    length, width, height = track.size_lwh_m.tolist()
    attribute = attribute_of(track, time_ns)
    return {
        "instance_token": tables.token("instance", track.actor_id),
        "attribute_tokens": [tables.token("attribute", attribute)] if attribute else [],
        **pose_entries(track.world_from_actor(time_ns)),
        "size": [width, length, height],
        "num_lidar_pts": count_returns(track, sweep),
        "num_radar_pts": 0,
    }


def _visibility(seen: list[ActorLabel]) -> float:
    """Return the visible fraction of an actor in all pictures of a sample; 0 outside of them, and
    for actors without a mesh."""
    amodal_px = sum(label.amodal_px for label in seen)
    return sum(label.visible_px for label in seen) / amodal_px if amodal_px else 0.0
