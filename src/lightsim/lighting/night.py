"""Night panoramas: their level is part of what they show, and "auto" scaling loses it."""

from __future__ import annotations

import numpy as np

from lightsim.core.colour import luminance
from lightsim.core.dome import SkyDome, split_sun
from lightsim.core.equirect import pixel_directions

_UPPER_SINE = 0.5
"""Sine of the elevation above which the sky is judged: 30 degrees, above most houses and lamps."""
_DIM = 0.55
"""Median luminance of the upper sky over the mean of the sphere without its strongest lamp or sun:
the upper sky gives little of the light. Nights up to 0.48; days of a grey upper sky from 0.64."""
_GREY = (0.91, 2.0)
"""Blue over red of the upper sky. Dim day skies are blue (from 2.5) or green leaves and rock (at
most 0.89); nights lie at 0.93 to 1.67: haze that lamps light, or stars."""


def looks_like_night(dome: SkyDome) -> bool:
    """Return whether a panorama was taken at night: its upper sky is neither blue nor a source of
    light beside what is around.

    On 62 day and 7 night panoramas (python benchmarks/bench_night.py FOLDER): no day, five nights;
    a sky of stars alone looks like clouds, and full moon on a long exposure like the sun.
    """
    rest, _ = split_sun(dome)
    upper = pixel_directions(dome.height_px)[..., 2] > _UPPER_SINE
    mean = float(luminance(SkyDome(rest, None).mean_radiance))
    red, _, blue = np.median(rest[upper], axis=0).tolist()
    is_dim = float(np.median(luminance(rest[upper]))) < _DIM * mean
    return is_dim and _GREY[0] * red <= blue <= _GREY[1] * red
