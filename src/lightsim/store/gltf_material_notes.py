"""Notes on features of glTF materials that are not read, and on the effect."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from lightsim.store.gltf_document import extensions
from lightsim.store.notes import Notes


def note_unread(material: dict[str, Any], name: str, notes: Notes) -> None:
    """Add a note for each feature of a material that is not read and changes its appearance."""
    if "normalTexture" in material:
        notes.add("normal maps are not read: surfaces are smooth between vertices", name)
    if _emits(material):
        notes.add("emission is not read: lamps do not shine", name)
    given = extensions(material)
    if "KHR_materials_unlit" in given:
        notes.add(
            "KHR_materials_unlit is read as matte: the scene's light adds to its colours", name
        )
    # No note for half to twice the reflectance of the material model, 0.04: water has 0.02,
    # sapphire 0.08. Chosen; visibility of the difference not measured.
    if not 0.02 <= _reflectance(given) <= 0.08:
        notes.add(
            "KHR_materials_ior and KHR_materials_specular are not read: non-metals reflect 4 %"
            " at normal incidence",
            name,
        )
    for extension, (is_used, sentence) in _UNREAD.items():
        if extension in given and is_used(given[extension]):
            notes.add(f"{extension} is not read: {sentence}", name)


def _emits(material: dict[str, Any]) -> bool:
    return any(float(part) > 0 for part in material.get("emissiveFactor", ()))


def _reflectance(given: dict[str, Any]) -> float:
    index = float(given.get("KHR_materials_ior", {}).get("ior", 1.5))
    specular = given.get("KHR_materials_specular", {})
    tint = max((float(part) for part in specular.get("specularColorFactor", ())), default=1.0)
    strength = float(specular.get("specularFactor", 1.0))
    # An index of refraction of 0 means total reflection (KHR_materials_ior), which the formula
    # gives.
    return strength * min(tint * ((index - 1) / (index + 1)) ** 2, 1.0)


def _above_zero(*names: str) -> Callable[[dict[str, Any]], bool]:
    def is_used(value: dict[str, Any]) -> bool:
        numbers = [value.get(name, 0.0) for name in names]
        flat = [n for number in numbers for n in (number if isinstance(number, list) else [number])]
        return any(float(number) > 0 for number in flat)

    return is_used


_UNREAD = {
    "KHR_materials_clearcoat": (
        _above_zero("clearcoatFactor"), "paint has the gloss of its base coat"),
    "KHR_materials_sheen": (
        _above_zero("sheenColorFactor"), "cloth has no sheen"),
    "KHR_materials_iridescence": (
        _above_zero("iridescenceFactor"), "reflections have no interference colours"),
    "KHR_materials_anisotropy": (
        _above_zero("anisotropyStrength"), "highlights are round"),
    "KHR_materials_diffuse_transmission": (
        _above_zero("diffuseTransmissionFactor"), "no light shines through thin surfaces"),
}  # fmt: skip
