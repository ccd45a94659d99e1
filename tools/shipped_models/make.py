"""Generate the assets that ship with LightSim: cars, a truck, a person, road works.

Run: python -m tools.shipped_models.make
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np
from tools.shipped_models.car import car_parts
from tools.shipped_models.person import person_parts
from tools.shipped_models.truck import truck_parts

from lightsim.core.actors import ActorKind
from lightsim.core.mesh import CAR_GLASS, CAR_GLASS_COLOUR, Material, TriMesh
from lightsim.scenario.shipped_assets import ASSETS_FOLDER
from lightsim.store.artefact import write_json
from lightsim.store.meshes import write_glb
from lightsim_lab.synthetic.shapes import Part, box, merge_parts, quads, tube

_PAINT = Material(0.2, 0.0, "car paint")
_PLASTIC = Material(0.5, 0.0, "plastic")
_LOOKS: Mapping[str, tuple[tuple[float, float, float], Material]] = {
    "white": ((0.72, 0.72, 0.71), _PAINT),
    "black": ((0.035, 0.037, 0.04), _PAINT),
    "grey": ((0.40, 0.41, 0.42), _PAINT),
    "red": ((0.42, 0.035, 0.03), _PAINT),
    "car_glass": (CAR_GLASS_COLOUR, CAR_GLASS),
    "rubber": ((0.035, 0.035, 0.036), Material(0.7, 0.0, "rubber")),
    "steel": ((0.42, 0.43, 0.44), Material(0.4, 0.5, "metal")),
    "lamp": ((0.38, 0.39, 0.40), Material(0.12, 0.0, "glass")),
    "tail": ((0.42, 0.02, 0.02), Material(0.12, 0.0, "glass")),
    "plate": ((0.75, 0.75, 0.72), _PLASTIC),
    "skin": ((0.48, 0.30, 0.22), Material(0.6, 0.0, "skin")),
    "cloth": ((0.10, 0.14, 0.28), Material(0.9, 0.0, "cloth")),
    "plastic": ((0.018, 0.018, 0.019), Material(0.4, 0.0, "plastic")),
    "trousers": ((0.045, 0.045, 0.055), Material(0.9, 0.0, "cloth")),
    "hair": ((0.025, 0.018, 0.012), Material(0.7, 0.0, "hair")),
    "orange": ((0.80, 0.16, 0.02), _PLASTIC),
    "stripe": ((0.80, 0.80, 0.78), Material(0.4, 0.0, "reflective foil")),
    "concrete": ((0.46, 0.45, 0.42), Material(0.9, 0.0, "concrete")),
    "sign_red": ((0.55, 0.04, 0.04), Material(0.35, 0.0, "reflective foil")),
}
"""Linear base colour and material of each look that a part names."""
_CREASE_DEG = 35.0
"""Faces that meet at less than this are one curved surface."""


def main() -> None:
    """Write every shipped asset and assets.json into the package's data folder."""
    ASSETS_FOLDER.mkdir(parents=True, exist_ok=True)
    for name, (_, parts) in _makers().items():
        write_glb(ASSETS_FOLDER / f"{name}.glb", _mesh(merge_parts(parts())))
    write_json(ASSETS_FOLDER / "assets.json", {name: kind for name, (kind, _) in _makers().items()})


def _makers() -> Mapping[str, tuple[ActorKind, Callable[[], Sequence[Part]]]]:
    return {
        "car": (ActorKind.CAR, partial(car_parts, "sedan", "grey")),
        "car-red": (ActorKind.CAR, partial(car_parts, "hatchback", "red")),
        "car-black": (ActorKind.CAR, partial(car_parts, "suv", "black")),
        "van": (ActorKind.CAR, partial(car_parts, "van", "white")),
        "truck": (ActorKind.TRUCK, truck_parts),
        "person": (ActorKind.PEDESTRIAN, person_parts),
        "cone": (ActorKind.CONE, _cone),
        "barrel": (ActorKind.BARRIER, _barrel),
        "barrier": (ActorKind.BARRIER, _barrier),
        "sign": (ActorKind.SIGN, _sign),
    }


