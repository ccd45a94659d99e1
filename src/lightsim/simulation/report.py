"""HTML report of a relit scenario."""

from __future__ import annotations

from pathlib import Path

from lightsim.core.scenario import Scenario
from lightsim.core.sensors import CameraFrame
from lightsim.simulation.relighter import RelitFrame
from lightsim.simulation.target_sky import TargetSky
from lightsim.store.images import read_srgb8, write_png
from lightsim.view.figures import (
    dome_preview,
    ratio_grey,
    reduced,
    strip,
)
from lightsim.view.report import Figure, Section, Table, Video, write_report


def report_frames(scenario: Scenario) -> tuple[CameraFrame, ...]:
    """Return the frames that the report shows: the middle frame of every camera."""
    by_camera: dict[str, list[CameraFrame]] = {}
    for frame in scenario.frames:
        by_camera.setdefault(frame.camera_name, []).append(frame)
    return tuple(frames[len(frames) // 2] for frames in by_camera.values())


def write_report_strip(folder: Path, result: RelitFrame) -> None:
    """Write the strip of one relit frame for the report: recorded, edited and relit pictures, and
    the shadow ratios of both skies."""
    parts = [result.frame.load_srgb8()]
    if result.source.is_edited.any():
        parts.append(result.source.srgb8)
    # Under the source sky the relit picture is the source image itself.
    if result.image_srgb8 is not result.source.srgb8:
        parts.append(result.image_srgb8)
    if result.lights is not None:
        parts += [ratio_grey(light.ratio) for light in result.lights]
    path = _strip_of(folder, result.frame)
    path.parent.mkdir(parents=True, exist_ok=True)
    # Five pictures of 480 pixels fit across a wide screen.
    write_png(path, strip([reduced(p, 480) for p in parts]))


def _strip_of(folder: Path, frame: CameraFrame) -> Path:
    return folder / "report" / f"{frame.camera_name}.png"


def write_relight_report(path: Path, folder: Path, scenario: Scenario, target: TargetSky) -> None:
    """Write the report of a scenario: one strip per camera, the target sky, and the videos."""
    cameras = list(dict.fromkeys(f.camera_name for f in scenario.frames))
    edited = "edited, if edits are visible | " if scenario.edits else ""
    figures = []
    for frame in report_frames(scenario):
        caption = (
            f"{frame.camera_name}, frame {frame.stem}: recorded | {edited}relit | "
            "shadow ratio source | target"
        )
        figures.append(Figure(caption, read_srgb8(_strip_of(folder, frame)), is_wide=True))
    facts = [[key, _text(value)] for key, value in target.record.items()]
    sky = Section(
        "Target sky",
        "Azimuths are clockwise from true north. Radiance is in scene units: the source camera "
        "maps 1.0 to a pixel value of 1.0.",
        tables=[Table(["fact", "value"], facts)],
        figures=[Figure("target sky, centre column along world +x", dome_preview(target.dome))],
    )
    videos = [Video(name, f"video/{name}.mp4") for name in cameras]
    sections = [Section("Cameras", figures=figures), sky, Section("Video", videos=videos)]
    command = "simulate" if scenario.edits else "relight"
    subtitle = f"lightsim {command}, {target.facts.sky}"
    write_report(path, scenario.name, sections, subtitle=subtitle)


def _text(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.5g}"
    if isinstance(value, list):
        return ", ".join(_text(v) for v in value)
    return str(value)
