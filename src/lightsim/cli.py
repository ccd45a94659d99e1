"""The command line: one frozen dataclass per command, one function call each.

Heavy packages are imported inside the calls, so that `lightsim --help` answers at once.
"""

from __future__ import annotations

import logging
import signal
import sys
import threading
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from lightsim.cli_render import Render
from lightsim.cli_train import TrainGroup, TrainOptions, TrainPrepare
from lightsim.errors import LightSimError

Verbose = Annotated[bool, tyro.conf.arg(aliases=["-v"])]
Device = Literal["auto", "cpu", "cuda"]


@dataclass(frozen=True)
class Build:
    """Turn a recorded log into a twin: meshes, base colour and the source sky."""

    source: tyro.conf.Positional[Path]
    """Folder of the recording."""
    work: Path
    """Work folder to make or to go on with."""
    dataset: Literal["auto", "pandaset"] = "auto"
    """Format of the recording."""
    frames: str = ""
    """START:STOP[:STEP] over the log's own frame numbers; empty for all."""
    cameras: str = ""
    """Comma-separated camera names; empty for all."""
    hold_out: int = 0
    """Keep every n-th frame and sweep from the build, for evaluation; 0 keeps none."""
    preset: Literal["draft", "standard", "paper"] = "standard"
    """Quality of the reconstruction."""
    image_scale: float = 0.5
    """Factor on the image size."""
    colour: Literal["texture", "vertex", "field"] | None = None
    """Colour of the meshes: at image resolution, at vertices, or (the paper's) the neural field's
    at vertices; by default the preset's."""
    no_refine: str = ""
    """Comma-separated physics of the log to leave out: rolling_shutter, point_times,
    own_car_masks, lidar_poses, actor_tracks, camera_poses, camera_gains."""
    heading_deg: float | None = None
    """Azimuth of the world x axis, where the log cannot tell it (clockwise from north)."""
    gps: Literal["all", "place", "none"] = "all"
    """What the sun is found with besides the images: place, time and heading; place and time; or
    nothing."""
    device: Device = "auto"
    """Where the neural field is trained; auto takes CUDA where there is one."""
    neural_steps: int | None = None
    """Training steps of the neural field; by default the preset's; 0 keeps the fused LiDAR."""
    seed: int = 0
    """Of all random numbers."""
    verbose: Verbose = False
    """Show the trace of an error."""


@dataclass(frozen=True)
class SkyOptions:
    sky: str = "source"
    """A .hdr or .exr file, sun:AZIMUTH,ELEVATION[,TURBIDITY], time:ISO, or source."""
    sky_yaw_deg: float = 0.0
    """Turn the sky, clockwise seen from above."""
    sky_scale: str = "auto"
    """auto: the mean illuminance of the source; none: radiance as stored; or a number."""


@dataclass(frozen=True)
class Relight:
    """Re-render the log's frames under another sky."""

    work: tyro.conf.Positional[Path]
    """Work folder of a finished build."""
    name: str
    """Name of the result: WORK/scenarios/NAME."""
    sky: tyro.conf.OmitArgPrefixes[SkyOptions]
    method: Literal["physical"] = "physical"
    """How pixels are relit: shading ratios of the reconstructed scene."""
    exposure_ev: float = 0.0
    """Exposure of the output, in stops."""
    cameras: str = ""
    """Comma-separated camera names; empty for all."""
    frames: str = ""
    """START:STOP[:STEP] over the log's own frame numbers; empty for all."""
    image_scale: float | None = None
    """Factor on the log's image size; by default that of the build."""
    linear: bool = False
    """Write linear EXR frames as well."""
    overwrite: bool = False
    """Replace a result of this name that was made with another sky or other settings."""
    allow_stale: bool = False
    """Go on where the recording has changed since the build."""
    seed: int = 0
    """Of the sampling of rays."""
    verbose: Verbose = False
    """Show the trace of an error."""


