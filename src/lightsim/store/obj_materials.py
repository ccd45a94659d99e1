"""Materials of an OBJ file with their pictures, as far as surfaces here have them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32, UInt8

from lightsim.core.colour import linear_from_srgb8
from lightsim.core.mesh import Material
from lightsim.errors import InputError
from lightsim.store.beside import path_beside
from lightsim.store.images import decode_texture
from lightsim.store.mtl import MtlMaterial, TextureMap, parse_mtl
from lightsim.store.notes import Notes
from lightsim.store.obj_text import without_comment
from lightsim.store.primitives import AlphaMode, ImageTexture, Wrap
from lightsim.store.reading import MAX_PICTURE_BYTES, read_bytes

_MAX_PIXELS = 1 << 28
"""Of all pictures together, as in glTF files."""
_MAX_MTL_BYTES = 16 << 20
"""A hundred thousand materials."""
_GREY = (0.5, 0.5, 0.5)
"""Linear colour of surfaces without a material: a light grey, as viewers show them."""
_GREY_TOLERANCE = 0.005
"""Difference of the components of a grey `Kd` that is rounded to two digits."""
_MASK_CODES = (16, 239)
"""Alpha between these is neither a hole nor a surface; compression and smoothing of edges alter few
pixels by more."""


@dataclass(frozen=True, eq=False)
class ObjLook:
    """Appearance of one material of an OBJ file.

    Args:
        colour: linear; without a texture, the base colour.
        texture: picture that multiplies the colour; None without one.
        is_painted: the texture has the colour of the surface, not its holes alone.
        uv_scale, uv_offset: map texture coordinates of the file to those of the picture.
        alpha: opacity besides that of the texture.
    """

    colour: tuple[float, float, float]
    material: Material
    texture: ImageTexture | None = None
    is_painted: bool = False
    uv_scale: tuple[float, float] = (1.0, 1.0)
    uv_offset: tuple[float, float] = (0.0, 0.0)
    alpha: float = 1.0
    alpha_mode: AlphaMode = AlphaMode.OPAQUE

    def tint(self, *, has_vertex_colours: bool) -> Float32[np.ndarray, "3"]:
        """Return the colour that multiplies textures and vertex colours.

        The standard multiplies by `Kd`. Exporters write a grey one (0, 0.588, 0.64, 0.8) beside
        textures and vertex colours that means nothing, so only a coloured one counts there.
        """
        is_grey = np.ptp(self.colour) <= _GREY_TOLERANCE
        is_covered = self.is_painted or has_vertex_colours
        return np.array((1.0, 1.0, 1.0) if is_grey and is_covered else self.colour, np.float32)

    def without_texture(self) -> ObjLook:
        """Return the same with the mean colour and alpha of the texture."""
        if self.texture is None:
            return self
        pixels = self.texture.pixels.reshape(-1, self.texture.pixels.shape[2])
        mean = linear_from_srgb8(pixels[:, :3]).mean(axis=0, dtype=np.float64)
        r, g, b = (mean * self.tint(has_vertex_colours=False)).tolist()
        return replace(
            self,
            colour=(r, g, b),
            texture=None,
            is_painted=False,
            alpha_mode=_mode(None, self.alpha),
        )


def looks_of(
    path: Path,
    libraries: Sequence[str],
    names: Sequence[str | None],
    notes: Notes,
    *,
    has_vertex_colours: bool,
) -> dict[str | None, ObjLook]:
    """Return the appearance of materials by name; None is that of faces without a material.

    Args:
        path: the OBJ file.
        libraries: what follows each `mtllib`: one name, blanks included, or several.
        names: materials of the faces.
        notes: receives what is missing or not used.
    """
    is_used = any(name is not None for name in names)
    found = _libraries(path, libraries, notes, is_used=is_used)
    find = _Finder(found)
    pictures = _Pictures(notes)
    looks: dict[str | None, ObjLook] = {}
    for name in names:
        if name is None:
            if not has_vertex_colours:
                notes.add("faces without a material are mid grey (0.5 linear)")
            looks[None] = ObjLook(_GREY, Material(name="no material"))
        elif (pair := find(name)) is not None:
            looks[name] = _look(*pair, pictures, notes)
        else:
            notes.add("materials that no library defines are mid grey, 0.5 linear", name)
            looks[name] = ObjLook(_GREY, Material(name=name))
    return looks


class _Finder:
    """Finds materials by name: as written, without regard to case, without a comment behind it."""

    def __init__(self, found: dict[str, tuple[MtlMaterial, Path]]) -> None:
        self._by_name = {name.casefold(): pair for name, pair in found.items()} | found
        bare = [without_comment(name) for name in found]
        counts = Counter(bare)
        # Of `paint #2` and `paint #3`, neither is `paint`.
        self._by_bare_name = {
            name: pair for name, pair in zip(bare, found.values(), strict=True) if counts[name] == 1
        }

    def __call__(self, name: str) -> tuple[MtlMaterial, Path] | None:
        for key in dict.fromkeys((name, name.casefold())):
            if key in self._by_name:
                return self._by_name[key]
        if name in self._by_bare_name:
            return self._by_bare_name[name]
        bare = without_comment(name)
        return self._by_name.get(bare) or self._by_name.get(bare.casefold())


def _libraries(
    path: Path, libraries: Sequence[str], notes: Notes, *, is_used: bool
) -> dict[str, tuple[MtlMaterial, Path]]:
    """Return the materials of all MTL files with their file; the first one of a name counts.

    Args:
        is_used: a face names a material; without an MTL file of the statements, the one with the
            model's own name is read then.
    """
    found: dict[str, tuple[MtlMaterial, Path]] = {}
    remarks = Notes()
    paths = [p for words in dict.fromkeys(libraries) for p in _library_paths(path, words, notes)]
    if is_used and not paths and (own := _beside(path, f"{path.stem}.mtl")) is not None:
        notes.add("no mtllib names the material library beside the model, which is read", own.name)
        paths = [own]
    for library in dict.fromkeys(paths):
        data = read_bytes(library, "material library", _MAX_MTL_BYTES)
        for name, material in parse_mtl(data, remarks).items():
            found.setdefault(name, (material, library))
    for sentence in remarks.sentences():
        notes.add(sentence)
    return found


def _library_paths(path: Path, words: str, notes: Notes) -> list[Path]:
    whole = _beside(path, words)
    if whole is not None:
        return [whole]
    found = []
    # Blanks may be part of a name, or divide names that all end alike.
    names = words.split() if words.lower().count(".mtl") > 1 else [words]
    for name in names:
        library = _beside(path, name)
        if library is None:
            notes.add("the material library is missing", name)
        else:
            found.append(library)
    return found


def _beside(path: Path, words: str) -> Path | None:
    """Return a file that `path` names, else the longest end of that path which is there."""
    for text in dict.fromkeys((words, without_comment(words))):
        name = text.strip(" \t\v\f\"'")
        # With "/" before it, any end of the path may be the one that is there.
        for reference in (name, f"/{name}"):
            try:
                return path_beside(path, reference, "file")
            except InputError:
                continue
    return None


class _Pictures:
    """Pictures by path, each read once."""

    def __init__(self, notes: Notes) -> None:
        self._notes = notes
        self._by_path: dict[Path, UInt8[np.ndarray, "h w _"] | None] = {}
        self._n_pixels = 0
        self._combined: dict[tuple[int, int], UInt8[np.ndarray, "h w _"]] = {}

    def load(self, library: Path, texture: TextureMap) -> UInt8[np.ndarray, "h w _"] | None:
        """Return sRGB, and alpha if there is one; None with a note if the file is unreadable."""
        path = _beside(library, texture.words)
        if path is None:
            self._notes.add(
                "textures are missing, and Kd is shown instead", texture.words or "no name"
            )
            return None
        if path not in self._by_path:
            self._by_path[path] = self._read(path)
        return self._by_path[path]

    def _read(self, path: Path) -> UInt8[np.ndarray, "h w _"] | None:
        try:
            data = read_bytes(path, "picture", MAX_PICTURE_BYTES)
            picture = decode_texture(data, is_of_obj=True)
        except (InputError, ValueError) as error:
            got = error.got or error.what if isinstance(error, InputError) else error
            sentence = "a texture is no PNG, JPEG, WebP, BMP or TGA file, and Kd is shown instead"
            self._notes.add(sentence, f"{path.name}: {got}")
            return None
        self._n_pixels += picture.shape[0] * picture.shape[1]
        if self._n_pixels > _MAX_PIXELS:
            raise ValueError(f"all pictures together have more than {_MAX_PIXELS} pixels")
        return picture

    def combined(
        self, picture: UInt8[np.ndarray, "h w _"] | None, mask: UInt8[np.ndarray, "h2 w2 _"] | None
    ) -> UInt8[np.ndarray, "h3 w3 _"]:
        """Return colours of a picture (white without one) with a mask as alpha.

        Materials with the same pictures share the result.
        """
        key = id(picture), id(mask)
        if key not in self._combined:
            white = np.full((1, 1, 3), 255, np.uint8)
            colour = white if picture is None else picture[..., :3]
            self._combined[key] = _with_alpha(colour, None if mask is None else _alpha_of(mask))
        return self._combined[key]


def _look(material: MtlMaterial, library: Path, pictures: _Pictures, notes: Notes) -> ObjLook:
    maps = material.maps
    loaded = {key: pictures.load(library, texture) for key, texture in maps.items()}
    surface = Material(name=material.name)
    roughness = _scalar(loaded.get("map_Pr"), material.roughness, surface.roughness)
    metallic = _scalar(loaded.get("map_Pm"), material.metallic, surface.metallic)
    surface = replace(surface, roughness=roughness, metallic=metallic)
    colour = material.colour or _GREY
    picture, mask = loaded.get("map_Kd"), loaded.get("map_d")
    if mask is picture and mask is not None and mask.shape[2] < 4:
        notes.add("map_d is the picture of map_Kd, which is opaque: no holes", material.name)
        mask = None
    if picture is None and "map_Kd" in maps and max(colour) == 0:
        colour = _GREY  # The black that exporters write beside a texture.
    opacity = 1.0 if material.opacity is None else material.opacity
    if picture is None and mask is None:
        return ObjLook(colour, surface, alpha=opacity, alpha_mode=_mode(None, opacity))
    if picture is not None and mask is None and picture.shape[2] == 4:
        notes.add("alpha of map_Kd is not used: only map_d and d make holes", material.name)
    texture = maps["map_Kd" if picture is not None else "map_d"]
    pixels = pictures.combined(picture, mask)
    wrap = Wrap.CLAMP if texture.is_clamped else Wrap.REPEAT
    return ObjLook(
        colour,
        surface,
        ImageTexture(pixels, (wrap, wrap)),
        is_painted=picture is not None,
        uv_scale=texture.scale,
        uv_offset=texture.offset,
        alpha=opacity if mask is None else 1.0,  # `map_d` replaces the number, as other maps do.
        alpha_mode=_mode(None if mask is None else pixels[..., 3], opacity),
    )


def _mode(alpha: UInt8[np.ndarray, "h w"] | None, opacity: float) -> AlphaMode:
    """`map_d` cuts leaves and fences where it is black and white; `d` and greys make glass."""
    if alpha is None:
        return AlphaMode.BLEND if opacity < 1 else AlphaMode.OPAQUE
    is_between = (alpha > _MASK_CODES[0]) & (alpha < _MASK_CODES[1])
    return AlphaMode.BLEND if is_between.mean() > 0.5 else AlphaMode.MASK


def _scalar(
    picture: UInt8[np.ndarray, "h w _"] | None, written: float | None, default: float
) -> float:
    """Return the mean of a map, which replaces the number beside it as in Blender."""
    if picture is not None:
        return float(picture[..., 0].mean(dtype=np.float64) / 255)
    return default if written is None else written


def _alpha_of(mask: UInt8[np.ndarray, "h w _"]) -> UInt8[np.ndarray, "h w"]:
    """Return the picture's alpha if it has one, else its brightest channel."""
    return mask[..., 3] if mask.shape[2] == 4 else mask.max(axis=2)


def _with_alpha(
    picture: UInt8[np.ndarray, "h w _"], alpha: UInt8[np.ndarray, "h2 w2"] | None
) -> UInt8[np.ndarray, "h3 w3 c"]:
    """Return the picture's colours with an alpha channel, at the size of the larger picture."""
    if alpha is None:
        return np.ascontiguousarray(picture[..., :3])
    height, width = alpha.shape if alpha.size > picture[..., 0].size else picture.shape[:2]
    rgb, a = _resized(picture[..., :3], height, width), _resized(alpha[..., None], height, width)
    return np.concatenate([rgb, a], axis=2)


def _resized(
    picture: UInt8[np.ndarray, "h w c"], height: int, width: int
) -> UInt8[np.ndarray, "h2 w2 c"]:
    rows = np.arange(height) * picture.shape[0] // height
    columns = np.arange(width) * picture.shape[1] // width
    return picture[rows[:, None], columns]
