"""Body of the ego vehicle in streets where it waits: a pickup with the sensors above its roof."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lightsim_lab.synthetic.finishes import PAINT_COUNT
from lightsim_lab.synthetic.participants import CarShape, build_car
from lightsim_lab.synthetic.plan import StreetPlan
from lightsim_lab.synthetic.shapes import Part

# Shape of the body. The heights of roof (1.75 m), bonnet and bed (1.3 m) make them visible to the
# lowest beams of the LiDAR (2.2 m, 25 degrees) and to the front and back cameras.
_SHAPE = CarShape(5.9, 1.98, 1.75, 1.55, 1.3, 0.45, waist_m=1.3)
# Position of the body's centre ahead of the sensors, in metres: its front is at x = 3.4 m.
_AHEAD_M = 0.45


def build_ego_body(plan: StreetPlan) -> tuple[Part, ...]:
    """Build the body of the ego vehicle, frame `ego`, with a drawn paint."""
    rng = np.random.default_rng([plan.seed, 11])
    parts, (_, _, height_m) = build_car(_SHAPE, f"paint{int(rng.integers(PAINT_COUNT))}")
    centre = np.array([_AHEAD_M, 0.0, height_m / 2])
    return tuple(
        replace(part, vertices=(part.vertices + centre).astype(np.float32)) for part in parts
    )
