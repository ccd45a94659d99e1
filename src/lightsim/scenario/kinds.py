"""Kinds of CAD models from the words of their names and from their sizes."""

from __future__ import annotations

import re
from itertools import pairwise

import numpy as np
from jaxtyping import Float

from lightsim.core.actors import ActorKind

# Smallest and largest length, width and height of a car, for models without a kind in their name.
# Chosen; sensitivity not measured.
_CAR_M = ((2.8, 1.3, 1.0), (6.0, 2.5, 2.4))
# Smallest and largest length, width and height of each kind, the longer horizontal side first. Wide
# limits: they only exclude names with another meaning (a car key, a bus stop, a toy truck).
_SIZE_M: dict[ActorKind, tuple[tuple[float, float, float], tuple[float, float, float]]] = {
    ActorKind.CAR: ((2.2, 1.1, 0.9), (7.0, 2.8, 3.2)),
    ActorKind.PICKUP: ((3.0, 1.3, 1.2), (8.0, 3.0, 3.0)),
    ActorKind.TRUCK: ((3.5, 1.5, 1.5), (26.0, 5.0, 5.5)),
    ActorKind.BUS: ((4.5, 1.7, 1.9), (26.0, 4.0, 5.0)),
    ActorKind.RAIL_VEHICLE: ((4.0, 2.0, 2.0), (60.0, 5.0, 6.5)),
    ActorKind.TRAILER: ((1.2, 0.8, 0.4), (26.0, 5.0, 5.5)),
    ActorKind.CONSTRUCTION_VEHICLE: ((1.0, 0.7, 0.9), (30.0, 10.0, 30.0)),
    ActorKind.OTHER_VEHICLE: ((1.0, 0.4, 0.4), (30.0, 6.0, 6.5)),
    ActorKind.MOTORCYCLE: ((1.2, 0.3, 0.7), (3.2, 1.6, 2.2)),
    ActorKind.SCOOTER: ((0.6, 0.1, 0.6), (2.6, 1.3, 2.2)),
    ActorKind.BICYCLE: ((0.9, 0.1, 0.5), (3.2, 1.3, 2.2)),
    ActorKind.PEDESTRIAN: ((0.2, 0.1, 0.7), (2.2, 1.5, 2.4)),
    ActorKind.PERSONAL_MOBILITY: ((0.3, 0.2, 0.6), (2.6, 1.5, 2.4)),
    ActorKind.ANIMAL: ((0.1, 0.02, 0.05), (5.0, 2.5, 4.0)),
    ActorKind.CONE: ((0.1, 0.1, 0.2), (1.2, 1.2, 1.6)),
    ActorKind.SIGN: ((0.1, 0.0, 0.1), (12.0, 12.0, 12.0)),
    ActorKind.BARRIER: ((0.3, 0.0, 0.2), (25.0, 5.0, 5.0)),
    ActorKind.ROLLING_CONTAINER: ((0.3, 0.3, 0.4), (3.0, 2.5, 2.5)),
}
_WORDS = {
    **{str(kind): kind for kind in ActorKind if kind is not ActorKind.OTHER},
    **dict.fromkeys(("person", "human", "man", "woman", "child"), ActorKind.PEDESTRIAN),
}
# A word of a file name: `redCar2`, `red-car` and `CAR_red` contain the word car, `scarecrow` does
# not.
_WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|[^\W\d_A-Za-z]+")


def inferred_kind(name: str, size_lwh_m: Float[np.ndarray, "3"]) -> ActorKind:
    """Return the kind of a model.

    The last word of the name that is a kind of plausible size decides, because English compounds
    end in the object itself (`carport_sign`); otherwise the size of a car.
    """
    for kind in named_kinds(name):
        if is_plausible(kind, size_lwh_m):
            return kind
    low, high = np.array(_CAR_M)
    is_car = ((size_lwh_m > low) & (size_lwh_m < high)).all()
    return ActorKind.CAR if is_car else ActorKind.OTHER


def named_kinds(name: str) -> list[ActorKind]:
    """Return the kinds among the whole words of a name, the last word first."""
    words = [word.lower() for word in _WORD.findall(name)]
    pairs = [" ".join(pair) for pair in pairwise(words)]
    texts = [text for n, word in enumerate(words) for text in (word, *pairs[n : n + 1])]
    return [_WORDS[text] for text in reversed(texts) if text in _WORDS]


def is_plausible(kind: ActorKind, size_lwh_m: Float[np.ndarray, "3"]) -> bool:
    """Return whether an object of a kind can have this length, width and height."""
    horizontal = np.sort(size_lwh_m[:2])[::-1]
    size = np.array([*horizontal, size_lwh_m[2]])
    low, high = np.array(_SIZE_M[kind])
    return bool(((size >= low) & (size <= high)).all())
