"""Options of `lightsim relight`, `simulate` and `render`, with their checks."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar, Literal, get_args

from lightsim.core.checks import (
    MAX_EXPOSURE_EV,
    check_choice,
    check_image_scale,
    check_number,
    check_seed,
)
from lightsim.core.option_types import Names
from lightsim.core.sky_choice import SkyChoice
from lightsim.errors import InputError
from lightsim.relighting.methods import check_method, find_method
from lightsim.render.options import LightChoice, RendererChoice
from lightsim.scenario.edits import FARTHEST_M
from lightsim.store.mp4 import DEFAULT_CODEC, Codec
from lightsim.store.names import is_harmless

# Longest exposure in milliseconds: the interval between frames at 10 Hz.
_LONGEST_EXPOSURE_MS = 100.0
# Buffers that do not depend on the sky; they are written once.
GEOMETRY = ("depth", "position", "normal", "albedo", "actor", "ao")
# Buffers of each sky.
LIGHT = ("shaded", "unshadowed", "shadow", "image")
ImageSource = Literal["pictures", "twin"]
ExportFormat = Literal["lightsim", "pandaset", "nuscenes", "kitti", "coco"]


@dataclass(frozen=True, kw_only=True)
class FrameOptions:
    """Selection of frames of a twin, and of skies."""

    sky: tuple[str, ...] = ("source",)
    """One or more of: a .hdr or .exr file, FILE.exr#LAYER (docs/reference/sky-files.md),
    sun:AZIMUTH,ELEVATION[,TURBIDITY], time:ISO, source. Each frame is traced once for all."""
    sky_yaw_deg: float = 0.0
    """Rotation of the skies in degrees, clockwise when viewed from above."""
    sky_scale: str = "auto"
    """auto: as bright on average, in the recorded views, as the source sky; none: radiance as
    stored; or a factor."""
    move_sun: str = ""
    """AZIMUTH,ELEVATION in degrees: move the sun of each sky there, clockwise from true north; the
    rest of the sky is unchanged."""
    sun_factor: float = 1.0
    """Factor on the irradiance of each sky's sun; 0 removes the sun."""
    cameras: Names = ()
    """Comma-separated camera names; empty for all."""
    frames: str = ""
    """START:STOP[:STEP] over the frame stems of the log; empty for all."""
    image_scale: float | None = None
    """Factor on the log's image size; by default that of the build."""
    ego_offset_m: str = ""
    """AHEAD,LEFT,UP: offset of all cameras from their recorded positions, in metres."""
    allow_stale: bool = False
    """Continue although the recording has changed since the build."""
    seed: int = 0
    """Seed of the ray directions."""
    reserved_names: ClassVar[tuple[str, ...]] = ()
    """Names that the folder of a sky must not have."""

    def __post_init__(self) -> None:
        if self.image_scale is not None:
            check_image_scale(self.image_scale)
        check_seed(self.seed)
        _ = self.ego_offset
        if not self.sky:
            raise InputError("no sky is given", where="--sky", expected="one or more")
        _ = self.sky_by_name

    @property
    def ego_offset(self) -> tuple[float, float, float] | None:
        """Offset (ahead, left, up) of the ego vehicle's path from the recorded one, in metres.

        Raises:
            InputError: it is malformed or out of range.
        """
        if not self.ego_offset_m:
            return None
        where = "--ego-offset-m"
        try:
            ahead, left, up = map(float, self.ego_offset_m.split(","))
        except ValueError as error:
            raise InputError(
                "the offset cannot be read",
                where=where,
                got=self.ego_offset_m,
                expected="AHEAD,LEFT,UP in metres",
            ) from error
        for metres in (ahead, left, up):
            check_number(where, metres, -FARTHEST_M, FARTHEST_M)
        return ahead, left, up

    @property
    def sky_by_name(self) -> dict[str, SkyChoice]:
        """Skies by the names of their folders.

        Raises:
            InputError: a sky is malformed, two skies have the same name, or a name is reserved for
                a buffer.
        """
        # Imported here: the resolver needs the renderer, and `lightsim --help` must stay fast.
        from lightsim.simulation.skies import parse_sky

        # Two skies of one name would overwrite each other's files.
        named: dict[str, SkyChoice] = {}
        # Names are compared without case: some file systems do not distinguish it.
        taken = {what: f"the buffer {what}" for what in self.reserved_names}
        for words in self.sky:
            choice = SkyChoice(
                words, self.sky_yaw_deg, self.sky_scale, self.move_sun, self.sun_factor
            )
            name = parse_sky(choice).name
            if name.casefold() in taken:
                raise InputError(
                    "two skies would be written to one folder",
                    where=f"--sky {words}",
                    got=f"the name {name}, which is also that of {taken[name.casefold()]}",
                    remedy="Give each sky once; rename or link one of two files of one name.",
                )
            taken[name.casefold()] = words
            named[name] = choice
        return named


