"""Reader of glTF materials: base colour, roughness, metallic factor and alpha.

Reference: Khronos glTF 2.0 specification, section 3.9, and the KHR_materials_* extensions.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float64, Int32

from lightsim.core.mesh import Material
from lightsim.store.gltf_document import GltfDocument, extensions
from lightsim.store.gltf_material_notes import note_unread
from lightsim.store.gltf_textures import Textures, coordinate_set, coordinates
from lightsim.store.notes import Notes
from lightsim.store.primitives import AlphaMode, ImageTexture
from lightsim.store.specular_glossiness import convert_pictures, metal_from_specular
from lightsim.store.texture_sampling import (
    interpolated,
    sample_channel,
    sample_colour,
    surface_samples,
)

_ALPHA_MODES = {"OPAQUE": AlphaMode.OPAQUE, "MASK": AlphaMode.MASK, "BLEND": AlphaMode.BLEND}
_GLOSSY = "KHR_materials_pbrSpecularGlossiness"


@dataclass(frozen=True, eq=False)
class Geometry:
    """Shape of a primitive, over which textures are averaged.

    Args:
        uv: returns TEXCOORD_n, or None where the primitive has none.
    """

    vertices: Float64[np.ndarray, "n 3"]
    faces: Int32[np.ndarray, "m 3"]
    uv: Callable[[int], Float64[np.ndarray, "n 2"] | None]


@dataclass(frozen=True, eq=False)
class Surface:
    """Appearance of a primitive; see `Primitive`. `factor` is linear RGB and alpha."""

    factor: Float64[np.ndarray, " 4"]
    material: Material
    texture: ImageTexture | None = None
    uv: Float64[np.ndarray, "n 2"] | None = None
    alpha_mode: AlphaMode = AlphaMode.OPAQUE
    alpha_cutoff: float = 0.5
    transmission: float = 0.0


class Materials:
    """Reader of the materials of one document."""

    def __init__(self, document: GltfDocument, textures: Textures, notes: Notes) -> None:
        self._document = document
        self._textures = textures
        self._notes = notes
        generator = str(document.json["asset"].get("generator", ""))
        self._is_default_metal = "Blender" in generator

    def surface(self, index: object, geometry: Geometry) -> Surface:
        """Return the appearance of a primitive with this material (None: the default material).

        A material without a metallic factor and without a metallic-roughness texture becomes
        non-metallic, with a note: converters from older formats omit the factor, and the standard's
        default of 1 would remove the diffuse colour of such models. Blender's exporter omits it
        only if it is 1, so the standard's default applies to its files.
        """
        value = {} if index is None else self._document.item("materials", index)
        name = str(value.get("name", f"material {'by default' if index is None else index}"))
        note_unread(value, name, self._notes)
        if _GLOSSY in extensions(value):
            surface = self._glossy(extensions(value)[_GLOSSY], name, geometry)
        else:
            surface = self._metallic_roughness(value, name, geometry)
        if "KHR_materials_unlit" in extensions(value):
            # The fallback that KHR_materials_unlit recommends: rough (0.9) and not metallic.
            surface = replace(surface, material=Material(0.9, 0.0, name))
        surface = replace(surface, transmission=self._transmission(value, geometry, name))
        mode = value.get("alphaMode", "OPAQUE")
        if mode not in _ALPHA_MODES:
            raise ValueError(f"alphaMode {str(mode)[:20]!r}, not one of {', '.join(_ALPHA_MODES)}")
        cutoff = _number(value.get("alphaCutoff", 0.5))
        return replace(surface, alpha_mode=_ALPHA_MODES[mode], alpha_cutoff=cutoff)

    def _metallic_roughness(self, value: dict[str, Any], name: str, geometry: Geometry) -> Surface:
        pbr = value.get("pbrMetallicRoughness", {})
        factor = _numbers(pbr.get("baseColorFactor", [1.0] * 4), 4)
        texture, uv = self._textured(pbr.get("baseColorTexture"), geometry, _shown(name, factor))
        reference = pbr.get("metallicRoughnessTexture")
        roughness = _number(pbr.get("roughnessFactor", 1.0))
        metallic = _number(pbr.get("metallicFactor", 1.0))
        if "metallicFactor" not in pbr and reference is None and not self._is_default_metal:
            metallic = 0.0
            if "KHR_materials_unlit" not in extensions(value):
                self._notes.add(
                    "materials without a metallic factor are read as non-metallic, although the"
                    " standard's default is metal",
                    name,
                )
        # Green holds roughness, blue the metallic factor (section 3.9.2).
        roughness *= self._mean(reference, geometry, 1, name)
        metallic *= self._mean(reference, geometry, 2, name)
        return Surface(factor, _material(roughness, metallic, name), texture, uv)

    def _glossy(self, value: dict[str, Any], name: str, geometry: Geometry) -> Surface:
        factor = _numbers(value.get("diffuseFactor", [1.0] * 4), 4)
        specular = _numbers(value.get("specularFactor", [1.0] * 3), 3)
        texture, uv = self._textured(value.get("diffuseTexture"), geometry, _shown(name, factor))
        reference = value.get("specularGlossinessTexture")
        glossy, glossy_uv = self._textured(reference, geometry, name)
        glossiness = _number(value.get("glossinessFactor", 1.0))
        # Alpha of the specular texture holds glossiness.
        glossiness *= self._mean(reference, geometry, 3, name)
        is_apart = uv is not None and glossy_uv is not None and not np.array_equal(uv, glossy_uv)
        # The conversion combines both pictures pixel by pixel, which requires common coordinates.
        if glossy is not None and is_apart:
            self._notes.add(
                "specular textures with other coordinates than the diffuse texture are averaged",
                name,
            )
            assert glossy_uv is not None
            specular = specular * _mean_colour(glossy, glossy_uv, geometry)
            glossy, glossy_uv = None, None
        base, metallic = metal_from_specular(factor[:3], specular)
        if texture is None and glossy is None:
            factor = np.append(base, factor[3])
            return Surface(factor, _material(1 - glossiness, float(metallic), name))
        # A specular colour of non-metals leaves the diffuse texture as it is.
        if glossy is None and metal_from_specular(np.zeros(3), specular)[1] == 0:
            return Surface(factor, _material(1 - glossiness, 0.0, name), texture, uv)
        uv = uv if uv is not None else glossy_uv
        assert uv is not None
        colours, metals = convert_pictures(texture, factor[:3], glossy, specular)
        mean = _mean_channel(metals, uv, geometry, 0)
        factor = np.array([1.0, 1.0, 1.0, factor[3]])
        return Surface(factor, _material(1 - glossiness, mean, name), colours, uv)

    def _transmission(self, value: dict[str, Any], geometry: Geometry, name: str) -> float:
        transmission = extensions(value).get("KHR_materials_transmission", {})
        factor = _number(transmission.get("transmissionFactor", 0.0))
        if factor == 0:
            return 0.0
        return factor * self._mean(transmission.get("transmissionTexture"), geometry, 0, name)

    def _mean(
        self, reference: dict[str, Any] | None, geometry: Geometry, channel: int, name: str
    ) -> float:
        """Return the mean of a texture's channel over the faces; 1 without a texture."""
        texture, uv = self._textured(reference, geometry, name)
        if texture is None or uv is None:
            return 1.0
        return _mean_channel(texture, uv, geometry, channel)

    def _textured(
        self, reference: dict[str, Any] | None, geometry: Geometry, name: str
    ) -> tuple[ImageTexture | None, Float64[np.ndarray, "n 2"] | None]:
        """Return a texture and its coordinates; None for both, with a note, if one is missing."""
        if reference is None:
            return None, None
        number = coordinate_set(reference)
        uv = geometry.uv(number)
        texture = self._textures.texture(reference.get("index"))
        if uv is None:
            texture = f"textures of parts without TEXCOORD_{number} are not read"
        if isinstance(texture, str) or uv is None:
            self._notes.add(f"{texture}: the material's factors alone remain", name)
            return None, None
        return texture, coordinates(uv, reference)


