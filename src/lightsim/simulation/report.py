"""HTML report of a relit scenario."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from lightsim.core.scenario import Scenario, ScenarioFrame
from lightsim.core.sensors import CameraFrame
from lightsim.profiling import ProfileRow
from lightsim.simulation.frame_files import picture_path
from lightsim.simulation.relighter import RelitFrame
from lightsim.simulation.target_sky import TargetSky
from lightsim.store.images import read_srgb8, write_png
from lightsim.view.figures import dome_preview, ratio_grey, reduced
from lightsim.view.report import (
    COMPARED_PX,
    Comparison,
    Figure,
    Section,
    Table,
    Video,
    profile_section,
    write_report,
)

_EDITED, _SOURCE_RATIO, _TARGET_RATIO = "edited", "source_ratio", "target_ratio"
_NAMES = {
    _EDITED: "edited, source sky",
    _SOURCE_RATIO: "shadow ratio, source sky",
    _TARGET_RATIO: "shadow ratio, target sky",
}
"""Names on the page of the pictures that are written while frames are made, by file stem."""


def report_frames(scenario: Scenario) -> tuple[ScenarioFrame, ...]:
    """Return the frames that the report shows: the middle frame of every camera."""
    by_camera: dict[str, list[ScenarioFrame]] = {}
    for frame in scenario.frames:
        by_camera.setdefault(frame.camera_name, []).append(frame)
    return tuple(frames[len(frames) // 2] for frames in by_camera.values())


def write_report_pictures(folder: Path, result: RelitFrame) -> None:
    """Write the pictures of one frame that only the report shows: the edited picture before
    relighting, and the shadow ratios of both skies."""
    pictures = {}
    # Under the source sky the final picture is the edited one.
    if result.source.is_edited.any() and result.image_srgb8 is not result.source.srgb8:
        pictures[_EDITED] = result.source.srgb8
    if result.lights is not None:
        ratios = [ratio_grey(light.ratio) for light in result.lights]
        pictures |= dict(zip((_SOURCE_RATIO, _TARGET_RATIO), ratios, strict=True))
    for stem, picture in pictures.items():
        path = _path_of(folder, result.frame, stem)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_png(path, reduced(picture, COMPARED_PX))


def _path_of(folder: Path, frame: CameraFrame, stem: str) -> Path:
    return folder / "report" / frame.camera_name / f"{stem}.png"


def write_relight_report(
    folder: Path,
    scenario: Scenario,
    target: TargetSky,
    viewer: str,
    profile: Sequence[ProfileRow] = (),
) -> None:
    """Write report.html of a scenario: one comparison per camera, the target sky, and the videos.

    Args:
        folder: with the files of the frames.
        viewer: command line that opens the scenario in the viewer.
        profile: of the command, if it is profiled.
    """
    shown = report_frames(scenario)
    facts = [[key, _text(value)] for key, value in target.record.items()]
    sky = Section(
        "Target sky",
        "Azimuths are clockwise from true north. Radiance is in scene units: the source camera "
        "maps 1.0 to a pixel value of 1.0.",
        tables=[Table(["fact", "value"], facts)],
        figures=[Figure("target sky, centre column along world +x", dome_preview(target.dome))],
    )
    comparisons = [_comparison(folder, frame, target) for frame in shown]
    ratios = (
        "The lists also contain the shadow ratio under both skies: black in full shadow, white in "
        "full light."
    )
    videos = [Video(f.camera_name, f"video/{f.camera_name}.mp4") for f in shown]
    sections = [
        Section("Cameras", "" if target.is_source else ratios, comparisons=comparisons),
        sky,
        Section("Video", videos=videos),
        *profile_section(profile),
    ]
    command = "simulate" if scenario.edits else "relight"
    subtitle = f"lightsim {command}, {target.facts.sky}"
    write_report(folder / "report.html", scenario.name, sections, subtitle=subtitle, viewer=viewer)


def _comparison(folder: Path, frame: ScenarioFrame, target: TargetSky) -> Comparison:
    """Return the recorded and the final picture, and what else was written of the frame."""
    changes = ["edited"] if frame.source != "recorded" else []
    changes += [] if target.is_source else ["relit"]
    images = {
        "recorded": frame.load_srgb8(),
        " and ".join(changes) or "source sky": read_srgb8(picture_path(folder, frame)),
    }
    for stem, name in _NAMES.items():
        path = _path_of(folder, frame, stem)
        if path.is_file():
            images[name] = read_srgb8(path)
    caption = f"{frame.camera_name}, frame {frame.stem}"
    return Comparison(caption, {name: reduced(p, COMPARED_PX) for name, p in images.items()})


def _text(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.5g}"
    if isinstance(value, list):
        return ", ".join(_text(v) for v in value)
    return str(value)
