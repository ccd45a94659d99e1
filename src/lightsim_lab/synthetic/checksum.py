"""Checksum of a synthetic street, which detects changes of the generator."""

from __future__ import annotations

import hashlib
import json

import numpy as np

from lightsim.store.artefact import json_ready
from lightsim_lab.synthetic.plan import StreetConfig, Style, plan_street
from lightsim_lab.synthetic.skies import build_sky, more_sky_specs, sky_specs
from lightsim_lab.synthetic.street import build_background, build_participants

# Vertices are rounded to 1/128 m, so that rounding differences between processors have no effect.
_STEPS_PER_METRE = 128
# Rows of the sky domes in the checksum: large texels average such differences.
_SKY_ROWS = 8


def street_checksum(seed: int, style: Style = "city") -> str:
    """Return a checksum of the plan, geometry, actors and skies, all rounded.

    Path-traced images are not part of it, as their noise differs between machines.
    """
    plan = plan_street(seed, style)
    digest = hashlib.sha256()
    facts = (plan.latitude_deg, plan.longitude_deg, plan.enu_from_world.yaw_rad)
    digest.update(json.dumps([plan.start_ns, *(f"{x:.5f}" for x in facts)]).encode())
    for part in build_background(plan):
        digest.update(part.material.encode())
        digest.update(np.round(part.vertices * _STEPS_PER_METRE).astype(np.int32).tobytes())
    for actor in build_participants(plan, StreetConfig().ego_speed_m_s):
        place = [round(float(x), 3) for x in (*actor.start_m, actor.heading_rad, actor.speed_m_s)]
        digest.update(json.dumps(json_ready([actor.actor_id, place])).encode())
    for spec in (*sky_specs(plan), *more_sky_specs(plan)):
        sky = build_sky(spec, plan, 16 * _SKY_ROWS)
        sun = np.zeros(3) if sky.sun is None else sky.sun.irradiance
        # Radiance is rounded on a log scale: relative differences below 0.7 % are not detected.
        values = np.concatenate([sky.dome(_SKY_ROWS).radiance.ravel(), sun])
        digest.update(np.round(np.log2(np.maximum(values, 1e-3)) * 100).astype(np.int32).tobytes())
    return digest.hexdigest()[:16]
