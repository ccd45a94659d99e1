"""Classification of panoramas as day or night. The brightness of a night sky is part of its
content, so "auto" scaling must not change it."""

from __future__ import annotations

import numpy as np

from lightsim.core.colour import luminance
from lightsim.core.dome import SkyDome, split_sun
from lightsim.core.equirect import pixel_directions

# Sine of the elevation above which the sky is examined: 30 degrees, above most houses and lamps.
_UPPER_SINE = 0.5
# Upper limit on the median luminance of the upper sky, relative to the mean of the sphere without
# its strongest lamp or sun. Measured: nights up to 0.48, days with a grey upper sky from 0.64.
_DIM = 0.55
# Range of blue over red of the upper sky at night. Measured: dim day skies are blue (from 2.5) or
# contain green leaves and rock (at most 0.89); nights lie between 0.93 (haze lit by lamps) and 1.67
# (stars).
_GREY = (0.91, 2.0)


def looks_like_night(dome: SkyDome) -> bool:
    """Return whether a panorama was taken at night: its upper sky is neither blue nor brighter than
    its surroundings.

    Measured on 62 day and 7 night panoramas (python benchmarks/bench_night.py FOLDER): no day and
    five nights are found. A sky with stars alone is not found, because it resembles clouds; nor is
    a full moon on a long exposure, because it resembles the sun.
    """
    rest, _ = split_sun(dome)
    upper = pixel_directions(dome.height_px)[..., 2] > _UPPER_SINE
    mean = float(luminance(SkyDome(rest, None).mean_radiance))
    red, _, blue = np.median(rest[upper], axis=0).tolist()
    is_dim = float(np.median(luminance(rest[upper]))) < _DIM * mean
    return is_dim and _GREY[0] * red <= blue <= _GREY[1] * red
