"""Selection of the channels of an OpenEXR file that make a colour picture: parts, layers, views."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Literal

# Channel letters by name: OpenEXR's own, lower case of Houdini, and whole words of Nuke.
_LETTER_BY_LEAF = {"r": "R", "red": "R", "g": "G", "green": "G", "b": "B", "blue": "B",
                   "a": "A", "alpha": "A"}  # fmt: skip
# Channels of luminance and chroma (OpenEXR Technical Introduction, "Luminance/Chroma Images").
_CHROMA = ("Y", "RY", "BY")
# Layer names of the finished picture in Nuke, Blender, Arnold, V-Ray, Houdini, RenderMan and
# others.
_MAIN = frozenset(
    ("rgba", "rgb", "combined", "beauty", "c", "ci", "main", "color", "colour", "image", "final",
     "master", "default")
)  # fmt: skip
# Name by which a user chooses the layer without a name.
PLAIN = "RGB"
# Largest number of layers that a message lists.
MAX_NAMED = 12

Kind = Literal["rgb", "chroma", "grey"]


@dataclass(frozen=True)
class ExrPart:
    """Entries of a part's header that describe its pictures.

    Args:
        name: name of the part; empty in a file of one part.
        view: view of a stereo file, such as "left"; empty without views.
        views: views of all layers of this part, the default one first.
        channels: names of the channels.
        pixels: number of pixels of the data window.
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
        part: index of the part.
        name: name by which a user chooses the layer.
        aliases: other names of the layer.
        kind: meaning of the channels.
        channels: names of the file's channels: R, G, B; Y, RY, BY; or one.
        alpha: name of the alpha channel; empty without one.
        rank: order of preference, smallest first: other view, name, grey, size, part.
    """

    part: int
    name: str
    aliases: tuple[str, ...]
    kind: Kind
    channels: tuple[str, ...]
    alpha: str
    rank: tuple[int, ...]

    @property
    def is_certain(self) -> bool:
        """Return whether the layer's name identifies the finished picture."""
        return self.rank[1] < _NameRank.UNKNOWN


class _NameRank(IntEnum):
    """Preference of a layer by its name; smaller ranks first."""

    FINISHED = 0
    UNNAMED_IN_PART = 1
    UNKNOWN = 2


def layers_of(parts: Sequence[ExrPart]) -> list[ExrLayer]:
    """Return the colour pictures of a file, the default choice first.

    The order of preference is: the default view, a layer that is named as a finished picture or has
    no name, colour before grey, the largest, the first in the file.
    """
    # In a multi-part stereo file, the first part has the default view.
    default = next((part.view for part in parts if part.view), "")
    found = [
        _layer(number, part, prefix, channels, default, len(parts) > 1)
        for number, part in enumerate(parts)
        for prefix, channels in _pictures(part.channels)
    ]
    return sorted(found, key=lambda layer: layer.rank)


def named_layers(layers: Iterable[ExrLayer], name: str) -> list[ExrLayer]:
    """Return the layers that have this name; if there is none, the layers with this alias."""
    whole = [layer for layer in layers if layer.name == name]
    return whole or [layer for layer in layers if name in layer.aliases]


def _pictures(channels: Sequence[str]) -> list[tuple[str, Mapping[str, str]]]:
    """Return each prefix whose channels make a picture, with its channels by letter."""
    leaves: dict[str, dict[str, str]] = {}
    for channel in channels:
        prefix, _, leaf = channel.rpartition(".")
        leaves.setdefault(prefix, {})[leaf] = channel
    found: list[tuple[str, Mapping[str, str]]] = []
    for prefix, names in leaves.items():
        letters = {_LETTER_BY_LEAF[leaf.lower()]: name for leaf, name in names.items()
                   if leaf.lower() in _LETTER_BY_LEAF}  # fmt: skip
        alpha = {"A": letters["A"]} if "A" in letters else {}
        if letters.keys() >= set("RGB"):
            found.append((prefix, letters))
        elif all(leaf in names for leaf in _CHROMA):
            found.append((prefix, {leaf: names[leaf] for leaf in _CHROMA} | alpha))
        # Channels X, Y, Z are a position or a normal, not luminance.
        elif "Y" in names and not {"X", "Z"} & set(names):
            found.append((prefix, {"Y": names["Y"]} | alpha))
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
    # Names of views do not count as layer names.
    rank_of_name = _rank(plain, of_part if is_multi else [])
    is_other_view = bool(view) and view != (default or (part.views or ("",))[0])
    kind: Kind = "rgb" if "R" in channels else "chroma" if "RY" in channels else "grey"
    is_grey = kind == "grey"
    letters = "RGB" if kind == "rgb" else _CHROMA if kind == "chroma" else "Y"
    return ExrLayer(
        number, name or PLAIN, tuple(dict.fromkeys(aliases)), kind,
        tuple(channels[letter] for letter in letters), channels.get("A", ""),
        (int(is_other_view), rank_of_name, int(is_grey), -part.pixels, number),
    )  # fmt: skip


def _rank(words: Sequence[str], of_part: Sequence[str]) -> int:
    if not words and (not of_part or not _MAIN.isdisjoint(word.lower() for word in of_part)):
        return _NameRank.FINISHED
    if words and words[-1].lower() in _MAIN:
        return _NameRank.FINISHED
    return _NameRank.UNKNOWN if words else _NameRank.UNNAMED_IN_PART
