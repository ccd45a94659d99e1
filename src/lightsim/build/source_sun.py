"""Direction of the source sun of a log: the posterior of all cues."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from lightsim.build.options import GpsUse
from lightsim.build.workspace import Workspace
from lightsim.core.log import GeoReference
from lightsim.core.twin import parked_actor_meshes
from lightsim.lighting.sample import SkyPrediction
from lightsim.lighting.sun.cues import Cue, NetworkCue, ShadowCue, ephemeris_cue, panorama_cues
from lightsim.lighting.sun.direction import SunDirection
from lightsim.lighting.sun.posterior import (
    SunPosterior,
    sun_direction,
    sun_posterior,
)
from lightsim.lighting.sun.shadow_likelihood import (
    ShadowLikelihood,
    ShadowLikelihoodConfig,
    likelihood_of_suns,
)
from lightsim.lighting.sun.surface_samples import sample_surfaces
from lightsim.progress import Progress
from lightsim.render.casters.embree import make_embree_caster


@dataclass(frozen=True)
class SourceSunConfig:
    """Settings of the search for the source sun."""

    votes: ShadowLikelihoodConfig = field(default_factory=ShadowLikelihoodConfig)
    """Likelihood of light and shade on the surfaces."""
    gps: GpsUse = "all"
    """GPS data to use."""


def find_source_sun(
    work: Workspace,
    config: SourceSunConfig,
    *,
    seed: int,
    progress: Progress,
    prediction: SkyPrediction | None = None,
) -> tuple[SunDirection, SunPosterior]:
    """Estimate the direction of the sun in the middle of the log.

    Args:
        prediction: output of the sky network for the log's panorama.

    Raises:
        InputError: the sun of place and time is below the horizon.
    """
    log = work.training_log
    # One direction for the whole log: the sun moves by 0.03 degrees in the 8 s of a PandaSet log.
    middle_ns = log.frames[len(log.frames) // 2].time_ns
    geo = _used_geo(log.geo, config.gps)
    cues: list[Cue] = []
    # Without a heading, the ephemeris still determines the elevation, and the azimuth from north.
    position = None if geo is None else geo.sun_at(middle_ns)
    if geo is not None and position is not None:
        cues.append(ephemeris_cue(geo, position))
    cues += panorama_cues(work.panorama)
    cues.append(
        ShadowCue(source_shadow_likelihood(work, config.votes, seed=seed, progress=progress))
    )
    if prediction is not None:
        cues.append(NetworkCue(prediction))
    posterior = sun_posterior(cues, work.panorama)
    return sun_direction(posterior, position), posterior


def source_shadow_likelihood(
    work: Workspace, config: ShadowLikelihoodConfig, *, seed: int, progress: Progress
) -> ShadowLikelihood:
    """Compute the likelihood of sun directions from light and shade on static surfaces."""
    log, assets = work.training_log, work.assets
    rng = np.random.default_rng(seed)
    path_world = log.camera_positions_m
    # Inferred roofs cast shadows, but have no observed colour to sample.
    casters = [*parked_actor_meshes(log, assets), work.inferred]
    samples, caster = sample_surfaces(
        assets.background, casters, path_world, make_embree_caster, config.samples, rng
    )
    return likelihood_of_suns(samples, caster, config, rng, progress=progress)


def _used_geo(geo: GeoReference | None, use: GpsUse) -> GeoReference | None:
    if geo is None or use == "none":
        return None
    # Without the heading, the azimuth must come from the images.
    if use == "place":
        return replace(
            geo, enu_from_world=None, heading_origin="unknown", heading_residual_deg=None
        )
    return geo
