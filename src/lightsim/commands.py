"""What each command does, on the options that cli.py parsed."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, runtime_checkable

from lightsim.errors import InputError
from lightsim.progress import terminal_progress

if TYPE_CHECKING:
    from lightsim import cli
    from lightsim.skies import SkyChoice


@runtime_checkable
class _Report(Protocol):
    def to_table(self) -> str: ...

    def to_json(self) -> str: ...


def _say(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def _names(text: str) -> tuple[str, ...]:
    """ "a, b" -> ("a", "b")."""
    return tuple(part.strip() for part in text.split(",") if part.strip())


def sky_choice(options: cli.SkyOptions) -> SkyChoice:
    from lightsim.skies import SkyChoice

    return SkyChoice(options.sky, options.sky_yaw_deg, options.sky_scale)


def build(command: cli.Build) -> None:
    from lightsim import pipeline
    from lightsim.store.log import LogReading

    reading = LogReading(
        str(command.source.resolve()),
        command.dataset,
        _names(command.cameras),
        command.frames,
        command.heading_deg,
        command.image_scale,
        command.hold_out,
    )
    options = pipeline.BuildOptions(
        reading,
        command.preset,
        command.seed,
        command.neural_steps,
        command.device,
        _names(command.no_refine),
        command.colour,
        command.gps,
    )
    pipeline.build(command.work, options, terminal_progress())
    _say(f"twin:   {command.work / 'twin' / 'twin.json'}")
    _say(f"report: {command.work / 'report' / 'index.html'}")


def relight(command: cli.Relight) -> None:
    from lightsim import scenarios

    options = scenarios.RelightOptions(
        name=command.name,
        sky=sky_choice(command.sky),
        method=command.method,
        exposure_ev=command.exposure_ev,
        cameras=_names(command.cameras),
        frames=command.frames,
        image_scale=command.image_scale,
        is_linear_written=command.linear,
        seed=command.seed,
        is_overwriting=command.overwrite,
        is_stale_allowed=command.allow_stale,
    )
    folder = scenarios.relight(command.work, options, terminal_progress())
    _say(f"frames: {folder / 'frames'}")
    _say(f"video:  {folder / 'video'}")
    _say(f"report: {folder / 'report.html'}")


def render(command: cli.Render) -> None:
    from lightsim import cli_render

    _say(cli_render.run(command))


def demo(command: cli.Demo) -> None:
    from lightsim.demo import run_demo

    _say(f"open: {run_demo(command.out, command.seed, terminal_progress())}")


def status(command: cli.Status) -> None:
    from lightsim import pipeline

    for line in pipeline.status(command.work, is_hashed=command.verify):
        took = "" if line.seconds is None else f"{line.seconds:8.1f} s"
        memory = "" if line.peak_memory_mb is None else f"{line.peak_memory_mb:6d} MB"
        _say(f"{line.name:10s}{line.state:8s}{took:>12s}{memory:>12s}")
        for damage in line.damage:
            _say(f"          {damage}")


def doctor(command: cli.Doctor) -> None:
    from lightsim.doctor import diagnose

    _say(diagnose().to_table())


def synthesize(command: cli.Synthesize) -> None:
    from lightsim.ingest.synthetic import synthesize as make_street

    make_street(command.out, seed=command.seed, size=command.size, progress=terminal_progress())
    _say(f"log:   {command.out / 'log'}")
    _say(f"truth: {command.out / 'truth'}")


def evaluate_frames(command: cli.EvaluateFrames) -> None:
    from lightsim import evaluation

    report = evaluation.held_out_frames(command.work, terminal_progress(), with_field=command.field)
    _show(report, command.out)


def evaluate_relight(command: cli.EvaluateRelight) -> None:
    from lightsim import evaluation

    report = evaluation.relit_frames(command.work, command.truth, terminal_progress())
    _show(report, command.out)


def evaluate_geometry(command: cli.EvaluateGeometry) -> None:
    from lightsim import evaluation

    report, is_held_out = evaluation.geometry(command.work, command.truth, terminal_progress())
    _say("held-out sweeps" if is_held_out else "ALL sweeps, those of the build included")
    _show(report, command.out)


def evaluate_sky(command: cli.EvaluateSky) -> None:
    from lightsim import evaluation

    _show(evaluation.sky(command.work, command.truth), command.out)


def evaluate_base_colour(command: cli.EvaluateBaseColour) -> None:
    from lightsim import evaluation

    report = evaluation.base_colour(command.work, command.truth, terminal_progress())
    _show(report, command.out)


def _show(report: _Report, out: Path | None) -> None:
    _say(report.to_table())
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(report.to_json() + "\n")


def estimate_sky(command: cli.SkyEstimateCommand) -> None:
    from lightsim.lighting.estimate import SkyConfig
    from lightsim.lighting.image_sky import estimate_from_picture, panorama_from_image
    from lightsim.skies import sun_of_command
    from lightsim.sky_networks import edited_sky, predict_sky
    from lightsim.store.images import read_srgb8_alpha
    from lightsim.store.sky import write_sky

    picture, alpha = read_srgb8_alpha(command.panorama)
    sun = sun_of_command(command.time, command.latitude, command.longitude, command.heading_deg)
    try:
        panorama = panorama_from_image(picture, alpha > 127)
        prediction = predict_sky(panorama)
        estimate = estimate_from_picture(panorama, sun, SkyConfig(), prediction)
    except InputError as error:
        raise error.at(command.panorama) from error
    if command.move_sun is not None or command.sun_factor != 1.0:
        estimate = edited_sky(
            estimate, panorama, command.move_sun, command.sun_factor, command.heading_deg
        )
    command.out.mkdir(parents=True, exist_ok=True)
    write_sky(command.out, estimate, "sky.exr")
    _say(f"sky: {command.out / 'sky.exr'}")
    _say(f"sun: {command.out / 'sun.json'}")


def show_sky(command: cli.SkyShow) -> None:
    from lightsim.skies import SkyChoice, sky_alone
    from lightsim.store.images import write_png
    from lightsim.view.figures import dome_preview

    sky = sky_alone(SkyChoice(command.sky))
    for name, value in sky.facts.items():
        _say(f"{name}: {value}")
    write_png(command.out, dome_preview(sky.dome))
    _say(f"picture: {command.out}")
