"""Sky stage: the light under which the log was recorded."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from lightsim.appearance.intrinsic.balance import balance_light
from lightsim.appearance.intrinsic.decompose import IntrinsicConfig, mesh_surfels
from lightsim.appearance.intrinsic.labels import ObservedSurfels
from lightsim.appearance.intrinsic.light import LightBalance
from lightsim.appearance.intrinsic.roofs import carve_roofs
from lightsim.build.assemble import roofs_over
from lightsim.build.options import SkyModel
from lightsim.build.source_light import IRRADIANCE, SourceLight
from lightsim.build.source_sun import SourceSunConfig, find_source_sun
from lightsim.build.stages.context import Context
from lightsim.build.workspace import Workspace
from lightsim.core.buildings import Roofline
from lightsim.core.frames import RigidTransform
from lightsim.core.mesh import TriMesh
from lightsim.core.twin import LightPrior, SkyEstimate
from lightsim.lighting.sample import SkyPrediction
from lightsim.lighting.sky.balance import rebalanced, unseen_part
from lightsim.lighting.sky.estimate import SkyConfig, estimate_sky
from lightsim.lighting.sky.predict import completed_panorama, decoded_sky, predict_sky
from lightsim.lighting.sun.direction import SunDirection
from lightsim.lighting.weights import LightingWeights
from lightsim.progress import Progress
from lightsim.render.transport.irradiance import IrradianceConfig
from lightsim.store.rooflines import write_rooflines
from lightsim.store.sky import (
    write_completed,
    write_panorama_pictures,
    write_sky,
)


@dataclass(frozen=True)
class SkyStageConfig:
    """Settings of the source sky: the sun's direction, and the light from evidence on surfaces."""

    sun: SourceSunConfig = field(default_factory=SourceSunConfig)
    sky: SkyConfig = field(default_factory=SkyConfig)
    irradiance: IrradianceConfig = field(default_factory=lambda: IRRADIANCE)
    """Settings of the light on the patches from which sun and unobserved sky are estimated."""
    labels: IntrinsicConfig = field(default_factory=IntrinsicConfig)
    """Settings of the shadow labels of these patches."""
    model: SkyModel = "analytic"
    """Model of the dome."""
    weights: Mapping[str, str] = field(default_factory=dict[str, str])
    """Content of the networks' weights (`LightingWeights.content`)."""


def make_sky(
    work: Workspace, config: SkyStageConfig, folder: Path, context: Context
) -> Iterable[str]:
    """Estimate the sun's direction, then the strengths of sun and sky; notes list the evidence."""
    weights = LightingWeights.chosen(context.sky_weights, context.inpaint_weights)
    predicted = predict_sky(work.panorama, weights)
    sun, _ = find_source_sun(
        work, config.sun, seed=context.seed, progress=context.progress, prediction=predicted
    )
    if config.model == "paper":
        sky = decoded_sky(work.panorama, sun, predicted, config.sky.height_px, weights)
        rooflines = work.initial_rooflines
    else:
        sky, rooflines = source_sky(
            work, sun, config, predicted, seed=context.seed, progress=context.progress
        )
    write_rooflines(folder / "rooflines.npz", rooflines)
    geo = work.training_log.geo
    write_sky(folder, sky, None if geo is None else geo.heading_deg)
    write_panorama_pictures(folder, work.panorama)
    write_completed(folder, completed_panorama(work.panorama, weights)[0])
    return sky.notes


def source_sky(
    work: Workspace,
    sun: SunDirection,
    config: SkyStageConfig,
    prediction: SkyPrediction | None,
    *,
    seed: int,
    progress: Progress,
) -> tuple[SkyEstimate, list[Roofline]]:
    """Return the source sky for a known sun direction, and the rooflines.

    A first estimate comes from the observed sky. Shadows and materials on surfaces then correct the
    sun, the unobserved sky and the roofs that cast these shadows.
    """
    estimate, light_prior = estimate_sky(
        work.panorama, sun, config.sky, progress=progress, prediction=prediction
    )
    log, rng = work.training_log, np.random.default_rng(seed)
    path_world = log.camera_positions_m
    patches = mesh_surfels(work.assets.background, config.labels, rng, path_world)
    if patches is None:
        return estimate, work.initial_rooflines
    # Light of the unobserved sky is computed apart, because its factor is fitted apart.
    unseen = unseen_part(estimate.dome, light_prior)

    def observe(inferred: TriMesh) -> ObservedSurfels:
        source = SourceLight(
            log, work.assets, inferred, estimate.dome, config.irradiance, seed, unseen
        )
        return patches.with_light(source.on(RigidTransform.identity("world", "world")))

    observed, rooflines = observe(work.inferred), work.initial_rooflines
    # Roofs first: a wrong roof edge shades lit patches, which would bias the fitted sun. The light
    # is computed again only if a roof changed, as this casts rays from all patches.
    carved = _carved(rooflines, observed, estimate, light_prior, config)
    if any((a.top != b.top).any() for a, b in zip(carved, rooflines, strict=True)):
        rooflines, observed = carved, observe(roofs_over(work.assets.background, carved))
    balance = balance_light(observed, light_prior, path_world, config.labels)
    # An infinite deviation means that the patches contain no evidence: the first estimate stays.
    if np.isinf(balance.sun_log_std):
        return estimate, rooflines
    note = f"{_moved_roofs(work.initial_rooflines, rooflines)}; {_balance_note(balance)}"
    balanced = rebalanced(
        estimate,
        light_prior,
        balance.sun,
        balance.unseen_sky,
        sun_log_std=balance.sun_log_std,
        unseen_log_std=balance.unseen_sky_log_std,
        note=note,
    )
    return balanced, rooflines


def _carved(
    rooflines: list[Roofline],
    observed: ObservedSurfels,
    estimate: SkyEstimate,
    light_prior: LightPrior,
    config: SkyStageConfig,
) -> list[Roofline]:
    """Return the rooflines, updated by the shadows they cast if the sun is clear."""
    sun = estimate.dome.sun
    # Without sharp shadows, dark materials would be mistaken for shadows and raise roofs.
    if sun is None or light_prior.is_veiled:
        return rooflines
    return carve_roofs(rooflines, observed, sun.direction_world, config.labels)


def _balance_note(balance: LightBalance) -> str:
    """Return a note with the factors of sun and sky and their standard deviations."""
    on_sun, on_unseen_sky = (
        f"({', '.join(f'{value:.2f}' for value in factor)}), log std {log_std:.2f}"
        for factor, log_std in (
            (balance.sun, balance.sun_log_std),
            (balance.unseen_sky, balance.unseen_sky_log_std),
        )
    )
    return (
        f"{balance.pair_count} lit/shadowed pairs of patches and known materials:"
        f" factor on the sun {on_sun}; factor on the unseen sky {on_unseen_sky}"
    )


def _moved_roofs(before: Sequence[Roofline], after: Sequence[Roofline]) -> str:
    """Return a note on the change of roof heights by shadows."""
    # A depth of 0 is a fence, which has no roof.
    unseen = [~a.is_seen & (a.depth_m > 0) for a in after]
    width = sum(float(u.sum() * a.cell_m) for u, a in zip(unseen, after, strict=True))
    if width == 0:
        return "all roofs were observed"
    steps = [np.abs(a.top_m - b.top_m)[u] for a, b, u in zip(after, before, unseen, strict=True)]
    return (
        f"{width:.0f} m of walls have unobserved roofs; shadows changed their height by"
        f" {np.mean(np.concatenate(steps)):.1f} m in the mean"
    )
