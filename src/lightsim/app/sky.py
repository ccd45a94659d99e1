"""Sky dome and arc of the sun for the viewer's scene; no viewer is needed here.

The client of viser applies the ACES filmic tone curve of three.js to all surfaces, the sky dome
included, but not to camera pictures.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Float64, Int32, UInt8

from lightsim.app.glb import unlit_glb
from lightsim.core.colour import srgb8_from_linear
from lightsim.core.dome import SkyDome
from lightsim.core.equirect import directions_from_uv
from lightsim.core.log import DrivingLog, GeoReference
from lightsim.core.resample import resize_sphere
from lightsim.core.solar import SolarPosition, direction_world

DOME_RADIUS_M = 500.0
"""Radius of the sky dome. Streets reach 170 m from the ego vehicle, and the client's camera clips
at 1000 m: from everywhere inside the dome its far side is visible."""
# Rows of the dome's mesh: quads of 5.6 degrees. Texture coordinates vary linearly in a quad, which
# displaces the texture by less than 0.1 degrees. Chosen.
_ROWS = 32
# Columns of square quads.
_COLUMNS = 2 * _ROWS
# Rows of the dome's texture: 0.35 degrees, enough for clouds.
_TEXTURE_ROWS = 512
# An hour, in nanoseconds.
_HOUR_NS = 3_600_000_000_000
# A day, in nanoseconds.
_DAY_NS = 24 * _HOUR_NS
# Time between points of the day's arc: the sun moves by 3.75 degrees.
_STEP_NS = _HOUR_NS // 4


def dome_surface() -> tuple[
    Float32[np.ndarray, "n 3"], Int32[np.ndarray, "m 3"], Float32[np.ndarray, "n 2"]
]:
    """Return vertices, faces and texture coordinates of the dome around the origin, frame `world`.

    The texture coordinates are those of sky domes (core/equirect.py). Fronts of the faces are
    inside, so that the dome does not hide the scene from a camera outside of it.
    """
    u, v = np.meshgrid(np.linspace(0, 1, _COLUMNS + 1), np.linspace(0, 1, _ROWS + 1))
    uv = np.stack([u, v], axis=-1).reshape(-1, 2)
    vertices = DOME_RADIUS_M * directions_from_uv(uv)
    number = np.arange(len(uv)).reshape(_ROWS + 1, _COLUMNS + 1)
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]
    # Columns grow clockwise from above, to the right for a viewer inside.
    # At the poles, one triangle of each quad is empty.
    triangles = [np.stack([a, d, c], -1)[:-1], np.stack([a, c, b], -1)[1:]]
    faces = np.concatenate([part.reshape(-1, 3) for part in triangles])
    return vertices.astype(np.float32), faces.astype(np.int32), uv.astype(np.float32)


def dome_picture(dome: SkyDome, exposure_ev: float) -> UInt8[np.ndarray, "h w 3"]:
    """Return radiance times exposure as 8-bit sRGB, clipped at 1."""
    radiance = dome.radiance
    if len(radiance) > _TEXTURE_ROWS:
        radiance = resize_sphere(radiance, _TEXTURE_ROWS)
    return srgb8_from_linear(radiance * 2.0**exposure_ev)


def dome_glb(dome: SkyDome, exposure_ev: float) -> bytes:
    """Return the sky dome around the origin as unlit binary glTF, frame `world`."""
    return unlit_glb(*dome_surface(), dome_picture(dome, exposure_ev))


@dataclass(frozen=True, eq=False)
class SunArc:
    """The sun's path over one day at a log's place, where it is above the horizon.

    Args:
        times_ns: UTC, one each quarter of an hour.
        directions_world: unit vectors towards the sun.
    """

    times_ns: tuple[int, ...]
    directions_world: Float64[np.ndarray, "n 3"]

    @property
    def hours(self) -> dict[int, Float64[np.ndarray, "3"]]:
        """Direction at each full hour, by the UTC hour of the day."""
        pairs = zip(self.times_ns, self.directions_world, strict=True)
        return {t % _DAY_NS // _HOUR_NS: way for t, way in pairs if t % _HOUR_NS == 0}


def arc_of_log(log: DrivingLog, time_ns: int) -> SunArc | None:
    """Return the arc of the day around a time of the log's clock; None where it is unknown."""
    if log.geo is None or log.geo.clock is None:
        return None
    return sun_arc(log.geo, time_ns + log.geo.clock.utc_minus_log_ns)


def sun_arc(geo: GeoReference, utc_ns: int) -> SunArc | None:
    """Return the sun's path over the day around a time; None if place or north is unknown, or in
    polar night.

    The day is 24 hours of local solar time: it begins near the sun's lowest position.
    """
    if geo.place is None or geo.enu_from_world is None:
        return None
    # 15 degrees of longitude are one hour of local solar time.
    behind_ns = int(geo.place.longitude_deg / 15.0 * _HOUR_NS)
    midnight = (utc_ns + behind_ns) // _DAY_NS * _DAY_NS - behind_ns
    first = -(-midnight // _STEP_NS) * _STEP_NS
    suns = [(t, geo.sun_at_utc(t)) for t in range(first, first + _DAY_NS + 1, _STEP_NS)]
    shown = [(t, sun) for t, sun in suns if sun is not None and sun.elevation_deg > 0.0]
    if len(shown) < 2:
        return None
    ways = [_direction(sun, geo) for _, sun in shown]
    return SunArc(tuple(t for t, _ in shown), np.array(ways))


def _direction(sun: SolarPosition, geo: GeoReference) -> Float[np.ndarray, "3"]:
    assert geo.enu_from_world is not None
    return direction_world(sun.azimuth_deg, sun.elevation_deg, geo.enu_from_world)
