"""Labelled boxes joined to tracks."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from lightsim.core.actors import ActorKind, ActorTrack
from lightsim.core.frames import RigidTransform, Trajectory
from lightsim.datasets.plausible import LIMITS
from lightsim.errors import InputError

# Two labels of an actor closer in time than this are duplicates, in nanoseconds.
_MIN_GAP_NS = 20_000_000
# Displacement from which an actor counts as moving, in metres; smaller ones are jitter of labels.
_MOVED_M = 0.5
# Displacement from which an actor labelled as moving counts as moving, in metres.
_LABELLED_MOVED_M = 0.2
# Number of labels that a message lists.
_LABELS_SHOWN = 6


@dataclass(frozen=True, eq=False)
class TimedBox:
    """One label of an actor; `world_from_actor` is the pose of the box's centre.

    Args:
        is_labelled_moving: the data set labels the actor as moving at this time.
    """

    time_ns: int
    actor_id: str
    label: str
    size_lwh_m: Float64[np.ndarray, "3"]
    world_from_actor: RigidTransform
    is_labelled_moving: bool = False


def tracks_of(
    boxes: Iterable[TimedBox], kind_by_label: Mapping[str, ActorKind], where: object
) -> tuple[tuple[ActorTrack, ...], tuple[str, ...]]:
    """Return one track for each actor, longest first, and notes on doubled boxes and on unknown
    labels, whose actors get the kind OTHER.

    Args:
        where: the file of the boxes, for messages.

    Raises:
        InputError: the size of a box is implausible.
    """
    by_actor: dict[str, list[TimedBox]] = {}
    for box in boxes:
        by_actor.setdefault(box.actor_id, []).append(box)
    tracks: list[ActorTrack] = []
    n_doubled = 0
    for actor_id, labels in by_actor.items():
        labels.sort(key=lambda box: box.time_ns)
        kept = labels[:1]
        for box in labels[1:]:
            if box.time_ns - kept[-1].time_ns >= _MIN_GAP_NS:
                kept.append(box)
        n_doubled += len(labels) - len(kept)
        tracks.append(_track(kept, kind_by_label, f"{where}, actor {actor_id[:60]}"))
    tracks.sort(key=lambda track: (-len(track.trajectory), track.actor_id))
    notes = [f"{n_doubled} boxes repeat an actor at one time and are not used"] if n_doubled else []
    return tuple(tracks), (*notes, *unknown_label_notes(tracks, kind_by_label, "unknown labels"))


def unknown_label_notes(
    tracks: Iterable[ActorTrack], kind_by_label: Mapping[str, ActorKind], subject: str
) -> tuple[str, ...]:
    """Return a note on labels without a kind, whose actors have the kind OTHER; none without such
    labels.

    Args:
        subject: the labels in words, at the beginning of the note.
    """
    counts = Counter(track.label for track in tracks if track.label not in kind_by_label)
    if not counts:
        return ()
    shown = ", ".join(f"{n} x '{label[:40]}'" for label, n in counts.most_common(_LABELS_SHOWN))
    more = ", ..." if len(counts) > _LABELS_SHOWN else ""
    return (f"{subject} count as neither vehicles nor persons: {shown}{more}",)


def _track(boxes: list[TimedBox], kind_by_label: Mapping[str, ActorKind], where: str) -> ActorTrack:
    sizes = np.stack([box.size_lwh_m for box in boxes])
    most = LIMITS["box"].most
    if not ((sizes > 0) & (sizes < most)).all():
        raise InputError(
            "the size of a box is out of range",
            where=where,
            got=f"{sizes.min():.4g} to {sizes.max():.4g} m",
            expected=f"above 0 and below {most:g} m",
        )
    trajectory = Trajectory(
        "world",
        "actor",
        np.array([box.time_ns for box in boxes], dtype=np.int64),
        np.stack([box.world_from_actor.matrix for box in boxes]),
    )
    moved_m = np.linalg.norm(trajectory.positions_m - trajectory.positions_m[0], axis=1).max()
    is_labelled_moving = any(box.is_labelled_moving for box in boxes)
    label = boxes[0].label
    return ActorTrack(
        boxes[0].actor_id,
        kind_by_label.get(label, ActorKind.OTHER),
        np.median(sizes, axis=0),
        trajectory,
        bool(moved_m > (_LABELLED_MOVED_M if is_labelled_moving else _MOVED_M)),
        label,
    )
