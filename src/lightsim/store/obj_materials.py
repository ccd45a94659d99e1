"""Appearance of an OBJ file's materials: search for MTL files, pictures, colours and alpha."""

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
from lightsim.store.primitives import MAX_TEXTURE_PIXELS, AlphaMode, ImageTexture, Wrap
from lightsim.store.reading import MAX_PICTURE_BYTES, read_bytes

# Largest size of an MTL file, in bytes: a hundred thousand materials.
_MAX_MTL_BYTES = 16 << 20
# Linear base colour of surfaces without a material: the light grey that viewers show.
_GREY = (0.5, 0.5, 0.5)
# Largest difference between the components of a grey `Kd`: rounding to two digits.
_GREY_TOLERANCE = 0.005
# Codes of alpha up to which a pixel is a hole, and from which it is opaque. Compression and
# smoothing of edges change few pixels by more. Chosen; sensitivity not measured.
_MASK_CODES = (16, 239)


@dataclass(frozen=True, eq=False)
class ObjLook:
    """Appearance of one material of an OBJ file.

    Args:
        colour: linear colour; without a texture, the base colour.
        texture: picture that multiplies the colour; None without a texture.
        is_painted: the texture contains the colour of the surface, not only its holes.
        uv_scale, uv_offset: map texture coordinates of the file to coordinates of the picture.
        alpha: opacity that multiplies the texture's alpha.
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

        The standard multiplies by `Kd`. Beside textures and vertex colours, exporters write a
        meaningless grey `Kd` (0, 0.588, 0.64, 0.8), so a grey `Kd` is ignored there.
        """
        is_grey = np.ptp(self.colour) <= _GREY_TOLERANCE
        is_covered = self.is_painted or has_vertex_colours
        return np.array((1.0, 1.0, 1.0) if is_grey and is_covered else self.colour, np.float32)

    def without_texture(self) -> ObjLook:
        """Return this appearance with the texture replaced by its mean colour."""
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
    """Return the appearance of materials by name; the key None is for faces without a material.

    Args:
        path: the OBJ file.
        libraries: words after each `mtllib`: one name that may contain blanks, or several names.
        names: materials of the faces.
        notes: notes to which missing files and unused features are added.
        has_vertex_colours: the file has vertex colours, which replace the grey of faces without a
            material.
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
    """Search for materials by name: exactly, ignoring case, or without a trailing comment."""

    def __init__(self, found: dict[str, tuple[MtlMaterial, Path]]) -> None:
        self._by_name = {name.casefold(): pair for name, pair in found.items()} | found
        bare = [without_comment(name) for name in found]
        counts = Counter(bare)
        # `paint` must not match `paint #2` if there is a `paint #3`: the names are no comments
        # then.
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
    """Return the materials of all MTL files with their file; the first material of a name is used.

    Args:
        is_used: a face names a material. If no `mtllib` names an existing file, the MTL file with
            the model's name is read then.
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
    # Blanks may belong to one name, or separate several names that end in ".mtl".
    names = words.split() if words.lower().count(".mtl") > 1 else [words]
    for name in names:
        library = _beside(path, name)
        if library is None:
            notes.add("the material library is missing", name)
        else:
            found.append(library)
    return found


def _beside(path: Path, words: str) -> Path | None:
    """Return the file of a reference in `path`, else the longest existing end of that reference."""
    for text in dict.fromkeys((words, without_comment(words))):
        name = text.strip(" \t\v\f\"'")
        # With a leading "/", `path_beside` tries all ends of the path.
        for reference in (name, f"/{name}"):
            try:
                return path_beside(path, reference, "file")
            except InputError:
                continue
    return None


class _Pictures:
    """Cache of pictures by path."""

    def __init__(self, notes: Notes) -> None:
        self._notes = notes
        self._by_path: dict[Path, UInt8[np.ndarray, "h w _"] | None] = {}
        self._n_pixels = 0
        self._combined: dict[tuple[int, int], UInt8[np.ndarray, "h w _"]] = {}

    def load(self, library: Path, texture: TextureMap) -> UInt8[np.ndarray, "h w _"] | None:
        """Return sRGB, with alpha if the file has it; None and a note if it is unreadable."""
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
        if self._n_pixels > MAX_TEXTURE_PIXELS:
            raise ValueError(f"all pictures have more than {MAX_TEXTURE_PIXELS} pixels")
        return picture

    def combined(
        self, picture: UInt8[np.ndarray, "h w _"] | None, mask: UInt8[np.ndarray, "h2 w2 _"] | None
    ) -> UInt8[np.ndarray, "h3 w3 _"]:
        """Return the colours of a picture (white if None) with a mask as alpha.

        Materials with the same pictures get the same array.
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
        colour = _GREY  # Exporters write black beside a texture, which is missing here.
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
        # A map replaces the number beside it; `map_d` replaces `d`.
        alpha=opacity if mask is None else 1.0,
        alpha_mode=_mode(None if mask is None else pixels[..., 3], opacity),
    )


def _mode(alpha: UInt8[np.ndarray, "h w"] | None, opacity: float) -> AlphaMode:
    """Return the alpha mode: a black and white `map_d` cuts holes, greys and `d` make glass."""
    if alpha is None:
        return AlphaMode.BLEND if opacity < 1 else AlphaMode.OPAQUE
    is_between = (alpha > _MASK_CODES[0]) & (alpha < _MASK_CODES[1])
    return AlphaMode.BLEND if is_between.mean() > 0.5 else AlphaMode.MASK


def _scalar(
    picture: UInt8[np.ndarray, "h w _"] | None, written: float | None, default: float
) -> float:
    """Return the mean of a map, which replaces the number as in Blender, else the number."""
    if picture is not None:
        return float(picture[..., 0].mean(dtype=np.float64) / 255)
    return default if written is None else written


def _alpha_of(mask: UInt8[np.ndarray, "h w _"]) -> UInt8[np.ndarray, "h w"]:
    """Return the alpha of a picture, or its largest channel if it has no alpha."""
    return mask[..., 3] if mask.shape[2] == 4 else mask.max(axis=2)


def _with_alpha(
    picture: UInt8[np.ndarray, "h w _"], alpha: UInt8[np.ndarray, "h2 w2"] | None
) -> UInt8[np.ndarray, "h3 w3 c"]:
    """Return the picture's colours with an alpha channel, at the size of the larger picture."""
    if alpha is None:
        return np.ascontiguousarray(picture[..., :3])
    # Nearest neighbour: colours stay within the picture, and edges of holes sharp.
    height, width = alpha.shape if alpha.size > picture[..., 0].size else picture.shape[:2]
    rgb, a = _resized(picture[..., :3], height, width), _resized(alpha[..., None], height, width)
    return np.concatenate([rgb, a], axis=2)


def _resized(
    picture: UInt8[np.ndarray, "h w c"], height: int, width: int
) -> UInt8[np.ndarray, "h2 w2 c"]:
    rows = np.arange(height) * picture.shape[0] // height
    columns = np.arange(width) * picture.shape[1] // width
    return picture[rows[:, None], columns]