@dataclass(frozen=True, kw_only=True)
class RelightOptions(FrameOptions):
    """Options of `lightsim relight`."""

    name: str
    """Name of the result: WORK/scenarios/NAME, or WORK/scenarios/NAME/<sky> with several skies."""
    method: str = "network"
    """Relighting method: network (shading ratios of the twin, corrected by a network), physical
    (the ratios alone), paper (the paper's network); with the laboratory installed also
    colour-transfer, self-osr, epe and nerf-osr."""
    weights: Path | None = None
    """Weights file of the network that --method names, as lightsim train relight writes it; by
    default the package's (nerf-osr: the work folder's)."""
    renderer: LightChoice = field(default_factory=LightChoice)
    """Renderer of the source and target light that relighting uses."""
    source_sky: Path | None = None
    """.hdr or .exr file of the light under which the log was recorded, if it is known, in scene
    units; by default the estimate of the build. Base colours remain those of the build."""
    exposure_ev: float = 0.0
    """Exposure of the output, in stops (EV)."""
    glare: float = 0.0
    """Fraction of the sunlight on the lens that is scattered over the picture: .01 to .03 for most
    lenses. The glare of the source sun is removed, that of the target sun is added."""
    linear: bool = False
    """Write linear EXR frames as well."""
    expected_error: bool = False
    """Also write the expected absolute error of every pixel (--method network): error/, grey 8-bit
    PNGs in units of the pictures' codes."""
    video_codec: Codec = DEFAULT_CODEC
    """Codec of the videos, in .mp4 files. vp9: encoder under the BSD licence, plays in current
    browsers. h264: for players without VP9; its encoder x264 is under the GPL (NOTICE)."""
    labels: bool = False
    """Write masks, depth and visibility of the actors beside every frame; they use disk space."""
    jobs: int = 1
    """Number of frames that are made at the same time, by threads that share the twin. The pictures
    do not depend on it; each further frame takes up to 1 GB of memory."""
    overwrite: bool = False
    """Replace a result of this name that was made with another sky or other settings. A result of
    the same settings and the same LightSim is not made again."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_name()
        check_method(self.method)
        check_choice("--video-codec", self.video_codec, get_args(Codec))
        # Ignored weights would suggest a result that they did not determine.
        if self.weights is not None and not find_method(self.method).has_weights:
            raise InputError(
                "this method has no weights",
                where="--weights",
                got=f"--method {self.method}",
                expected="a method with a network, such as --method network",
            )
        check_number("--glare", self.glare, 0.0, 1.0)
        check_number("--jobs", self.jobs, 1, 1024)
        if self.jobs > 1 and self.renderer.renderer != "transport":
            raise InputError(
                "this renderer makes one frame at a time",
                where=f"--jobs {self.jobs}",
                got=f"--renderer {self.renderer.renderer}",
                expected="--jobs 1, or --renderer transport",
            )
        if self.expected_error and self.method != "network":
            raise InputError(
                "this method does not estimate its error",
                where="--expected-error",
                got=f"--method {self.method}",
                expected="--method network",
            )
        check_number("--exposure-ev", self.exposure_ev, -MAX_EXPOSURE_EV, MAX_EXPOSURE_EV)

    def _check_name(self) -> None:
        if not is_harmless(self.name):
            raise InputError(
                "the name is not a valid folder name",
                where="--name",
                got=repr(self.name[:40]),
                expected="letters, digits and . _ -, a letter or digit first",
            )


@dataclass(frozen=True, kw_only=True)
class SimulateOptions(RelightOptions):
    """Options of `lightsim simulate`; name and sky default to those of SCENARIO.json."""

    name: str = ""
    """Name of the result: WORK/scenarios/NAME; by default the name in SCENARIO.json."""
    sky: tuple[str, ...] = ()
    """Skies instead of the sky in SCENARIO.json; each frame is traced once for all of them."""
    strict: bool = False
    """Reject a scenario in which actors overlap, intersect walls or are off the ground, instead of
    a warning."""
    library: Path | None = None
    """Folder of the asset library; by default ~/.local/share/lightsim/assets."""
    write_log: Path | None = None
    """Write the simulated log in PandaSet's layout to this folder, with LiDAR; with several
    skies, to one sub-folder per sky."""
    exposure_time_ms: float = 1.0
    """Exposure time in milliseconds: blurs inserted and moved actors along their motion in the
    picture. Logs do not record it; the edges of log 002 indicate 1 to 2 ms at most."""

    def __post_init__(self) -> None:
        check_number("--exposure-time-ms", self.exposure_time_ms, 0.0, _LONGEST_EXPOSURE_MS)
        # A missing name or sky is checked when `completed` adds it.
        if self.name and self.sky:
            super().__post_init__()

    def completed(self, name: str, sky: SkyChoice) -> SimulateOptions:
        """Return the options with the name and the sky of SCENARIO.json where none is given.

        Raises:
            InputError: an option is out of range.
        """
        if self.sky:
            return replace(self, name=self.name or name)
        of_file = {
            "sky_yaw_deg": sky.yaw_deg,
            "sky_scale": sky.scale,
            "move_sun": sky.move_sun,
            "sun_factor": sky.sun_factor,
        }
        # An option of the command line that differs from its default overrides the file.
        plain = {key: getattr(SimulateOptions, key) for key in of_file}
        given = {key: getattr(self, key) for key in of_file if getattr(self, key) != plain[key]}
        return replace(self, name=self.name or name, sky=(sky.sky,), **(of_file | given))


@dataclass(frozen=True, kw_only=True)
class RenderOptions(FrameOptions):
    """Options of `lightsim render`."""

    what: Names
    """Comma-separated: depth position normal albedo ao actor shaded unshadowed shadow image."""
    image_from: ImageSource = "pictures"
    """Source of `image`. pictures: the log's pictures, relit as in lightsim relight; for moved
    cameras and held-out frames they are projected through the twin, which fills what they do not
    show. twin: the rendered twin alone."""
    renderer: RendererChoice = field(default_factory=RendererChoice)
    """Renderer of the light buffers."""
    reserved_names: ClassVar[tuple[str, ...]] = (*GEOMETRY, *LIGHT)

    def __post_init__(self) -> None:
        super().__post_init__()
        unknown = set(self.what) - {*GEOMETRY, *LIGHT}
        if unknown or not self.what:
            raise InputError(
                "unknown buffers" if unknown else "no buffers are given",
                where="--what",
                got=", ".join(sorted(unknown)) or None,
                expected=f"some of {', '.join((*GEOMETRY, *LIGHT))}",
            )
        check_choice("--image-from", self.image_from, get_args(ImageSource))
        # Pictures have the camera's noise; the denoiser is for the noise of rendering.
        if self.has_pictures and self.renderer.denoise:
            raise InputError(
                "denoising is for rendered images",
                where="--denoise",
                got="--image-from pictures",
                expected="--image-from twin",
            )

    @property
    def has_pictures(self) -> bool:
        """True if `image` is made from the log's pictures."""
        return "image" in self.what and self.image_from == "pictures"

    @property
    def needs_light(self) -> bool:
        """True if a selected buffer depends on the sky."""
        return bool(set(self.what) & set(LIGHT))


@dataclass(frozen=True, kw_only=True)
class ExportOptions:
    """Options of `lightsim export`."""

    format: ExportFormat = "lightsim"
    """lightsim: the folder that docs/reference/lightsim-log.md describes; of scenarios also
    nuscenes, kitti, coco and, for recordings of PandaSet, pandaset."""
    camera: str = ""
    """kitti: name of the camera; by default the one that looks ahead."""
    library: Path | None = None
    """Folder of the asset library with which the scenario was made; by default
    ~/.local/share/lightsim/assets."""
    allow_stale: bool = False
    """Continue although the recording has changed since the build."""

    def __post_init__(self) -> None:
        check_choice("--format", self.format, get_args(ExportFormat))
        if self.camera and self.format != "kitti":
            raise InputError(
                "only exports for KITTI have one camera",
                where="--camera",
                got=f"--format {self.format}",
                expected="--format kitti",
            )
