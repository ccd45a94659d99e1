"""Classification of panoramas as day or night. The brightness of a night sky is part of its
content, so "auto" scaling must not change it."""

from __future__ import annotations

import numpy as np

from lightsim.core.colour import luminance
from lightsim.core.dome import SkyDome, split_sun
from lightsim.core.equirect import pixel_directions

# Sine of the elevation above which the sky is used: 30 degrees, above most houses and lamps.
_UPPER_SINE = 0.5
# Upper limit on the median luminance of the upper sky, relative to the mean of the sphere without
# its strongest lamp or sun. Measured: nights up to 0.48, days with a grey upper sky from 0.64.
_MAX_RELATIVE_LUMINANCE = 0.55
# Range of the ratio of blue to red of the upper sky at night. Measured: dim day skies are blue
# (above 2.5) or contain leaves and rock (below 0.89); nights lie between 0.93 (haze lit by lamps)
# and 1.67 (stars).
_NIGHT_BLUE_OVER_RED = (0.91, 2.0)


def is_night_panorama(dome: SkyDome) -> bool:
    """Return True for panoramas taken at night: the upper sky is neither blue nor brighter than its
    surroundings.

    Of 62 day and 7 night panoramas (python benchmarks/bench_night.py FOLDER), no day and five
    nights are classified as night. A sky with only stars is missed, because it resembles clouds; a
    full moon with a long exposure is missed, because it resembles the sun.
    """
    rest, _ = split_sun(dome)
    upper = pixel_directions(dome.height_px)[..., 2] > _UPPER_SINE
    mean = float(luminance(SkyDome(rest, None).mean_radiance))
    red, _, blue = np.median(rest[upper], axis=0).tolist()
    is_dim = float(np.median(luminance(rest[upper]))) < _MAX_RELATIVE_LUMINANCE * mean
    return is_dim and _NIGHT_BLUE_OVER_RED[0] * red <= blue <= _NIGHT_BLUE_OVER_RED[1] * red