def _cone() -> list[Part]:
    """A traffic cone of 0.75 m (MUTCD, Sec. 6F.64: 0.7 m and more on roads) with two collars."""
    heights = (0.03, 0.36, 0.46, 0.54, 0.64, 0.75)
    looks = ("orange", "stripe", "orange", "stripe", "orange")
    radii = [0.15 - 0.12 * h / 0.75 for h in heights]
    cone = [
        tube(look, (0, 0, low), (0, 0, high), (r0, r1), 24)
        for look, low, high, r0, r1 in zip(
            looks, heights, heights[1:], radii, radii[1:], strict=False
        )
    ]
    return [box("rubber", (-0.18, -0.18, 0.0), (0.18, 0.18, 0.03)), *cone]


def _barrel() -> list[Part]:
    """A channelising drum of 0.92 m (MUTCD, Sec. 6F.67)."""
    heights = np.linspace(0.08, 0.92, 6)
    looks = ("orange", "stripe", "orange", "stripe", "orange")
    drum = [
        tube(look, (0, 0, low), (0, 0, high), (0.25, 0.25), 28)
        for look, low, high in zip(looks, heights[:-1].tolist(), heights[1:].tolist(), strict=True)
    ]
    return [tube("rubber", (0, 0, 0), (0, 0, 0.08), (0.34, 0.31), 28), *drum]


def _barrier() -> list[Part]:
    """A concrete (Jersey) barrier of 3 m: slopes of 55 and 84 degrees (FHWA profile)."""
    profile = np.array([[0.30, 0.0], [0.30, 0.08], [0.12, 0.33], [0.075, 0.81]])
    outline = np.concatenate([profile, profile[::-1] * [-1, 1]])
    ends = [np.insert(outline, 0, x, axis=1) for x in (-1.5, 1.5)]
    around = np.stack(
        [ends[0], np.roll(ends[0], -1, axis=0), np.roll(ends[1], -1, axis=0), ends[1]], axis=1
    )
    strips = [np.stack([e[i], e[i + 1], e[-2 - i], e[-1 - i]]) for e in ends for i in range(3)]
    caps = np.stack([s if k >= 3 else s[::-1] for k, s in enumerate(strips)])
    skin = np.concatenate([around, caps])
    return [quads("concrete", skin, skin[..., :2])]


def _sign() -> list[Part]:
    """A round sign of 0.6 m on a pole, its face ahead."""
    return [
        tube("steel", (0, 0, 0), (0, 0, 2.5), (0.03, 0.03), 14),
        tube("sign_red", (0.03, 0, 2.3), (0.05, 0, 2.3), (0.3, 0.3), 36),
        tube("stripe", (0.05, 0, 2.3), (0.055, 0, 2.3), (0.22, 0.22), 36),
    ]


def _mesh(parts: Sequence[Part]) -> TriMesh:
    """Parts as one mesh around the middle of its box; curved surfaces are shaded smoothly."""
    smooth = [_smooth(part) for part in parts]
    vertices = np.concatenate([v for v, _ in smooth])
    offsets = np.cumsum([0] + [len(v) for v, _ in smooth[:-1]])
    faces = np.concatenate([f + o for (_, f), o in zip(smooth, offsets, strict=True)])
    looks = [_LOOKS[part.material] for part in parts]
    colour = np.repeat([rgb for rgb, _ in looks], [len(v) for v, _ in smooth], axis=0)
    materials = tuple(dict.fromkeys(material for _, material in looks))
    number = [materials.index(material) for _, material in looks]
    return TriMesh(
        "actor",
        (vertices - (vertices.min(axis=0) + vertices.max(axis=0)) / 2).astype(np.float32),
        faces.astype(np.int32),
        colour.astype(np.float32),
        materials,
        np.repeat(number, [len(f) for _, f in smooth]).astype(np.uint8),
    )


def _smooth(part: Part) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of a part whose vertices are split along creases alone."""
    from trimesh import Trimesh
    from trimesh.graph import smooth_shade

    mesh = Trimesh(part.vertices, part.faces, process=True)
    mesh.update_faces(mesh.nondegenerate_faces())
    shaded = smooth_shade(mesh, angle=np.radians(_CREASE_DEG))
    return np.asarray(shaded.vertices), np.asarray(shaded.faces)


if __name__ == "__main__":
    main()
