"""Actor tracks of labelled boxes, and kinds of actors by common labels."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64, Int64

from lightsim.core.actors import ActorKind, ActorTrack
from lightsim.core.frames import Trajectory

# Displacement from which an actor counts as moving, in metres: labels of parked cars jitter by
# decimetres.
_MOVED_M = 0.5
# Number of labels that a message lists.
_LABELS_SHOWN = 6
# Words of labels that are not the name of a kind; beginnings of words count.
_WORDS = (
    ("pickup", ActorKind.PICKUP),
    ("construction vehicle", ActorKind.CONSTRUCTION_VEHICLE),
    ("excavator", ActorKind.CONSTRUCTION_VEHICLE),
    ("trailer", ActorKind.TRAILER),
    ("truck", ActorKind.TRUCK),
    ("lorry", ActorKind.TRUCK),
    ("bus", ActorKind.BUS),
    ("tram", ActorKind.RAIL_VEHICLE),
    ("train", ActorKind.RAIL_VEHICLE),
    ("trolley", ActorKind.RAIL_VEHICLE),
    ("motorcycl", ActorKind.MOTORCYCLE),
    ("motorbike", ActorKind.MOTORCYCLE),
    ("scooter", ActorKind.SCOOTER),
    ("bicycl", ActorKind.BICYCLE),
    ("cyclist", ActorKind.BICYCLE),
    ("bike", ActorKind.BICYCLE),
    ("stroller", ActorKind.PERSONAL_MOBILITY),
    ("wheelchair", ActorKind.PERSONAL_MOBILITY),
    ("pedestrian", ActorKind.PEDESTRIAN),
    ("person", ActorKind.PEDESTRIAN),
    ("human", ActorKind.PEDESTRIAN),
    ("animal", ActorKind.ANIMAL),
    ("dog", ActorKind.ANIMAL),
    ("cone", ActorKind.CONE),
    ("pylon", ActorKind.CONE),
    ("sign", ActorKind.SIGN),
    ("barrier", ActorKind.BARRIER),
    ("car", ActorKind.CAR),
    ("van", ActorKind.CAR),
    ("sedan", ActorKind.CAR),
    ("suv", ActorKind.CAR),
    ("vehicle", ActorKind.OTHER_VEHICLE),
)


def kind_of(label: str) -> ActorKind | None:
    """Return the kind of a label in common English words; None if no word is known."""
    text = " ".join("".join(c if c.isalnum() else " " for c in label.lower()).split())
    if text in set(ActorKind):
        return ActorKind(text)
    return next((kind for word, kind in _WORDS if f" {word}" in f" {text}"), None)


def unknown_label_notes(tracks: Iterable[ActorTrack], is_known: Iterable[bool]) -> tuple[str, ...]:
    """Return a note on the labels that no kind is known of."""
    pairs = zip(tracks, is_known, strict=True)
    counts = Counter(track.label for track, known in pairs if not known)
    if not counts:
        return ()
    shown = ", ".join(f"{n} x '{label[:40]}'" for label, n in counts.most_common(_LABELS_SHOWN))
    return (
        f"actors with unknown labels count as neither vehicles nor persons: {shown}"
        + (", ..." if len(counts) > _LABELS_SHOWN else ""),
    )


def track_of_boxes(
    actor_id: str,
    label: str,
    kind: ActorKind,
    times_ns: Int64[np.ndarray, " n"],
    world_from_actor: Float64[np.ndarray, "n 4 4"],
    sizes_lwh_m: Float64[np.ndarray, "n 3"],
    is_labelled_moving: Bool[np.ndarray, " n"] | None = None,
) -> ActorTrack:
    """Return the track of the boxes of one actor, in any order; of boxes of one time the first
    one is used.

    Args:
        is_labelled_moving: of each box, if the data set has it; an actor moves if one of its boxes
            does. Without it, an actor moves if it gets more than 0.5 m away from its first place.
    """
    times, rows = np.unique(times_ns, return_index=True)
    matrices = world_from_actor[rows]
    moved_m = np.linalg.norm(matrices[:, :3, 3] - matrices[0, :3, 3], axis=1).max()
    is_moving = moved_m > _MOVED_M if is_labelled_moving is None else is_labelled_moving.any()
    size = np.median(sizes_lwh_m, axis=0)
    trajectory = Trajectory("world", "actor", times, matrices)
    return ActorTrack(actor_id, kind, size, trajectory, bool(is_moving), label)


def sorted_tracks(tracks: Sequence[ActorTrack]) -> tuple[ActorTrack, ...]:
    """Return the longest tracks first, as all readers do."""
    return tuple(sorted(tracks, key=lambda track: (-len(track.trajectory), track.actor_id)))


def repeated_boxes_note(path: Path, count: int) -> tuple[str, ...]:
    """Return a note on boxes that repeat an actor at one time; none without such boxes."""
    if not count:
        return ()
    return (f"{path.name}: {count} boxes repeat an actor at one time: the first of each is used",)
