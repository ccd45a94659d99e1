"""Extensions of glTF: the supported ones, and remedies for the others.

Reference: Khronos glTF extension registry (github.com/KhronosGroup/glTF, extensions/2.0).
"""

from __future__ import annotations

from pathlib import Path

from lightsim.errors import InputError
from lightsim.store.notes import Notes

DRACO = "KHR_draco_mesh_compression"
MESHOPT = ("EXT_meshopt_compression", "KHR_meshopt_compression")
BASISU = "KHR_texture_basisu"
# Extensions that are read.
READ_EXTENSIONS = frozenset({
    "KHR_mesh_quantization", "KHR_texture_transform", "KHR_materials_pbrSpecularGlossiness",
    "KHR_materials_unlit", "KHR_materials_transmission", "EXT_mesh_gpu_instancing",
    "EXT_texture_webp", "KHR_node_visibility",
})  # fmt: skip
# Extensions that may be required but are ignored with a note on the effect.
NOTED_EXTENSIONS = frozenset({
    "KHR_materials_specular", "KHR_materials_ior", "KHR_materials_clearcoat",
    "KHR_materials_emissive_strength", "KHR_materials_sheen", "KHR_materials_volume",
    "KHR_materials_iridescence", "KHR_materials_anisotropy", "KHR_materials_dispersion",
    "KHR_materials_diffuse_transmission", "KHR_materials_variants", "KHR_lights_punctual",
    "KHR_animation_pointer", "KHR_xmp_json_ld", "KHR_xmp",
})  # fmt: skip
# Extensions that have their own errors or notes.
_NOTED_ELSEWHERE = frozenset({DRACO, *MESHOPT, BASISU, "EXT_texture_avif", "MSFT_texture_dds"})
# Extensions without effect here: hints for editors, and levels of detail.
_WITHOUT_EFFECT = frozenset({"FB_ngon_encoding", "MSFT_lod"})
_DECOMPRESS = (
    "Export it without mesh compression (Blender's glTF exporter: Data, Compression), or decompress"
    " it with gltf-transform: npx @gltf-transform/cli copy IN.glb OUT.glb."
)
_REMEDY_BY_EXTENSION = {
    DRACO: _DECOMPRESS,
    **dict.fromkeys(MESHOPT, _DECOMPRESS),
    BASISU: "Export it with PNG, JPEG or WebP pictures instead of KTX2.",
    "EXT_texture_avif": "Export it with PNG, JPEG or WebP pictures instead of AVIF.",
    "MSFT_texture_dds": "Export it with PNG, JPEG or WebP pictures instead of DDS.",
}


def unsupported(path: Path, *names: str) -> InputError:
    """Return the error for a file that requires unsupported extensions."""
    remedies = dict.fromkeys(_REMEDY_BY_EXTENSION[n] for n in names if n in _REMEDY_BY_EXTENSION)
    return InputError(
        "the model needs glTF extensions that are not supported",
        where=path,
        got=", ".join(sorted(names))[:300],
        expected="glTF 2.0 without them (docs/reference/assets.md lists what is read)",
        remedy=" ".join(remedies) or "Export it again without these extensions.",
    )


def note_unknown(used: object, notes: Notes) -> None:
    """Add a note on each extension that is unknown to this reader."""
    names = {name for name in used if isinstance(name, str)} if isinstance(used, list) else set()
    known = READ_EXTENSIONS | NOTED_EXTENSIONS | _NOTED_ELSEWHERE | _WITHOUT_EFFECT
    # The limit bounds the time for a hostile file.
    for name in sorted(names - known)[:100]:
        notes.add("extensions without a reader are left out", name)


def check_required(path: Path, required: object) -> None:
    """Raise InputError if the file requires an extension that is not supported."""
    if not isinstance(required, list) or not all(isinstance(name, str) for name in required):
        raise ValueError("extensionsRequired is not a list of names")
    missing = sorted(set(required) - READ_EXTENSIONS - NOTED_EXTENSIONS)
    if missing:
        raise unsupported(path, *missing)