def _mean_channel(
    texture: ImageTexture, uv: Float64[np.ndarray, "n 2"], geometry: Geometry, channel: int
) -> float:
    # Rounded, so that parts with nearly equal means have a common material.
    return round(float(sample_channel(texture, _points(uv, geometry), channel).mean()), 3)


def _mean_colour(
    texture: ImageTexture, uv: Float64[np.ndarray, "n 2"], geometry: Geometry
) -> Float64[np.ndarray, " 3"]:
    return sample_colour(texture, _points(uv, geometry)).astype(np.float64).mean(axis=0)


def _points(uv: Float64[np.ndarray, "n 2"], geometry: Geometry) -> Float64[np.ndarray, "k 2"]:
    """Return the texture coordinates of evenly distributed points on the faces."""
    samples = surface_samples(geometry.vertices, geometry.faces)
    return interpolated(uv, geometry.faces, samples)


def _material(roughness: float, metallic: float, name: str) -> Material:
    return Material(_unit(roughness), _unit(metallic), name)


def _shown(name: str, factor: Float64[np.ndarray, " 4"]) -> str:
    """Return the name and base colour of a material for notes."""
    return f"{name}: linear {factor[0]:.2g} {factor[1]:.2g} {factor[2]:.2g}"


def _unit(value: float) -> float:
    return min(max(value, 0.0), 1.0)


def _number(value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise ValueError(f"a material has {str(value)[:40]} where a number is expected")
    return float(value)


def _numbers(value: object, count: int) -> Float64[np.ndarray, " n"]:
    """Return a list of numbers, clipped to the range [0, 1] of the standard."""
    if not isinstance(value, list) or len(value) != count:
        raise ValueError(f"a material has {str(value)[:40]} where {count} numbers are expected")
    return np.clip([_number(number) for number in value], 0.0, 1.0)
