"""Parser of MTL text, with the PBR statements of Clara.io and Blender.

Reference: Wavefront Advanced Visualizer, Appendix B2, Material Template Library, version 3.0.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field

import numpy as np

from lightsim.store.notes import Notes
from lightsim.store.obj_text import as_utf8, decode

# Options of texture maps.
_OPTIONS = frozenset((
    "-blendu", "-blendv", "-bm", "-boost", "-cc", "-clamp", "-imfchan", "-mm", "-o", "-s", "-t",
    "-texres", "-type",
))  # fmt: skip
# Options that are followed by one word; numbers follow the others.
_WORD_OPTIONS = frozenset(("-blendu", "-blendv", "-cc", "-clamp", "-imfchan", "-type"))
# Options that need no note: `-o`, `-s` and `-clamp` are applied; `-cc` concerns lights; the channel
# of `-imfchan` follows from the picture.
_USED_OPTIONS = frozenset(("-o", "-s", "-clamp", "-imfchan", "-cc"))
# Statements of texture maps that are read, of maps of shape, and of other maps.
_USED_MAPS = {name.lower(): name for name in ("map_Kd", "map_Ka", "map_d", "map_Pr", "map_Pm")}
_SHAPE_MAPS = frozenset(("bump", "map_bump", "norm", "map_kn", "disp", "map_disp"))
_OTHER_MAPS = frozenset((
    "decal", "map_ks", "map_ns", "map_tr", "map_opacity", "map_refl", "refl", "map_rma", "map_orm",
    "map_ps",
))  # fmt: skip
# Sheen, clearcoat and anisotropy.
_SHEENS = frozenset(("ps", "pc", "pcr", "aniso", "anisor"))
# Statements without effect: ambient light is traced, all non-metals reflect 4 %, panes do not
# refract, and `illum` selects the shading of a viewer, which exporters write regardless of the
# material.
_WITHOUT_EFFECT = frozenset(("ka", "ks", "ni", "tf", "illum", "sharpness", "map_aat"))


@dataclass(frozen=True)
class TextureMap:
    """A texture map of a material.

    Args:
        words: the file as written, possibly a path of another operating system.
        scale, offset: texture coordinates are multiplied by `scale`, then moved by `offset`.
        is_clamped: coordinates outside [0, 1] show the picture's border; else the picture repeats.
    """

    words: str
    scale: tuple[float, float] = (1.0, 1.0)
    offset: tuple[float, float] = (0.0, 0.0)
    is_clamped: bool = False


@dataclass
class MtlMaterial:
    """One material as written; None for statements that are missing.

    Args:
        colour: linear `Kd`.
        opacity: `d`, or 1 - `Tr`.
        roughness: `Pr`, or `Ns` by Blender's rule.
        metallic: `Pm`.
        maps: pictures by statement: map_Kd (or map_Ka without one), map_d, map_Pr, map_Pm.
    """

    name: str
    colour: tuple[float, float, float] | None = None
    opacity: float | None = None
    roughness: float | None = None
    metallic: float | None = None
    maps: dict[str, TextureMap] = field(default_factory=dict)


def parse_mtl(data: bytes, notes: Notes) -> dict[str, MtlMaterial]:
    """Return the materials of a text by name, and add unused statements to the notes.

    Each line is decoded separately, since a comment may have another encoding than a name. Only
    ASCII blanks and line ends divide words: bytes of other encodings belong to names.
    """
    materials: dict[str, MtlMaterial] = {}
    reader = _Reader(notes)
    for line in as_utf8(data).splitlines():
        words = line.split(None, 1) or [b"#"]
        keyword, rest = decode(words[0]), decode(words[1].strip()) if len(words) > 1 else ""
        if keyword.lower() == "newmtl":
            reader.material = materials[rest] = MtlMaterial(rest)
            reader.has_dissolve = False
        elif not keyword.startswith("#") and reader.material is not None:
            reader.read(keyword, rest)
    for material in materials.values():
        ambient = material.maps.pop("map_Ka", None)
        if ambient is not None and "map_Kd" not in material.maps:
            material.maps["map_Kd"] = ambient
            notes.add("map_Ka is read as the map_Kd that is missing", material.name)
    return materials


@dataclass
class _Reader:
    notes: Notes
    material: MtlMaterial | None = None
    has_dissolve: bool = False

    def read(self, keyword: str, rest: str) -> None:
        """Read one statement of the current material."""
        material = self.material
        assert material is not None
        word = keyword.lower()
        used_map = _USED_MAPS.get(word)
        numbers = _numbers(rest.split())
        if word == "kd":
            material.colour = self._colour(rest)
        elif word in ("d", "tr"):
            self._read_opacity(word, _numbers(rest.removeprefix("-halo").split()))
        elif word == "ns" and numbers:
            # `Pr` has precedence over `Ns` in any order.
            if material.roughness is None:
                # The rule of Blender's importer: an exponent of 900 gives roughness 0.
                material.roughness = 1.0 - float(np.sqrt(np.clip(numbers[0] / 900.0, 0, 1)))
        elif word == "pr" and numbers:
            material.roughness = float(np.clip(numbers[0], 0, 1))
        elif word == "pm" and numbers:
            material.metallic = float(np.clip(numbers[0], 0, 1))
        elif used_map:
            material.maps[used_map] = self._map(rest)
        else:
            self._note_unused(keyword, numbers)

    def _note_unused(self, keyword: str, numbers: list[float]) -> None:
        assert self.material is not None
        name = self.material.name
        word = keyword.lower()
        if word in ("ke", "map_ke"):
            if word == "map_ke" or any(numbers):
                self.notes.add("emission (Ke) is not used: materials give no light", name)
        elif word in _SHAPE_MAPS:
            self.notes.add("bump, normal and height maps are not used", name)
        elif word in _OTHER_MAPS:
            self.notes.add(f"{keyword} is not used", name)
        elif word in _SHEENS:
            if any(numbers):
                self.notes.add(f"{keyword} is not used", name)
        elif word not in _WITHOUT_EFFECT:
            self.notes.add(f"the statement {keyword[:20]} is unknown", name)

    def _read_opacity(self, keyword: str, numbers: list[float]) -> None:
        material = self.material
        assert material is not None
        if not numbers:
            return
        value = float(np.clip(numbers[0], 0, 1))
        if keyword == "d":
            material.opacity, self.has_dissolve = value, True
        # `d` has precedence over `Tr`, whose meaning differs between exporters.
        elif self.has_dissolve:
            return
        elif value == 1:
            self.notes.add(
                "Tr 1 without d is read as opaque, as some exporters write it", material.name
            )
        else:
            material.opacity = 1 - value

    def _colour(self, rest: str) -> tuple[float, float, float] | None:
        assert self.material is not None
        numbers = _numbers(rest.split())
        if not numbers:
            self.notes.add("a Kd that is not in RGB is not used: mid grey", self.material.name)
            return None
        rgb = np.array(numbers[:3] if len(numbers) >= 3 else numbers[:1] * 3)
        # Numbers from 0 to 255. The limit was chosen above the valid maximum of 1; sensitivity not
        # measured.
        if rgb.max() > 2:
            self.notes.add("Kd above 2 is divided by 255", self.material.name)
            rgb /= 255
        r, g, b = np.clip(rgb, 0, 1).tolist()
        return r, g, b

    def _map(self, rest: str) -> TextureMap:
        """Parse a texture map: options first, then the file's name, which may contain blanks."""
        assert self.material is not None
        values: dict[str, list[str]] = {}
        while rest.startswith("-"):
            option, tail = _first_word(rest)
            if option not in _OPTIONS:
                break
            taken: list[str] = []
            most = 1 if option in _WORD_OPTIONS or option in ("-bm", "-boost", "-texres") else 3
            most = 2 if option == "-mm" else most
            while len(taken) < most and tail:
                word, after = _first_word(tail)
                if option not in _WORD_OPTIONS and not _numbers([word]):
                    break
                taken.append(word)
                tail = after
            values[option] = taken
            if option not in _USED_OPTIONS:
                self.notes.add(
                    f"the option {option} of texture maps is not used", self.material.name
                )
            rest = tail
        scale, offset = _numbers(values.get("-s", [])), _numbers(values.get("-o", []))
        return TextureMap(
            rest.strip("\"'"),
            (scale[0] if scale else 1.0, scale[1] if len(scale) > 1 else 1.0),
            (offset[0] if offset else 0.0, offset[1] if len(offset) > 1 else 0.0),
            values.get("-clamp") == ["on"],
        )


def _first_word(text: str) -> tuple[str, str]:
    """Divide a text at its first run of ASCII blanks."""
    word, *rest = re.split(r"[ \t\v\f]+", text, maxsplit=1)
    return word, rest[0] if rest else ""


def _numbers(words: list[str]) -> list[float]:
    """Return the finite numbers before the first word that is not a number."""
    found: list[float] = []
    for word in words:
        try:
            value = float(word)
        except ValueError:
            break
        if not abs(value) < 1e6:
            break
        found.append(value)
    return found
