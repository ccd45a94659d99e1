"""Cars that ship with LightSim: smooth closed bodies, and on them what makes a car of a body."""

from __future__ import annotations

from tools.shipped_models.car_body import DESIGNS, CarBody, body_surface
from tools.shipped_models.car_fittings import attached_parts, with_arches
from tools.shipped_models.car_markings import with_markings
from tools.shipped_models.painted_mesh import PaintedMesh
from tools.shipped_models.wheels import wheel_parts

from lightsim_lab.synthetic.shapes import Part, merge_parts


def car_parts(design: str, paint: str) -> list[Part]:
    """One part a look of a car: x ahead, y left, z from the ground.

    Args:
        design: one of `DESIGNS`.
        paint: the look of its paint; looks are those of `built_in_assets`.
    """
    body = CarBody(DESIGNS[design])
    mesh, arches = with_arches(PaintedMesh.plain(paint, *body_surface(body)), body)
    painted = with_markings(mesh, body)
    fittings = [
        arches,
        *attached_parts(body, paint),
        *wheel_parts(body.axles(), body.wheel_face_m()),
    ]
    return list(merge_parts([*painted.parts(), *fittings]))
