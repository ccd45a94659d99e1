"""Which channels of an OpenEXR file make a colour picture: its parts, layers and views."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

_LETTER_BY_LEAF = {"r": "R", "red": "R", "g": "G", "green": "G", "b": "B", "blue": "B"}
"""OpenEXR's own names, Houdini's lower case, and Nuke's whole words."""
_CHROMA = ("Y", "RY", "BY")
"""Luminance and chroma of OpenEXR (Technical Introduction, "Luminance/Chroma Images")."""
_MAIN = frozenset(
    ("rgba", "rgb", "combined", "beauty", "c", "ci", "main", "color", "colour", "image", "final",
     "master", "default")
)  # fmt: skip
"""Names of the finished picture: Nuke, Blender, Arnold and V-Ray, Houdini, RenderMan and others."""
PLAIN = "RGB"
"""Name of the layer without a name."""
MAX_NAMED = 12
"""Layers that a message lists."""

Kind = Literal["rgb", "chroma", "grey"]


@dataclass(frozen=True)
class ExrPart:
    """What a part's header says of its pictures.

    Args:
        name: of the part; empty in a file of one part.
        view: of a stereo file ("left"); empty without.
        views: of all layers of this part, the default one first.
        channels: their names.
        pixels: of its data window.
    """

    name: str
    view: str
    views: tuple[str, ...]
    channels: tuple[str, ...]
    pixels: int


@dataclass(frozen=True)
class ExrLayer:
    """Channels that make one picture.

    Args:
        part: its number.
        name: as a user names it.
        aliases: other names that it goes by.
        channels: names of the file's channels: R, G, B; Y, RY, BY; or one.
    """

    part: int
    name: str
    aliases: tuple[str, ...]
    kind: Kind
    channels: tuple[str, ...]
    rank: tuple[int, ...]

    @property
    def is_certain(self) -> bool:
        """Whether its name is that of a finished picture, so that it is taken before others."""
        return self.rank[1] < _UNKNOWN


_FINISHED, _PLAIN_PART, _UNKNOWN = range(3)


def layers_of(parts: Sequence[ExrPart]) -> list[ExrLayer]:
    """Return the colour pictures of a file, the one to take by default first.

    Before others come the default view, then a layer whose name is that of a finished picture (or
    that has none), the largest, and the first of the file.
    """
    default = next((part.view for part in parts if part.view), "")
    found = [
        _layer(number, part, prefix, channels, default, len(parts) > 1)
        for number, part in enumerate(parts)
        for prefix, channels in _pictures(part.channels)
    ]
    return sorted(found, key=lambda layer: layer.rank)


def named_layers(layers: Iterable[ExrLayer], name: str) -> list[ExrLayer]:
    """Return the layers that a user's word names: the whole name, or an alias of only one."""
    whole = [layer for layer in layers if layer.name == name]
    return whole or [layer for layer in layers if name in layer.aliases]


def _pictures(channels: Sequence[str]) -> list[tuple[str, Mapping[str, str]]]:
    """Prefixes and the channels under each that make a picture, by what they are."""
    leaves: dict[str, dict[str, str]] = {}
    for channel in channels:
        prefix, _, leaf = channel.rpartition(".")
        leaves.setdefault(prefix, {})[leaf] = channel
    found: list[tuple[str, Mapping[str, str]]] = []
    for prefix, names in leaves.items():
        letters = {_LETTER_BY_LEAF[leaf.lower()]: name for leaf, name in names.items()
                   if leaf.lower() in _LETTER_BY_LEAF}  # fmt: skip
        if len(letters) == 3:
            found.append((prefix, letters))
        elif all(leaf in names for leaf in _CHROMA):
            found.append((prefix, {leaf: names[leaf] for leaf in _CHROMA}))
        # X, Y, Z is a position or a normal.
        elif "Y" in names and not {"X", "Z"} & set(names):
            found.append((prefix, {"Y": names["Y"]}))
    return found


def _layer(
    number: int,
    part: ExrPart,
    prefix: str,
    channels: Mapping[str, str],
    default: str,
    is_multi: bool,
) -> ExrLayer:
    words = prefix.split(".") if prefix else []
    view = next((word for word in words if word in part.views), part.view)
    plain = [word for word in words if word not in part.views]
    of_part = [word for word in part.name.split(".") if word and word != part.view]
    name, aliases = prefix, [prefix, *plain[-1:], ".".join(plain)]
    if is_multi and part.name:
        has_part = prefix.split(".")[: len(part.name.split("."))] == part.name.split(".")
        name = prefix if prefix and has_part else ".".join([part.name, *words])
        aliases += [part.name, ".".join(of_part)]
    rank_of_name = _rank(plain, of_part if is_multi else [])
    is_other_view = bool(view) and view != (default or (part.views or ("",))[0])
    kind: Kind = "rgb" if "R" in channels else "chroma" if "RY" in channels else "grey"
    is_grey = kind == "grey"
    letters = "RGB" if kind == "rgb" else _CHROMA if kind == "chroma" else "Y"
    return ExrLayer(
        number, name or PLAIN, tuple(dict.fromkeys(aliases)), kind,
        tuple(channels[letter] for letter in letters),
        (int(is_other_view), rank_of_name, int(is_grey), -part.pixels, number),
    )  # fmt: skip


def _rank(words: Sequence[str], of_part: Sequence[str]) -> int:
    if not words and (not of_part or not _MAIN.isdisjoint(word.lower() for word in of_part)):
        return _FINISHED
    if words and words[-1].lower() in _MAIN:
        return _FINISHED
    return _UNKNOWN if words else _PLAIN_PART
