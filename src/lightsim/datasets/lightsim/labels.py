"""Kinds of actors by common labels."""

from __future__ import annotations

from lightsim.core.actors import ActorKind

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
