"""Report of a build (report/index.html): pictures of the twin and stored measures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from lightsim.build.measures import Measures, read_measures
from lightsim.build.workspace import Workspace
from lightsim.core.colour import srgb8_from_linear
from lightsim.core.notes import unseen_notes
from lightsim.core.sensors import CameraFrame
from lightsim.profiling import profile_so_far
from lightsim.render.frame_renderer import FrameRenderer, TransportFrame
from lightsim.render.transport.matrix import TransportConfig
from lightsim.render.transport.sky import EnvironmentCells
from lightsim.scenario.replay import replay
from lightsim.store.artefact import read_json, read_record
from lightsim.view.figures import (
    depth_colours,
    dome_preview,
    normal_colours,
    reduced,
    strip,
    tone_mapped,
)
from lightsim.view.report import (
    COMPARED_PX,
    Card,
    Comparison,
    Figure,
    Section,
    Table,
    profile_section,
    viewer_command,
    write_report,
)


@dataclass(frozen=True)
class ReportConfig:
    """Settings of the report."""

    stages: tuple[str, ...]
    """Names of the stages to list with their times and notes."""
    transport: TransportConfig = field(default_factory=TransportConfig)
    """Settings of the light in the pictures."""


def write_build_report(path: Path, work: Workspace, config: ReportConfig) -> None:
    """Write the report: sky, meshes, scores of held-out frames, times."""
    measured = read_measures(work.need("measures"))
    frames, log = measured.frames, work.log
    cards = [
        Card("frames", str(len(log.frames)), f"{len(log.cameras)} cameras"),
        Card("sweeps", str(len(log.sweeps)), f"{len(log.actors)} actors"),
        _sun_card(work),
        Card(
            "LiDAR error",
            f"{100 * measured.lidar.median_abs_m:.1f} cm",
            "median, "
            + ("held-out sweeps" if measured.is_held_out else "sweeps of the build itself"),
        ),
    ]
    if frames is not None:
        # Mean over cameras, each the mean over its frames.
        score = np.mean([r.scores.psnr_db for r in frames.rows if _is_twin(r)])
        cards.append(Card("held-out PSNR", f"{score:.1f} dB", "without sky and ego vehicle"))
    sections = [
        _sky_section(work),
        _scene_section(work, config.transport),
        _number_section(measured),
        _stage_section(work, config.stages),
        *profile_section(profile_so_far()),
    ]
    title, viewer = f"Twin of {log.name}", viewer_command(work.root)
    write_report(path, title, sections, subtitle="lightsim build", cards=cards, viewer=viewer)


def _is_twin(row: object) -> bool:
    return getattr(row, "method", "") == "twin" and getattr(row, "region", "") == "masked"


def _sun_card(work: Workspace) -> Card:
    sky = work.sky
    azimuth = "unknown" if sky.sun_azimuth_deg is None else f"{sky.sun_azimuth_deg:.1f}"
    note = f"azimuth, elevation in degrees; {sky.origin}, +-{sky.uncertainty_deg:.2f}"
    return Card("sun", f"{azimuth}, {sky.sun_elevation_deg:.1f}", note)


def _sky_section(work: Workspace) -> Section:
    panorama, sky = work.panorama, work.sky
    # A fraction of pixels, not of solid angle: rows near the zenith count more than they cover.
    seen = f"{100 * panorama.is_sky[: panorama.is_sky.shape[0] // 2].mean():.0f} %"
    return Section(
        "Sky",
        f"The cameras observed {seen} of the upper hemisphere as sky. The centre column of both "
        "pictures is world +x.\n\n" + "\n\n".join(f"{note}." for note in sky.notes),
        figures=[
            Figure("stitched panorama", srgb8_from_linear(panorama.radiance)),
            Figure("estimated sky, tone-mapped, ring around the sun", dome_preview(sky.dome)),
        ],
    )


def _scene_section(work: Workspace, config: TransportConfig) -> Section:
    log, twin = work.log, work.twin
    renderer = FrameRenderer(twin.assets.background, work.unobserved_occluders, config, seed=0)
    scenario = replay(twin, "report", log.frames)
    sky = renderer.prepare(work.sky.dome)
    comparisons, figures = [], []
    for name, camera in log.cameras.items():
        frame = _shown_frame(work, name)
        traced = renderer.trace(scenario, frame, camera)
        rendered = srgb8_from_linear(traced.image(sky) * twin.assets.camera_gains[name])
        held_out = ", held out" if frame.stem in work.held_out else ""
        images = {"recorded": frame.load_srgb8(), "twin": rendered}
        comparisons.append(
            Comparison(
                f"{name}, frame {frame.stem}{held_out}",
                {key: reduced(image, COMPARED_PX) for key, image in images.items()},
            )
        )
        figures.append(_buffers_figure(name, traced, sky, work.sky_matte(frame)))
    text = "The twin is rendered under the estimated sky of the recording, without relighting."
    return Section("Scene", text, comparisons=comparisons, figures=figures)


def _buffers_figure(
    camera_name: str,
    traced: TransportFrame,
    sky: EnvironmentCells,
    matte: Float32[np.ndarray, "h w"],
) -> Figure:
    buffers = traced.buffers
    shown = [
        srgb8_from_linear(buffers.base_colour),
        tone_mapped(traced.light(sky).shaded),
        normal_colours(buffers),
        depth_colours(buffers.depth_z_m),
        np.repeat(matte[..., None] * 255, 3, axis=2).astype(np.uint8),
    ]
    caption = f"{camera_name}: base colour | source light | normals | depth | sky matte"
    return Figure(caption, strip([reduced(p, 360) for p in shown]), is_wide=True)


def _shown_frame(work: Workspace, camera_name: str) -> CameraFrame:
    """Return the middle one of the camera's held-out frames, or of all if none is held out."""
    frames = work.log.frames_of(camera_name)
    frames = [frame for frame in frames if frame.stem in work.held_out] or frames
    return frames[len(frames) // 2]


def _number_section(measured: Measures) -> Section:
    s, frames = measured.lidar, measured.frames
    lidar = Table(
        ["returns", "hit rate", "median abs m", "90 % m", "within 10 cm"],
        [
            [
                s.count,
                round(s.hit_rate, 3),
                round(s.median_abs_m, 3),
                round(s.percentile_90_m, 3),
                round(s.within_10_cm, 3),
            ]
        ],
        "LiDAR beams cast again on the meshes",
    )
    tables = [lidar]
    if frames is not None:
        # Raw images in the region without sky and ego vehicle; other rows are in measures.json.
        rows = [
            [r.camera_name, r.method, round(r.scores.psnr_db, 2), round(r.scores.ssim, 3)]
            for r in frames.rows
            if r.region == "masked" and not r.is_exposed
        ]
        tables.append(
            Table(["camera", "image", "PSNR dB", "SSIM"], rows, "held-out frames, no sky, raw")
        )
    return Section("Numbers", tables=tables)


def _stage_section(work: Workspace, stage_names: Sequence[str]) -> Section:
    rows, notes, seen = [], [], set[str]()
    for name in stage_names:
        record = read_record(work.folder(name))
        if record is not None:
            rows.append([name, record["seconds"], record["peak_memory_mb"]])
            # Notes of the sky are printed beside its picture. Stages repeat notes of their inputs.
            own = () if name == "sky" else unseen_notes(record["notes"], seen)
            notes += [f"{name}: {note}." for note in own]
    summary = read_json(work.need("log") / "log.json")
    text = f"Held out: {', '.join(summary['held_out']) or 'nothing'}.\n\n" + "\n\n".join(notes)
    return Section("Stages", text, tables=[Table(["stage", "seconds", "peak MB so far"], rows)])
