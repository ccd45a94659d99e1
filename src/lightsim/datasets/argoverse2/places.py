"""Place and north of Argoverse 2: city frames are UTM grids, moved to an origin in each city."""

from __future__ import annotations

import cmath
import math
import re
from dataclasses import dataclass
from pathlib import Path

from lightsim.core.log import Place
from lightsim.datasets.geo import SEMI_MAJOR_M, Located
from lightsim.store.reading import is_folder


@dataclass(frozen=True)
class City:
    """Origin of a city's frame, whose x axis is grid east and whose y axis is grid north.

    Args:
        zone: UTM zone, northern hemisphere.
    """

    latitude_deg: float
    longitude_deg: float
    zone: int

    @property
    def meridian_deg(self) -> float:
        """Longitude of the zone's central meridian."""
        return 6.0 * self.zone - 183.0


# av2-api, src/av2/geometry/utm.py: CITY_ORIGIN_LATLONG_DICT and UTM_ZONE_MAP.
CITIES = {
    "ATX": City(30.27464237939507, -97.7404457407424, 14),
    "DTW": City(42.29993066912924, -83.17555750783717, 17),
    "MIA": City(25.77452579915163, -80.19656914449405, 17),
    "PAO": City(37.416065, -122.13571963362166, 10),
    "PIT": City(40.44177902989321, -80.01294377242584, 17),
    "WDC": City(38.889377, -77.0355047439081, 18),
}
# File names end in ____PIT_city_47896.json (vector map) or ____PIT.npy (ground heights).
_MAP_NAME = re.compile(r".*____([A-Z]{3})(?:_city_\d+)?\.(?:json|npy)")
# Error of a place, as an angle on Earth: 10 m. An assumption: the map is aligned with GPS.
_PLACE_STD_DEG = 1e-4
# Error of the map's north, in degrees. An assumption: 1 m of error over 500 m of map.
_NORTH_STD_DEG = 0.1
# Difference of grid north and true north, degrees: in the six cities it is -1.46 to 0.64.
_UNKNOWN_CITY_STD_DEG = 1.0

# WGS 84: flattening.
_FLATTENING = 1 / 298.257223563
# Scale of UTM on the central meridian.
_SCALE = 0.9996
# Easting of the central meridian of UTM, in metres.
_EASTING_M = 500_000.0
# Krueger's series in the third flattening n, to the third order, whose error is below 1 mm within a
# zone (Karney 2011, doi:10.1007/s00190-011-0445-3, equations 35, 36 and those of appendix A).
_N = _FLATTENING / (2 - _FLATTENING)
# Radius of the sphere whose meridian has the length of the ellipsoid's, in metres.
_RADIUS_M = SEMI_MAJOR_M / (1 + _N) * (1 + _N**2 / 4 + _N**4 / 64)
# From conformal latitude and longitude to the grid.
_FORWARD = (
    _N / 2 - 2 * _N**2 / 3 + 5 * _N**3 / 16,
    13 * _N**2 / 48 - 3 * _N**3 / 5,
    61 * _N**3 / 240,
)
# From the grid to conformal latitude and longitude.
_INVERSE = (
    _N / 2 - 2 * _N**2 / 3 + 37 * _N**3 / 96,
    _N**2 / 48 + _N**3 / 15,
    17 * _N**3 / 480,
)
# From conformal to geodetic latitude.
_LATITUDE = (
    2 * _N - 2 * _N**2 / 3 - 2 * _N**3,
    7 * _N**2 / 3 - 8 * _N**3 / 5,
    56 * _N**3 / 15,
)


def located(log_folder: Path, first_city_m: tuple[float, float]) -> tuple[Located, tuple[str, ...]]:
    """Return place and north of a log, and notes.

    The times are no UTC times: they "do not correspond with real-world time and date"
    (av2-api issue 100), so the clock is unknown.

    Args:
        first_city_m: first ego position in the city's frame.
    """
    clock_note = (
        "Argoverse 2 has no real date and time: the sun follows from shadows, --utc or --sun"
    )
    names = sorted(set(_city_names(log_folder / "map")))
    city = CITIES.get(names[0]) if len(names) == 1 else None
    if city is None:
        found = ", ".join(names) if names else "no file with a city in its name"
        # Every city's frame is a UTM grid, so that its x axis is east within two degrees.
        unknown = Located(None, None, None, 90.0, _UNKNOWN_CITY_STD_DEG)
        return unknown, (clock_note, f"the city is unknown: {found} in map/; give --place")
    latitude, longitude = latitude_longitude_deg(city, *first_city_m)
    place = Place(latitude, longitude, "map", _PLACE_STD_DEG)
    azimuth = 90.0 + convergence_deg(city, latitude, longitude)
    return Located(None, place, None, azimuth, _NORTH_STD_DEG), (clock_note,)


def _city_names(folder: Path) -> list[str]:
    if not is_folder(folder):
        return []
    found = (_MAP_NAME.fullmatch(path.name) for path in folder.iterdir())
    return [match[1] for match in found if match]


def utm_m(latitude_deg: float, longitude_deg: float, meridian_deg: float) -> tuple[float, float]:
    """Return UTM easting and northing of a place on the northern hemisphere."""
    sine = math.sin(math.radians(latitude_deg))
    turn = math.radians(longitude_deg - meridian_deg)
    root = 2 * math.sqrt(_N) / (1 + _N)
    t = math.sinh(math.atanh(sine) - root * math.atanh(root * sine))
    sphere = complex(
        math.atan2(t, math.cos(turn)), math.atanh(math.sin(turn) / math.sqrt(1 + t * t))
    )
    plane = sphere + sum(a * cmath.sin(2 * j * sphere) for j, a in enumerate(_FORWARD, 1))
    return _EASTING_M + _SCALE * _RADIUS_M * plane.imag, _SCALE * _RADIUS_M * plane.real


def latitude_longitude_deg(city: City, x_m: float, y_m: float) -> tuple[float, float]:
    """Return latitude and longitude of a position in a city's frame."""
    east, north = utm_m(city.latitude_deg, city.longitude_deg, city.meridian_deg)
    plane = complex(north + y_m, east + x_m - _EASTING_M) / (_SCALE * _RADIUS_M)
    sphere = plane - sum(b * cmath.sin(2 * j * plane) for j, b in enumerate(_INVERSE, 1))
    conformal = math.asin(math.sin(sphere.real) / math.cosh(sphere.imag))
    latitude = conformal + sum(d * math.sin(2 * j * conformal) for j, d in enumerate(_LATITUDE, 1))
    turn = math.atan2(math.sinh(sphere.imag), math.cos(sphere.real))
    return math.degrees(latitude), city.meridian_deg + math.degrees(turn)


def convergence_deg(city: City, latitude_deg: float, longitude_deg: float) -> float:
    """Return the azimuth of grid north, clockwise from true north.

    East of the central meridian true north leans towards the meridian, to the left of grid north,
    so that the azimuth of grid north is positive there. The formula is that of the sphere; on the
    ellipsoid it errs by less than 0.001 degrees within a zone (Snyder 1987, equation 8-15).
    """
    turn = math.radians(longitude_deg - city.meridian_deg)
    return math.degrees(math.atan(math.tan(turn) * math.sin(math.radians(latitude_deg))))
