"""Automatic choice of edits of a synthetic street, for which true images are rendered.

Rules select clearly visible edits for every seed, without choices by hand.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from lightsim.core.actors import ActorKind
from lightsim.core.frames import RigidTransform
from lightsim_lab.synthetic.geometry import Hits, Snapshot
from lightsim_lab.synthetic.participants import CAR_SHAPES, Participant, build_car
from lightsim_lab.synthetic.plan import StreetConfig
from lightsim_lab.synthetic.rig import SWEEP_S, MountedCamera, ego_way_m, street_from_ego
from lightsim_lab.synthetic.street import Street, style_of

NO_EDIT = "none"
INSERTED_ID = "inserted"
INSERTED_MODEL = "car.glb"
# Offset (ahead, left, up) of the ego vehicle in the edit `ego-shift`, in metres: half a lane.
EGO_OFFSET_M = (0.0, 1.5, 0.0)
# Height of removed actors, in metres, far below the ground. They stay in the list, so that the
# indices of the other actors do not change.
_ABSENT_M = -50.0
# Stride, in pixels, of the rays that measure visibility.
_RAY_STRIDE_PX = 4
# Number of most visible actors whose shadows are evaluated, to limit the time.
_CANDIDATES = 4
# Smallest gap between two vehicles along either axis, in metres.
_MIN_GAP_M = 0.4
# Length, width and height of the ego vehicle for collisions, in metres; height 0: footprint only.
_EGO_LWH_M = (5.0, 2.0, 0.0)
# Candidate x positions of an inserted car, frame `street`, in metres.
_INSERTION_X_M = tuple(np.arange(-24.0, 60.0, 1.5).tolist())
# Candidate offsets (ahead, left) of a moved car, in metres.
_OFFSETS_M = tuple((ahead, 0.0) for ahead in (-6.0, -4.0, -2.0, 2.0, 4.0, 6.0))
# Number of views per edit.
_VIEWS = 3


@dataclass(frozen=True, eq=False)
class View:
    """One camera at one frame."""

    mounted: MountedCamera
    index: int

    @property
    def time_s(self) -> float:
        """Time of exposure, in seconds from the start of the log."""
        return SWEEP_S * self.index + self.mounted.time_offset_s


@dataclass(frozen=True, eq=False)
class TrueEdit:
    """One edit, with the edited actors and the views to render.

    Args:
        entries: entries of the edit in SCENARIO.json.
        participants: actors of the edited street, in the order of the staged one; removed ones are
            `absent`.
        views: views with the best visibility.
        ego_offset_m: offset (ahead, left, up) of the ego vehicle from its recorded path.
    """

    name: str
    entries: tuple[Mapping[str, Any], ...]
    participants: tuple[Participant, ...]
    views: tuple[View, ...]
    ego_offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)


# Pixels that an actor covers, and that it shadows, in each view; 0 where the image border crosses
# its box.
_Visibility = Float[np.ndarray, "v 2"]


def staged_street(street: Street) -> Street:
    """Append the car for the edit `insert` to the participants, absent at first."""
    rng = np.random.default_rng([street.plan.seed, 10])
    paint = sorted(name for name in street.finishes if name.startswith("paint"))
    parts, size = build_car(CAR_SHAPES[0], paint[int(rng.integers(len(paint)))])
    car = Participant(INSERTED_ID, ActorKind.CAR, parts, size, (0.0, 0.0, 0.0), 0.0, 0.0)
    return replace(street, participants=(*street.participants, absent(car)))


def absent(actor: Participant) -> Participant:
    """Return the actor moved far below the ground, where no sensor observes it."""
    x, y, _ = actor.start_m
    return replace(actor, start_m=(x, y, _ABSENT_M))


def choose_edits(
    street: Street,
    config: StreetConfig,
    cameras: Sequence[MountedCamera],
    sun_direction_world: Float[np.ndarray, "3"],
) -> tuple[TrueEdit, ...]:
    """Choose the edits of a street.

    They are: no edit (with the views of all others), a parked and a moving car removed, each of
    them moved, a car inserted, and the ego vehicle shifted. Edits that no view shows are omitted.

    The criterion is the geometric mean of the pixels that show the actor and its shadow, as both
    have to be visible, in views with the whole actor.

    Args:
        street: street from `staged_street`.
    """
    views = [View(mounted, k) for k in config.truth_stems for mounted in cameras]
    chooser = _Chooser(street, config, views, sun_direction_world)
    edits = []
    for name, is_moving in (("parked", False), ("moving", True)):
        edits += chooser.removed_and_moved(name, is_moving=is_moving)
    edits.append(chooser.inserted())
    first = tuple(view for view in views if view.index == config.truth_stems[0])
    ego = {"do": "ego", "offset_m": list(EGO_OFFSET_M)}
    edits.append(TrueEdit("ego-shift", (ego,), street.participants, first, EGO_OFFSET_M))
    edits = [edit for edit in edits if edit.views]
    # Views are compared by identity, as they hold arrays; the dictionary removes duplicates.
    shown = {id(view): view for edit in edits for view in edit.views}
    recorded = TrueEdit(NO_EDIT, (), street.participants, tuple(shown.values()))
    return (recorded, *edits)


class _Chooser:
    def __init__(
        self,
        street: Street,
        config: StreetConfig,
        views: Sequence[View],
        sun_direction_world: Float[np.ndarray, "3"],
    ) -> None:
        self._street, self._views, self._sun = street, views, sun_direction_world
        # Collisions are tested at 12 times over the log.
        self._times_s = np.linspace(-SWEEP_S, SWEEP_S * (config.frame_count - 1), 12).tolist()
        ego = [street_from_ego(ego_way_m(config, time_s)) for time_s in self._times_s]
        ways = [self._way(actor) for actor in street.participants]
        ways.append(np.stack([_footprint(pose, _EGO_LWH_M) for pose in ego]))
        self._ways = np.stack(ways)
        self._sights = [_Sight(view, config, street.plan.world_from_street) for view in views]

    def removed_and_moved(self, name: str, *, is_moving: bool) -> Iterator[TrueEdit]:
        """Yield two edits of the best visible car: removed, and moved along its lane."""
        cast = self._street.participants
        cars = [
            i
            for i, actor in enumerate(cast)
            if actor.kind is ActorKind.CAR
            and (actor.speed_m_s > 0) == is_moving
            and actor.start_m[2] != _ABSENT_M
        ]
        # First by visible pixels alone, then the best ones by actor and shadow.
        shown = self._shown(cars)
        candidates = sorted(cars, key=lambda i: -shown[i])[:_CANDIDATES]
        found = {i: self._scored(self._without(i), [cast[i]])[0] for i in candidates}
        best = max(candidates, key=lambda i: _score(found[i]))
        actor, empty = cast[best], self._without(best)
        entry = {"do": "remove", "actor": actor.actor_id}
        yield TrueEdit(f"remove-{name}", (entry,), empty, self._best_views(found[best]))
        moved = {
            offset: other
            for offset in _OFFSETS_M
            if self._is_free(other := _shifted(actor, *offset), best)
        }
        if not moved:
            return
        scores = self._scored(empty, list(moved.values()))
        offset, there = max(zip(moved, scores, strict=True), key=lambda pair: _score(pair[1]))
        entry = {"do": "move", "actor": actor.actor_id, "offset_m": [*offset, 0.0]}
        views = self._best_views(there + found[best])
        yield TrueEdit(f"move-{name}", (entry,), _with(cast, best, moved[offset]), views)

    def inserted(self) -> TrueEdit:
        """Return the edit that inserts the staged car at the best visible free position."""
        cast = self._street.participants
        number = len(cast) - 1
        places = [
            replace(cast[number], start_m=(x, y, 0.0), heading_rad=float(heading))
            for y, heading in style_of(self._street.plan).car_rows
            for x in _INSERTION_X_M
        ]
        free = [car for car in places if self._is_free(car, number)]
        scores = self._scored(cast, free)
        car, found = max(zip(free, scores, strict=True), key=lambda pair: _score(pair[1]))
        pose = self._street.plan.world_from_street @ car.street_from_actor(0.0)
        x, y, _ = pose.translation_m.tolist()
        at = {"x_m": x, "y_m": y, "yaw_deg": float(np.degrees(pose.yaw_rad))}
        entry = {"do": "insert", "asset": INSERTED_MODEL, "id": INSERTED_ID, "at": at}
        cast = _with(cast, number, car)
        return TrueEdit("insert", (entry,), cast, self._best_views(found))

    def _without(self, number: int) -> tuple[Participant, ...]:
        cast = self._street.participants
        return _with(cast, number, absent(cast[number]))

    def _shown(self, numbers: Sequence[int]) -> Mapping[int, float]:
        """Return the largest number of pixels of each actor, over views that show all of it."""
        best = dict.fromkeys(numbers, 0.0)
        for sight in self._sights:
            snapshot = self._snapshot(self._street.participants, sight.view.time_s)
            hits = sight.look(snapshot)
            counts = np.bincount(snapshot.actor[hits.face[hits.is_hit]] + 1)
            for i in numbers:
                actor = self._street.participants[i]
                if i + 1 < len(counts) and sight.shows_all_of(actor):
                    best[i] = max(best[i], float(counts[i + 1]))
        return best

    def _scored(
        self, cast: tuple[Participant, ...], actors: Sequence[Participant]
    ) -> list[_Visibility]:
        """Return the visibility of each actor if it alone were added to a cast."""
        pixels = np.zeros((len(actors), len(self._sights), 2))
        for j, sight in enumerate(self._sights):
            whole = [i for i, actor in enumerate(actors) if sight.shows_all_of(actor)]
            if not whole:
                continue
            surfaces = sight.surfaces(self._snapshot(cast, sight.view.time_s), self._sun)
            for i in whole:
                alone = self._snapshot((actors[i],), sight.view.time_s, is_alone=True)
                pixels[i, j] = sight.covered_and_shadowed(alone, surfaces, self._sun)
        return list(pixels)

    def _snapshot(
        self, cast: tuple[Participant, ...], time_s: float, *, is_alone: bool = False
    ) -> Snapshot:
        background = () if is_alone else self._street.background
        street = replace(self._street, background=background, participants=cast)
        plan = self._street.plan
        poses = [plan.world_from_street @ actor.street_from_actor(time_s) for actor in cast]
        return Snapshot(street, poses)

    def _best_views(self, visibility: _Visibility) -> tuple[View, ...]:
        """Return the views with most pixels, in the order of the frames."""
        total = visibility.sum(axis=1)
        order = np.argsort(-total, kind="stable")[:_VIEWS].tolist()
        return tuple(self._views[i] for i in sorted(order) if total[i] > 0)

    def _is_free(self, actor: Participant, number: int) -> bool:
        """Return True if an actor never overlaps another actor or the ego vehicle."""
        own, others = self._way(actor), np.delete(self._ways, number, axis=0)
        # Axis-aligned footprints overlap if they overlap along both axes, at any time.
        is_before = others[:, :, 0] < own[:, 1] + _MIN_GAP_M
        is_behind = own[:, 0] < others[:, :, 1] + _MIN_GAP_M
        return not (is_before & is_behind).all(axis=-1).any()

    def _way(self, actor: Participant) -> Float[np.ndarray, "t 2 2"]:
        """Return the footprints (low and high corner) of an actor over time."""
        poses = [actor.street_from_actor(time_s) for time_s in self._times_s]
        return np.stack([_footprint(pose, actor.size_lwh_m) for pose in poses])


class _Sight:
    """Coarse rays of a view, which measure visibility."""

    def __init__(self, view: View, config: StreetConfig, world_from_street: RigidTransform) -> None:
        self.view = view
        self._camera = view.mounted.camera.scaled(1 / _RAY_STRIDE_PX)
        ego = street_from_ego(ego_way_m(config, view.time_s))
        self._street_from_camera = ego @ view.mounted.ego_from_camera
        pose = world_from_street @ self._street_from_camera
        uv = self._camera.pixel_centres().reshape(-1, 2)
        self._directions = pose.rotate(self._camera.directions(uv))
        self._origins = np.broadcast_to(pose.translation_m, self._directions.shape).copy()

    def look(self, snapshot: Snapshot) -> Hits:
        """Return the first hits of the rays."""
        return snapshot.intersect(self._origins, self._directions)

    def shows_all_of(self, actor: Participant) -> bool:
        """Return True if the image contains all corners of an actor's box."""
        corners = np.stack(np.meshgrid(*[[-0.5, 0.5]] * 3), axis=-1).reshape(-1, 3)
        pose = self._street_from_camera.inverse() @ actor.street_from_actor(self.view.time_s)
        return bool(self._camera.project(pose.apply(corners * actor.size_lwh_m))[1].all())

    def surfaces(
        self, snapshot: Snapshot, sun: Float[np.ndarray, "3"]
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Return the distances along the rays, and the sun visibility of the surfaces."""
        hits = self.look(snapshot)
        lit = np.zeros(len(self._directions))
        points = self._points(hits.distance_m, hits.is_hit)
        normals = hits.normal_world[hits.is_hit]
        lit[hits.is_hit] = snapshot.sun_visibility(points, normals, sun[None])
        return hits.distance_m, lit

    def covered_and_shadowed(
        self,
        alone: Snapshot,
        surfaces: tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]],
        sun: Float[np.ndarray, "3"],
    ) -> tuple[float, float]:
        """Return the numbers of pixels that an actor covers, and of lit pixels that it shadows."""
        distance_m, lit = surfaces
        is_covered = self.look(alone).distance_m < distance_m
        is_lit = ~is_covered & (lit > 0)
        points = self._points(distance_m, is_lit)
        is_shadowed = alone.is_occluded(points, np.broadcast_to(sun, points.shape).copy())
        return float(is_covered.sum()), float(is_shadowed.sum())

    def _points(
        self, distance_m: Float[np.ndarray, " n"], chosen: Bool[np.ndarray, " n"]
    ) -> Float[np.ndarray, "k 3"]:
        return self._origins[chosen] + distance_m[chosen, None] * self._directions[chosen]


def _score(visibility: _Visibility) -> tuple[float, ...]:
    """Return the sort key of an actor: scores of the three best views, the lowest first.

    The third best view has priority, so that several views show the edit well.
    """
    return tuple(np.sort(np.sqrt(visibility.prod(axis=1)))[-_VIEWS:].tolist())


def _with(
    cast: tuple[Participant, ...], number: int, actor: Participant
) -> tuple[Participant, ...]:
    return (*cast[:number], actor, *cast[number + 1 :])


def _shifted(actor: Participant, ahead_m: float, left_m: float) -> Participant:
    """Return the actor with an offset of its path, along its own axes."""
    c, s = np.cos(actor.heading_rad), np.sin(actor.heading_rad)
    x, y, z = actor.start_m
    start = (float(x + c * ahead_m - s * left_m), float(y + s * ahead_m + c * left_m), z)
    return replace(actor, start_m=start)


def _footprint(
    pose: RigidTransform, size_lwh_m: tuple[float, float, float]
) -> Float[np.ndarray, "2 2"]:
    """Return the low and high (x, y) corner of a box's bounding rectangle, frame `street`.

    Boxes are nearly parallel to the street, so that the rectangle is tight.
    """
    half = np.abs(pose.rotation[:2, :2]) @ np.array(size_lwh_m[:2]) / 2
    # Absent actors are moved away sideways, as they obstruct no other actor.
    centre = pose.translation_m[:2] + (0.0 if pose.translation_m[2] > _ABSENT_M / 2 else 1e6)
    return np.stack([centre - half, centre + half])
