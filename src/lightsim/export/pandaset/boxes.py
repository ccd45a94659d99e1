"""Boxes of a written log: recorded ones without removed actors, and those of new actors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lightsim.core.actors import ActorKind, ActorTrack
from lightsim.core.alignment import PathCorrection
from lightsim.core.scenario import Scenario
from lightsim.datasets.pandaset.sweeps import ScanTiming
from lightsim.datasets.pandaset.tracks import id_text, label_of, owner_by_uuid
from lightsim.datasets.safe_pickle import Table
from lightsim.export.motion import is_moving_at
from lightsim.store.pandaset_tables import Columns, cuboid_table

# Kinds, besides vehicles, for which PandaSet's boxes have a motion attribute.
_DRIVEN = frozenset({
    ActorKind.MOTORCYCLE, ActorKind.SCOOTER, ActorKind.BICYCLE, ActorKind.PERSONAL_MOBILITY,
})  # fmt: skip


@dataclass(frozen=True, eq=False)
class BoxEditor:
    """Editor of the boxes of a scenario.

    Args:
        scenario: in the world of the twin.
        changed: tracks whose boxes are computed anew.
        removed: uuids whose recorded boxes are removed.
        timing: time at which the roof LiDAR scans each direction.
        path: correction from the recorded world to the twin's.
    """

    scenario: Scenario
    changed: tuple[ActorTrack, ...]
    removed: frozenset[str]
    timing: ScanTiming
    path: PathCorrection | None

    @classmethod
    def between(
        cls,
        recorded: Scenario,
        scenario: Scenario,
        tables: Sequence[Table],
        timing: ScanTiming,
        path: PathCorrection | None,
    ) -> BoxEditor:
        """Return the editor for a scenario that edits made from a recorded log.

        Args:
            tables: the recorded boxes, sweep by sweep.
            timing: time at which the roof LiDAR scans each direction.
            path: correction from the recorded world to the twin's.
        """
        is_ego_moved = scenario.ego is not recorded.ego
        before = {id(track) for track in recorded.tracks}
        remaining = [t for t in scenario.tracks if t.actor_id not in scenario.removed]
        # From another path the LiDAR scans a moving actor at another time.
        changed = [t for t in remaining if id(t) not in before or (is_ego_moved and t.is_moving)]
        names = scenario.removed | {track.actor_id for track in changed}
        pairs = dict.fromkeys(
            pair
            for table in tables
            for pair in zip(
                map(id_text, table["uuid"].tolist()),
                map(id_text, table.get("cuboids.sibling_id", table["uuid"]).tolist()),
                strict=True,
            )
        )
        # PandaSet labels an object in the overlap of two sensors twice, linked by sibling ids.
        owner = owner_by_uuid(pairs)
        owners = {owner.get(name, name) for name in names}
        removed = frozenset(uuid for uuid, own in owner.items() if own in owners)
        return cls(scenario, tuple(changed), removed, timing, path)

    def edited(self, table: Table | None, time_ns: int) -> Columns | None:
        """Return the boxes of a sweep; None if they equal the recorded ones."""
        table = cuboid_table([]) if table is None else table
        uuids = [id_text(uuid) for uuid in table["uuid"].tolist()]
        rows = [
            {name: table[name][i] for name in table}
            for i, uuid in enumerate(uuids)
            if uuid not in self.removed
        ]
        # Recorded columns that the editor does not compute are copied from the actor's old box.
        was = {uuid: i for i, uuid in reversed(list(enumerate(uuids)))}
        made: list[dict[str, Any]] = []
        for track in self.changed:
            now_ns = self._scanned_ns(track, time_ns)
            if now_ns is not None:
                i = was.get(track.actor_id)
                old = {} if i is None else {name: table[name][i] for name in table}
                made.append({**old, **self._row(track, now_ns)})
        if not made and len(rows) == len(uuids):
            return None
        return cuboid_table([*rows, *made], tuple(table))

    def _scanned_ns(self, track: ActorTrack, time_ns: int) -> int | None:
        """Return the time at which the LiDAR scans an actor, for which its box is valid; None if
        absent."""
        assert self.scenario.ego is not None
        if not track.is_present(time_ns):
            return None
        ego_from_world = self.scenario.ego.held(time_ns).inverse()
        now_ns = time_ns
        # Fixed-point iteration: an actor moves little during one sweep, so few rounds suffice.
        for _ in range(3):
            place = ego_from_world.apply(track.trajectory.held(now_ns).translation_m[None])
            now_ns = time_ns + int(self.timing.offsets_s(place)[0] * 1e9)
        return now_ns

    def _row(self, track: ActorTrack, time_ns: int) -> dict[str, Any]:
        """Return the columns of one box.

        PandaSet's box has its width along x and its length along y: yaw = heading - 90 degrees.
        """
        pose = track.trajectory.held(time_ns)
        if self.path is not None:
            pose = self.path.at(time_ns).inverse() @ pose
        length, width, height = track.size_lwh_m.tolist()
        x, y, z = pose.translation_m.tolist()
        return {
            "uuid": track.actor_id,
            "label": label_of(track),
            "yaw": float(np.angle(np.exp(1j * (pose.yaw_rad - np.pi / 2)))),
            "stationary": not track.is_moving,
            "camera_used": -1,
            "position.x": x, "position.y": y, "position.z": z,
            "dimensions.x": width, "dimensions.y": length, "dimensions.z": height,
            "cuboids.sibling_id": "-",
            "cuboids.sensor_id": -1,
            **_attributes(track, time_ns),
        }  # fmt: skip


def _attributes(track: ActorTrack, time_ns: int) -> Mapping[str, str]:
    is_moving = is_moving_at(track, time_ns)
    if track.kind.is_vehicle or track.kind in _DRIVEN:
        still = "Stopped" if track.is_moving else "Parked"
        return {"attributes.object_motion": "Moving" if is_moving else still}
    if track.kind == ActorKind.PEDESTRIAN:
        behaviour = "Walking" if is_moving else "Standing"
        return {"attributes.pedestrian_behavior": behaviour}
    return {}
