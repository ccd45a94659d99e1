"""Skies as objects: a clear sky, where its sun stands, how much light it gives when turned.

Run: python examples/02_skies.py
"""

import sys

import numpy as np

from lightsim.core.dome import split_sun
from lightsim.core.sky_choice import SkyChoice
from lightsim.core.solar import azimuth_elevation
from lightsim.simulation.skies import sky_without_log


def main() -> None:
    sky = sky_without_log(SkyChoice("sun:120,35,3")).dome
    sun = split_sun(sky)[1]
    assert sun is not None
    position = azimuth_elevation(sun.direction_world)
    level = sky.horizontal_irradiance()
    turned = sky.rotated(-60.0)
    assert turned.sun is not None
    sys.stdout.write(
        f"sun at azimuth {position.azimuth_deg:.1f}, elevation {position.elevation_deg:.1f} deg\n"
        f"level irradiance {np.round(level, 2)}, of it sun "
        f"{np.round(sun.irradiance * sun.direction_world[2], 2)}\n"
        f"turned by 60 degrees: azimuth "
        f"{azimuth_elevation(turned.sun.direction_world).azimuth_deg:.1f}\n"
    )


if __name__ == "__main__":
    main()