@dataclass(frozen=True)
class SkyEstimateCommand:
    """Estimate the HDR sky of an equirectangular sRGB panorama (alpha 0 = not observed)."""

    panorama: tyro.conf.Positional[Path]
    """PNG or JPEG, twice as wide as high; the centre column looks along world +x."""
    out: Path
    """Folder for sky.exr and sun.json."""
    time: str | None = None
    """UTC time, ISO 8601."""
    latitude: float | None = None
    """Degrees north."""
    longitude: float | None = None
    """Degrees east."""
    heading_deg: float | None = None
    """Azimuth of the centre column, clockwise from north."""
    move_sun: str | None = None
    """AZIMUTH,ELEVATION in degrees, clockwise from north (from the centre column without
    --heading-deg): the same sky under a sun that stands there."""
    sun_factor: float = 1.0
    """Makes the sun of the same sky weaker or stronger."""
    verbose: Verbose = False
    """Show the trace of an error."""


@dataclass(frozen=True)
class SkyShow:
    """Describe a sky (sun, illuminance) and write a picture of it."""

    sky: tyro.conf.Positional[str]
    """A .hdr or .exr file, or sun:AZIMUTH,ELEVATION[,TURBIDITY] with world +y as north."""
    out: Path = Path("sky.png")
    """Picture to write."""
    verbose: Verbose = False
    """Show the trace of an error."""


@dataclass(frozen=True)
class EvaluateFrames:
    """Held-out images: the twin rendered under its source sky against the camera."""

    work: tyro.conf.Positional[Path]
    """Work folder built with --hold-out."""
    field: bool = False
    """Also volume-render the neural field (seconds a frame)."""
    out: Path | None = None
    """Also write the table as JSON here."""
    verbose: Verbose = False
    """Show the trace of an error."""


@dataclass(frozen=True)
class EvaluateRelight:
    """Relit frames against ground truth, beside the trivial baselines."""

    work: tyro.conf.Positional[Path]
    """Work folder."""
    truth: Path
    """Ground truth of a synthetic log: the folder `truth` that `lightsim synthesize` writes."""
    out: Path | None = None
    """Also write the table as JSON here."""
    verbose: Verbose = False
    """Show the trace of an error."""


@dataclass(frozen=True)
class EvaluateGeometry:
    """LiDAR error of the twin (held-out sweeps where there are any); F-score with a truth."""

    work: tyro.conf.Positional[Path]
    """Work folder."""
    truth: Path | None = None
    """Ground truth of a synthetic log."""
    out: Path | None = None
    """Also write the table as JSON here."""
    verbose: Verbose = False
    """Show the trace of an error."""


@dataclass(frozen=True)
class EvaluateSky:
    """The estimated sky against ephemeris, the visible sun, and a truth if given."""

    work: tyro.conf.Positional[Path]
    """Work folder."""
    truth: Path | None = None
    """Ground truth of a synthetic log."""
    out: Path | None = None
    """Also write the table as JSON here."""
    verbose: Verbose = False
    """Show the trace of an error."""


@dataclass(frozen=True)
class EvaluateBaseColour:
    """Base colour against a synthetic log's truth: error, and how much of the shadows is left."""

    work: tyro.conf.Positional[Path]
    """Work folder."""
    truth: Path
    """Ground truth of a synthetic log."""
    out: Path | None = None
    """Also write the table as JSON here."""
    verbose: Verbose = False
    """Show the trace of an error."""


@dataclass(frozen=True)
class Synthesize:
    """Make a synthetic street log with exact ground truth."""

    out: Path
    """Folder to write: log/ and truth/."""
    seed: int = 0
    """Another seed, another street."""
    size: Literal["small", "medium", "full"] = "small"
    """Image size and number of frames."""
    verbose: Verbose = False
    """Show the trace of an error."""


@dataclass(frozen=True)
class Demo:
    """Build and relight the synthetic street that ships with the package."""

    out: Path = Path("out/demo")
    """Folder to write."""
    seed: int = 0
    """Of all random numbers."""
    verbose: Verbose = False
    """Show the trace of an error."""


@dataclass(frozen=True)
class Doctor:
    """Say what this machine has, what is missing, and what will be slow."""

    verbose: Verbose = False
    """Show the trace of an error."""


@dataclass(frozen=True)
class Status:
    """Show which artefacts of a work folder are made, stale, broken or missing."""

    work: tyro.conf.Positional[Path]
    """Work folder."""
    verify: bool = False
    """Read every file and compare its bytes with what was written, not only its size."""
    verbose: Verbose = False
    """Show the trace of an error."""


