"""A relighting method: change the exposure alone, by the mean light of both skies."""

from pathlib import Path

import numpy as np

from lightsim.core.colour import luminance
from lightsim.relighting.estimate import Estimate, Relight
from lightsim.relighting.methods import Method
from lightsim.relighting.physical.ratio import RatioConfig, RelightInputs


def relight(inputs: RelightInputs, config: RatioConfig) -> Estimate:
    """Return the frame under the target sky.

    Args:
        inputs: one frame: radiance [h, w, 3] in scene units, geometry, light of both skies.
        config: settings of the physical method; unused here.
    """
    is_surface = np.isfinite(inputs.buffers.depth_z_m)
    before, after = (
        float(luminance(light.shaded)[is_surface].mean())
        for light in (inputs.source, inputs.target)
    )
    surface = inputs.radiance * np.float32(after / before)
    sky = inputs.sky_matte[..., None]
    return Estimate(sky * inputs.target_sky + (1 - sky) * surface)


def make(weights: Path | None) -> Relight:
    """Return the method's function; a method with a network would load it here."""
    return relight


EXPOSURE = Method(make)
