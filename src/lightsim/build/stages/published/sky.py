"""Source sky from the decoder of the sky network."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from lightsim.build.options import GpsUse
from lightsim.build.stages.context import Context
from lightsim.build.workspace import Workspace
from lightsim.core.colour import luminance
from lightsim.core.dome import SkyDome, add_sun, split_sun
from lightsim.core.solar import azimuth_elevation
from lightsim.lighting.sample import SkyPrediction
from lightsim.lighting.sky.predict import (
    completed_panorama,
    decoded_sky,
    is_published,
    predict_sky,
)
from lightsim.lighting.sun.direction import SunDirection, sun_from_geo
from lightsim.lighting.weights import SKY_WEIGHTS, LightingWeights
from lightsim.store.rooflines import write_rooflines
from lightsim.store.sky import (
    write_completed,
    write_panorama_pictures,
    write_sky,
)
from lightsim.store.weights import list_weights

# Weights of the published form, if the package contains them; otherwise those of our network.
_PUBLISHED_WEIGHTS = "sky-paper"
_WHITE_SUN = "the sun is white: the weights of the decoder contain its strength but not its colour"


@dataclass(frozen=True)
class DecodedSkyConfig:
    """Settings of the decoded sky (paper, Sec. 3.2)."""

    height_px: int = 256
    """Rows of the dome, which has twice as many columns."""
    gps: GpsUse = "all"
    """Use the sun of place, time and heading if available, else that of the network."""
    weights: Mapping[str, str] = field(default_factory=dict[str, str])
    """Content of the networks' weights (`LightingWeights.content`)."""


def default_weights() -> str:
    """Return the name of the shipped sky weights: of the published form if the package has them."""
    return _PUBLISHED_WEIGHTS if _PUBLISHED_WEIGHTS in list_weights() else SKY_WEIGHTS


def make_sky(
    work: Workspace, config: DecodedSkyConfig, folder: Path, context: Context
) -> Iterable[str]:
    """Write the dome that the decoder draws for the sun by GPS and time, or for the sun that the
    encoder estimates if these are missing."""
    log, panorama = work.training_log, work.panorama
    weights = LightingWeights.chosen(
        context.sky_weights, context.inpaint_weights, default_weights()
    )
    predicted = predict_sky(panorama, weights)
    geo, middle_ns = log.geo, log.frames[len(log.frames) // 2].time_ns
    if geo is None or config.gps != "all" or geo.direction_at(middle_ns) is None:
        sun = _encoded_sun(predicted)
    else:
        sun = sun_from_geo(geo, middle_ns)
    sky = decoded_sky(panorama, sun, predicted, config.height_px, weights)
    if not is_published(weights):
        sky = replace(sky, dome=_with_white_sun(sky.dome), notes=(*sky.notes, _WHITE_SUN))
    write_rooflines(folder / "rooflines.npz", [])
    write_sky(folder, sky, None if geo is None else geo.heading_deg)
    write_panorama_pictures(folder, panorama)
    write_completed(folder, completed_panorama(panorama, weights)[0])
    return sky.notes


def _with_white_sun(dome: SkyDome) -> SkyDome:
    """Return the dome with a white sun of the same luminance.

    f_int is a single number, and our decoder did not learn the sun's colour: its suns are a
    saturated green. The published decoder paints the sun with the rest of the sky.
    """
    rest, sun = split_sun(dome)
    if sun is None:
        return dome
    white = np.full(3, luminance(sun.irradiance), dtype=np.float32)
    return add_sun(rest, replace(sun, irradiance=white))


def _encoded_sun(predicted: SkyPrediction) -> SunDirection:
    """Return the sun direction f_dir of the encoder."""
    direction = predicted.sun_direction.astype(np.float64)
    return SunDirection(
        direction,
        None,
        azimuth_elevation(direction).elevation_deg,
        "network",
        # Standard deviation of each component of a von Mises-Fisher distribution.
        float(np.degrees(1 / np.sqrt(predicted.concentration))),
        ("the sun direction is that of the network; GPS and heading were not used",),
    )
