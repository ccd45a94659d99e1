"""What is put on and into a car's body: arches, mirrors, handles, plates."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from tools.shipped_models.car_body import ARCH_DEPTH_M, CarBody
from tools.shipped_models.painted_mesh import PaintedMesh

from lightsim_lab.synthetic.shapes import Part, box, ellipsoid, quads


def with_arches(mesh: PaintedMesh, body: CarBody) -> tuple[PaintedMesh, Part]:
    """The surface without what lies around the wheels, and the arches' inside."""
    mesh, is_inside = mesh.cut(body.arch_m(mesh.vertices))
    kept, removed = mesh.faces[~is_inside], mesh.faces[is_inside]
    # Rims: edges of what goes that what stays has the other way round.
    edges = removed[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    left = kept[:, [1, 0, 2, 1, 0, 2]].reshape(-1, 2)
    keys = np.array([len(mesh.vertices), 1])
    rim = edges[np.isin(edges @ keys, left @ keys)]
    a, b = mesh.vertices[rim[:, 0]], mesh.vertices[rim[:, 1]]
    axles = body.axles()
    nearest = np.argmin([np.abs(a[:, 0] - x) for x, _ in axles], axis=0)
    middle = np.array([[x, 0.0, radius] for x, radius in axles])[nearest]
    inner = np.sign(a[:, 1]) * (0.5 * body.design.width_m - ARCH_DEPTH_M)
    deep_a, deep_b, middle = (np.stack([p[:, 0], inner, p[:, 2]], axis=1) for p in (a, b, middle))
    around, wall = (a, b, deep_b, deep_a), (deep_a, deep_b, middle, middle)
    corners = np.concatenate([np.stack(quad, axis=1) for quad in (around, wall)])
    mesh = replace(mesh, faces=kept, look=mesh.look[~is_inside])
    return mesh, quads("black", corners, corners[..., [0, 2]])


def attached_parts(body: CarBody, paint: str) -> list[Part]:
    """Mirrors, handles, plates."""
    design, p = body.design, body.design.proportions
    cowl, tail = body.corners[3], body.corners[8]
    belt = p.belt_height * design.height_m
    parts = []
    for side in (-1.0, 1.0):
        x = float(cowl[0]) - 0.42
        y = side * (float(body.half_width_m(np.array([x]), np.array([belt]))[0]) + 0.09)
        parts.append(ellipsoid(paint, (x, y, belt + 0.09), (0.085, 0.115, 0.075)))
        for u in (*design.pillars, 0.76)[:2]:
            x, z = body.ahead_m(u) + 0.14, belt - 0.1
            y = side * float(body.half_width_m(np.array([x]), np.array([z]))[0])
            a, b = sorted((y - side * 0.02, y + side * 0.025))
            parts.append(box(paint, (x - 0.09, a, z - 0.014), (x + 0.09, b, z + 0.014)))
    for sign, z in ((1.0, 0.42), (-1.0, min(0.78 * float(tail[1]), 0.8))):
        ends = np.array([[s, 0.0, z] for s in np.linspace(0.35, 0.55, 400) * design.length_m])
        x = sign * float(ends[np.argmax(body.distance_m(ends * [sign, 1, 1]) > 0), 0])
        a, b = sorted((x - sign * 0.05, x + sign * 0.012))
        parts.append(box("plate", (a, -0.26, z - 0.055), (b, 0.26, z + 0.055)))
    return parts
