"""Lighting estimation on held-out skies and on logs; prints Markdown tables.

    python benchmarks/bench_lighting.py networks CACHE.npz [--models DIR]  as the paper's table A4
    python benchmarks/bench_lighting.py pictures CACHE.npz [--per-sky 4]   `sky estimate`
    python benchmarks/bench_lighting.py log WORK [--truth DIR]             a build, more or less GPS

CACHE: of `lightsim train prepare lighting` with benchmarks/hdri_split.csv. Its validation side is
scored; --side test is for releases. DIR holds the runs of `lightsim train` by name, each with
weights.safetensors.
"""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path

import numpy as np
from shadow_caster import caster_rmse

from lightsim.core.colour import luminance
from lightsim.core.dome import SkyDome, Sun, add_sun, resized, split_sun
from lightsim.core.solar import angle_between_deg, azimuth_elevation
from lightsim.lighting.sample import LightingBatch
from lightsim.lighting.sky.estimate import SkyConfig, estimate_sky
from lightsim.lighting.sky.image_sky import panorama_from_image, picture_sun
from lightsim.lighting.sun.direction import SunDirection
from lightsim.lighting.sun.posterior import sun_direction
from lightsim.progress import SilentProgress
from lightsim_lab.metrics.sky import evaluate_sky, relative_rmse, sphere_radiance
from lightsim_lab.training.hdr_skies import Side
from lightsim_lab.training.lighting_data import LightingSet

_WITHIN = 0.9


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("networks", "pictures", "log"))
    parser.add_argument("source", type=Path)
    parser.add_argument("--models", type=Path)
    parser.add_argument("--truth", type=Path)
    parser.add_argument("--per-sky", type=int, default=8)
    parser.add_argument("--side", choices=("validation", "test"), default="validation")
    options = parser.parse_args()
    if options.what == "networks":
        _networks(options.source, options.models, options.side, options.per_sky)
    elif options.what == "pictures":
        _pictures(options.source, options.side, options.per_sky)
    else:
        _log(options.source, options.truth)


def _networks(cache: Path, models: Path | None, side: Side, per_sky: int) -> None:
    """Angle and decoding errors of each network on the fixed views of a side."""
    from lightsim_lab.studies.sky_networks import named_networks
    from lightsim_lab.training.sky_scores import evaluate_sky_networks, parts_of

    train, held_out = LightingSet.load(cache), LightingSet.load(cache, side)
    known = [train.batch(32, 0, k, only_sunny=False) for k in range(4)]
    views = parts_of(held_out.fixed_views(per_sky).batch, 32)
    rows = evaluate_sky_networks(views, {}, known)
    for name, (model, complete) in named_networks(models).items():
        rows += evaluate_sky_networks(views, {name: model}, known, complete)[2:]
    _print_line(
        "| method | angle mean / median deg | sun seen | sun hidden, mean / median | log peak "
        "| sunny right | decoding log peak | decoding deg | angle in 90 % | peak in 90 % "
        "| log sky RMSE |"
    )
    _print_line("|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|")
    for r in rows:
        composed = "composed, " if r.composes_sun else ""
        cells = [
            f"{r.angle_mean_deg:.1f} / {r.angle_median_deg:.1f}",
            f"{r.angle_seen_deg:.1f}",
            f"{r.angle_hidden_deg:.1f} / {r.angle_hidden_median_deg:.1f}",
            _cell(r.log_peak_error),
            _cell(r.sunny_accuracy),
            composed + _cell(r.decoding_log_peak),
            composed + _cell(r.decoding_angle_deg),
            *(_cell(v) for v in (r.inside_90, r.peak_inside_90, r.log_sky_rmse)),
        ]
        _print_line(f"| {r.name} | " + " | ".join(cells) + " |")
    _print_line(f"\n{side}: {rows[0].count} views, {rows[0].sunny_count} under a clear sun")


def _cell(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.2f}"


def _pictures(cache: Path, side: Side, per_sky: int) -> None:
    """The shipped estimate on masked pictures: without GPS by cues alone, by the network, and
    with the true direction in place of GPS."""
    from lightsim.lighting.sky.predict import decoded_dome, predict_sky

    views = LightingSet.load(cache, side).fixed_views(per_sky)
    batch = views.batch
    table: dict[str, list[dict]] = {"cues": [], "network": [], "GPS + network": []}
    drawn: list[dict] = []
    for k in range(len(batch.log_peak)):
        panorama = panorama_from_image(
            np.round(batch.panorama[k] * 255).astype(np.uint8), batch.visibility[k], 64
        )
        said = predict_sky(panorama)
        truth = _true_dome(batch, k)
        true_sun = batch.sun_direction[k].astype(np.float64)
        for name, rows in table.items():
            posterior = picture_sun(panorama, said if "network" in name else None)
            sun = sun_direction(posterior, None)
            if name.startswith("GPS"):
                sun = _known_sun(true_sun, posterior.sunny_probability)
            prediction = said if "network" in name else None
            sky, _ = estimate_sky(panorama, sun, SkyConfig(height_px=64), prediction=prediction)
            peak = float(np.log(luminance(resized(sky.dome, 64).radiance).max()))
            rows.append(
                {
                    "angle": angle_between_deg(sun.direction_world, true_sun),
                    "inside": posterior.probability_within(true_sun) <= _WITHIN,
                    "sunny": (posterior.sunny_probability > 0.5) == bool(batch.is_sunny[k]),
                    "peak": abs(peak - float(batch.log_peak[k])),
                    "sphere": evaluate_sky(sky, truth=truth).sphere_si_rmse,
                    "caster": caster_rmse(sky.dome, truth, is_scale_free=True),
                    "is_sunny": bool(batch.is_sunny[k]),
                }
            )
        dome = decoded_dome(panorama)
        drawn.append(
            {
                "angle": angle_between_deg(said.sun_direction.astype(np.float64), true_sun),
                "inside": math.nan,
                "sunny": (said.sunny_probability > 0.5) == bool(batch.is_sunny[k]),
                "peak": abs(said.log_peak - float(batch.log_peak[k])),
                "sphere": relative_rmse(
                    sphere_radiance(dome), sphere_radiance(truth), is_scale_free=True
                ),
                "caster": caster_rmse(dome, truth, is_scale_free=True),
                "is_sunny": bool(batch.is_sunny[k]),
            }
        )
        sys.stderr.write(f"\r{k + 1}/{len(batch.log_peak)}")
    _print_line("\n| estimate | sunny: angle mean / median | in 90 % | log peak sunny / all "
         "| sunny right | sphere si-RMSE | shadow si-RMSE sunny / all |")  # fmt: skip
    _print_line("|---|---:|---:|---:|---:|---:|---:|")
    for name, rows in {**table, "decoder alone": drawn}.items():
        _print_line(_picture_line(name, rows))