def _command(name: str) -> object:
    return tyro.conf.subcommand(name)


Evaluate = (
    Annotated[EvaluateFrames, _command("frames")]
    | Annotated[EvaluateRelight, _command("relight")]
    | Annotated[EvaluateGeometry, _command("geometry")]
    | Annotated[EvaluateSky, _command("sky")]
    | Annotated[EvaluateBaseColour, _command("base-colour")]
)


@dataclass(frozen=True)
class EvaluateGroup:
    """Measure frames, relighting, geometry, the sky or base colour."""

    measure: tyro.conf.OmitSubcommandPrefixes[tyro.conf.OmitArgPrefixes[Evaluate]]


Sky = Annotated[SkyEstimateCommand, _command("estimate")] | Annotated[SkyShow, _command("show")]


@dataclass(frozen=True)
class SkyGroup:
    """Work with skies alone: estimate one from a panorama, or look at one."""

    do: tyro.conf.OmitSubcommandPrefixes[tyro.conf.OmitArgPrefixes[Sky]]


Command = (
    Annotated[Build, _command("build")]
    | Annotated[Relight, _command("relight")]
    | Annotated[Render, _command("render")]
    | Annotated[SkyGroup, _command("sky")]
    | Annotated[EvaluateGroup, _command("evaluate")]
    | Annotated[TrainGroup, _command("train")]
    | Annotated[Synthesize, _command("synthesize")]
    | Annotated[Demo, _command("demo")]
    | Annotated[Doctor, _command("doctor")]
    | Annotated[Status, _command("status")]
)


def run(command: object) -> None:
    """Carry out one parsed command; the heavy imports happen here."""
    if isinstance(command, TrainPrepare | TrainOptions):
        from lightsim.training import commands as training

        training.run(command)
        return
    from lightsim import commands

    action: dict[type, Callable[..., None]] = {
        Build: commands.build,
        Relight: commands.relight,
        Render: commands.render,
        SkyEstimateCommand: commands.estimate_sky,
        SkyShow: commands.show_sky,
        EvaluateFrames: commands.evaluate_frames,
        EvaluateRelight: commands.evaluate_relight,
        EvaluateGeometry: commands.evaluate_geometry,
        EvaluateSky: commands.evaluate_sky,
        EvaluateBaseColour: commands.evaluate_base_colour,
        Synthesize: commands.synthesize,
        Demo: commands.demo,
        Doctor: commands.doctor,
        Status: commands.status,
    }
    action[type(command)](command)


def main(argv: Sequence[str] | None = None) -> None:
    """Entry point. Exit codes: 0 done, 1 our error, 2 wrong usage, 130 interrupted."""
    command = tyro.cli(
        Command,
        prog="lightsim",
        description="An open lighting simulator for driving logs.",
        args=argv,
        config=(tyro.conf.FlagCreatePairsOff,),
    )
    if isinstance(command, EvaluateGroup):
        command = command.measure
    elif isinstance(command, SkyGroup):
        command = command.do
    elif isinstance(command, TrainGroup):
        command = command.what
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    try:
        with _stopped_like_ctrl_c():
            run(command)
    except KeyboardInterrupt:
        sys.stderr.write("lightsim: interrupted; run the same command again to go on\n")
        sys.exit(130)
    except Exception as error:
        if command.verbose:
            raise
        sys.exit(_complain(error))


@contextmanager
def _stopped_like_ctrl_c() -> Generator[None]:
    """SIGTERM, by which schedulers stop a job, ends a command as cleanly as Ctrl-C."""
    if threading.current_thread() is not threading.main_thread():
        yield  # Only the main thread may handle signals.
        return
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _complain(error: Exception) -> int:
    """One line: ours as it is, the system's by its name, and a request for a report of what
    should not happen."""
    kind = f"{type(error).__name__}: {error}"
    if isinstance(error, LightSimError):
        message = f"{error}"
    elif isinstance(error, OSError):
        message = f"{kind}. Use -v for the trace."
    elif isinstance(error, MemoryError):
        message = "the memory does not suffice. Try a smaller --image-scale or fewer --frames."
    else:
        message = f"this is a fault of LightSim: {kind}. Please report it with the trace of -v."
    sys.stderr.write(f"lightsim: error: {' '.join(message.split())}\n")
    return 1