def _picture_line(name: str, rows: list[dict]) -> str:
    def mean(key: str, only: list[dict]) -> float:
        return float(np.mean([row[key] for row in only]))

    sunny = [row for row in rows if row["is_sunny"]]
    angles = [row["angle"] for row in sunny]
    cells = (
        f"{np.mean(angles):.1f} / {np.median(angles):.1f}",
        f"{mean('inside', sunny):.2f}",
        f"{mean('peak', sunny):.2f} / {mean('peak', rows):.2f}",
        f"{mean('sunny', rows):.2f}",
        f"{mean('sphere', rows):.3f}",
        f"{mean('caster', sunny):.3f} / {mean('caster', rows):.3f}",
    )
    return f"| {name} | " + " | ".join(cells) + " |"


def _true_dome(batch: LightingBatch, k: int) -> SkyDome:
    """The true upper half over a ground of the estimate's usual kind: black, as neither metric
    that is scored looks down."""
    radiance = np.concatenate([batch.sky[k], np.zeros_like(batch.sky[k])])
    if not batch.is_sunny[k]:
        return SkyDome(radiance, None)
    # One pixel holds the sun: take it apart, so that its shadow is that of a disc.
    sun_there = Sun(batch.sun_direction[k].astype(np.float64), np.zeros(3, np.float32))
    sky, sun = split_sun(SkyDome(radiance, sun_there))
    return add_sun(sky, sun) if sun is not None else SkyDome(radiance, None)


def _known_sun(direction: np.ndarray, sunny_probability: float) -> SunDirection:
    elevation_deg = azimuth_elevation(direction).elevation_deg
    return SunDirection(
        direction, None, elevation_deg, "gps+time", 0.1, sunny_probability=sunny_probability
    )


def _log(work: Path, truth: Path | None) -> None:
    """The sun of a build with all, some and no GPS; the stage sky stays as it is on disk."""
    from lightsim.build.source_sun import SourceSunConfig, find_source_sun
    from lightsim.build.stages.sky import SkyStageConfig, source_sky
    from lightsim.build.workspace import Workspace
    from lightsim.lighting.sky.predict import predict_sky
    from lightsim_lab.synthetic.reader import true_sky

    workspace = Workspace(work)
    true_dome = true_sky(truth) if truth is not None else None
    _print_line("| GPS | angle deg | 90 % radius | P(sunny) | sun log error (std) | sky log error "
         "| sphere si-RMSE | shadow si-RMSE |")  # fmt: skip
    _print_line("|---|---:|---:|---:|---:|---:|---:|---:|")
    reference, said = None, predict_sky(workspace.panorama)
    for gps in ("all", "place", "none"):
        config = SourceSunConfig(gps=gps)
        sun, posterior = find_source_sun(
            workspace, config, seed=0, progress=SilentProgress(), prediction=said
        )
        if reference is None:
            reference = sun.direction_world
        if true_dome is not None and true_dome.sun is not None:
            reference = true_dome.sun.direction_world
        sky, _ = source_sky(
            workspace, sun, SkyStageConfig(), said, seed=0, progress=SilentProgress()
        )
        cells = ["-", "-", "-", "-"]
        if true_dome is not None and sky.dome.sun is not None and true_dome.sun is not None:
            report = evaluate_sky(sky, truth=true_dome)
            ev = report.sun_irradiance_error_ev
            cells = [
                "-"
                if ev is None
                else f"{ev * math.log(2):+.2f} ({sky.sun_irradiance_log_std:.2f})",
                f"{(report.sky_irradiance_error_ev or 0.0) * math.log(2):+.2f}",
                f"{report.sphere_si_rmse:.3f}",
                f"{caster_rmse(sky.dome, true_dome, is_scale_free=True):.3f}",
            ]
        angle = angle_between_deg(sun.direction_world, reference)
        _print_line(
            f"| {gps} | {angle:.2f} | {posterior.region_90_deg:.1f} "
            f"| {posterior.sunny_probability:.2f} | " + " | ".join(cells) + " |"
        )


def _print_line(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
