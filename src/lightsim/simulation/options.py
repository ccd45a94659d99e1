"""What relighting and rendering are asked for, as a user gives it."""

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
from lightsim.simulation.shard import Shard
from lightsim.store.mp4 import DEFAULT_CODEC, Codec
from lightsim.store.names import is_harmless

_LONGEST_EXPOSURE_MS = 100.0
"""From frame to frame at 10 Hz."""
GEOMETRY = ("depth", "position", "normal", "albedo", "actor", "ao")
"""Buffers that are the same under every sky: written once."""
LIGHT = ("shaded", "unshadowed", "shadow", "image")
"""Buffers of each sky."""
ImageSource = Literal["pictures", "twin"]


@dataclass(frozen=True, kw_only=True)
class FrameOptions:
    """Which frames of a twin, and under which skies."""

    sky: tuple[str, ...] = ("source",)
    """One or more of: a .hdr or .exr file, FILE.exr#LAYER (docs/reference/sky-files.md),
    sun:AZIMUTH,ELEVATION[,TURBIDITY], time:ISO, source. Each frame is traced once for all."""
    sky_yaw_deg: float = 0.0
    """Turn the skies, clockwise seen from above."""
    sky_scale: str = "auto"
    """auto: the mean illuminance of the source; none: radiance as stored; or a number."""
    move_sun: str = ""
    """AZIMUTH,ELEVATION: put the sun of each sky there, clockwise from true north; the rest of the
    sky stays."""
    sun_factor: float = 1.0
    """Factor on the irradiance of each sky's sun; 0 takes it out."""
    cameras: Names = ()
    """Comma-separated camera names; empty for all."""
    frames: str = ""
    """START:STOP[:STEP] over the log's own frame numbers; empty for all."""
    image_scale: float | None = None
    """Factor on the log's image size; by default that of the build."""
    ego_offset_m: str = ""
    """AHEAD,LEFT,UP: all cameras stand this many metres from where they stood."""
    allow_stale: bool = False
    """Go on where the recording has changed since the build."""
    seed: int = 0
    """Of the sampling of rays."""
    reserved_names: ClassVar[tuple[str, ...]] = ()
    """Folders that no sky can have."""

    def __post_init__(self) -> None:
        if self.image_scale is not None:
            check_image_scale(self.image_scale)
        check_seed(self.seed)
        _ = self.ego_offset
        if not self.sky:
            raise InputError("no sky is named", where="--sky", expected="one or more")
        _ = self.sky_by_name

    @property
    def ego_offset(self) -> tuple[float, float, float] | None:
        """Ahead, left and up by which the ego vehicle's path differs from the recorded one.

        Raises:
            InputError: it cannot be read, or is out of the world.
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
        """The skies by the names of their folders.

        Raises:
            InputError: two skies have one name, or a name is that of a buffer.
        """
        from lightsim.simulation.skies import parse_sky

        named: dict[str, SkyChoice] = {}
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
                    got=f"the name {name}, which {taken[name.casefold()]} has",
                    remedy="Give each sky once; rename or link one of two files of one name.",
                )
            taken[name.casefold()] = words
            named[name] = choice
        return named


@dataclass(frozen=True, kw_only=True)
class RelightOptions(FrameOptions):
    """What `lightsim relight` is asked for."""

    name: str
    """Name of the result: WORK/scenarios/NAME, or WORK/scenarios/NAME/<sky> with several skies."""
    method: str = "network"
    """Relighting method: network (shading ratios of the twin, corrected by a network), physical
    (the ratios alone), paper (the paper's network); with the laboratory installed also
    colour-transfer, self-osr, epe and nerf-osr."""
    weights: Path | None = None
    """Of the network that --method names, as lightsim train relight wrote them; by default the
    package's (nerf-osr: the work folder's)."""
    renderer: LightChoice = field(default_factory=LightChoice)
    """Who renders the light of source and target that relighting reads."""
    source_sky: Path | None = None
    """.hdr or .exr file of the light under which the log was recorded, where it is known, in scene
    units; by default the estimate of the build. Base colours stay those of the build."""
    exposure_ev: float = 0.0
    """Exposure of the output, in stops."""
    glare: float = 0.0
    """Fraction of the sunlight on the lens that it scatters over the picture: .01 to .03 for most
    lenses. The source sun's is taken out, the target's put in."""
    linear: bool = False
    """Write linear EXR frames as well."""
    expected_error: bool = False
    """Write how far off every pixel is expected to be, too (--method network): error/, grey PNGs in
    codes of the pictures, 8 bits."""
    video_codec: Codec = DEFAULT_CODEC
    """Codec of the videos, in .mp4 files. vp9: its encoder is under the BSD licence, and current
    browsers play it. h264: for players without VP9; its encoder x264 is under the GPL (NOTICE)."""
    labels: bool = False
    """Write masks, depth and visibility of the actors beside every frame, which takes room."""
    overwrite: bool = False
    """Replace a result of this name that was made with another sky or other settings. What these
    very settings and this LightSim have made is kept."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_name()
        check_method(self.method)
        check_choice("--video-codec", self.video_codec, get_args(Codec))
        if self.weights is not None and not find_method(self.method).has_weights:
            raise InputError(
                "this method has no weights",
                where="--weights",
                got=f"--method {self.method}",
                expected="a method with a network, such as --method network",
            )
        check_number("--glare", self.glare, 0.0, 1.0)
        if self.expected_error and self.method != "network":
            raise InputError(
                "this method does not tell how far off it is",
                where="--expected-error",
                got=f"--method {self.method}",
                expected="--method network",
            )
        check_number("--exposure-ev", self.exposure_ev, -MAX_EXPOSURE_EV, MAX_EXPOSURE_EV)

    def _check_name(self) -> None:
        if not is_harmless(self.name):
            raise InputError(
                "the name is not fit for a folder",
                where="--name",
                got=repr(self.name[:40]),
                expected="letters, digits and . _ -, a letter or digit first",
            )


@dataclass(frozen=True, kw_only=True)
class SimulateOptions(RelightOptions):
    """What `lightsim simulate` is asked for; name and sky are SCENARIO.json's where none is given
    here."""

    name: str = ""
    """Name of the result: WORK/scenarios/NAME; by default the one in SCENARIO.json."""
    sky: tuple[str, ...] = ()
    """Skies instead of the one in SCENARIO.json; each frame is traced once for all of them."""
    strict: bool = False
    """Refuse a scenario in which actors overlap or stand in walls or off the ground, instead of
    saying so."""
    library: Path | None = None
    """Folder of the asset library; by default the user's own."""
    write_log: Path | None = None
    """Write the simulated log in PandaSet's own layout to this folder, with LiDAR; of several
    skies to a folder in it for each."""
    exposure_time_ms: float = 1.0
    """How long shutters are open: blurs inserted and moved actors along their motion in the
    picture. No log tells it; by the edges of log 002 it is 1 to 2 ms at most."""

    def __post_init__(self) -> None:
        check_number("--exposure-time-ms", self.exposure_time_ms, 0.0, _LONGEST_EXPOSURE_MS)
        # What is not given yet is checked when `completed` gives it.
        if self.name and self.sky:
            super().__post_init__()

    def completed(self, name: str, sky: SkyChoice) -> SimulateOptions:
        """With the name and the sky of SCENARIO.json, where none was given.

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
        plain = {key: getattr(SimulateOptions, key) for key in of_file}
        given = {key: getattr(self, key) for key in of_file if getattr(self, key) != plain[key]}
        return replace(self, name=self.name or name, sky=(sky.sky,), **(of_file | given))


@dataclass(frozen=True, kw_only=True)
class RenderOptions(FrameOptions):
    """What `lightsim render` is asked for."""

    what: Names
    """Comma-separated: depth position normal albedo ao actor shaded unshadowed shadow image."""
    shard: str = ""
    """I/N, I from 1 to N: render the I-th of N parts of the frames; parts may share DIR."""
    image_from: ImageSource = "pictures"
    """Where `image` is from: the log's pictures, projected through the twin where the camera stood
    elsewhere or the frame was held out, relit as any frame, and the twin where none of them shows
    anything; or the twin alone."""
    renderer: RendererChoice = field(default_factory=RendererChoice)
    """How light is computed."""
    reserved_names: ClassVar[tuple[str, ...]] = (*GEOMETRY, *LIGHT)

    def __post_init__(self) -> None:
        super().__post_init__()
        Shard.parse(self.shard)
        unknown = set(self.what) - {*GEOMETRY, *LIGHT}
        if unknown or not self.what:
            raise InputError(
                "unknown buffers" if unknown else "no buffers are named",
                where="--what",
                got=", ".join(sorted(unknown)) or None,
                expected=f"some of {', '.join((*GEOMETRY, *LIGHT))}",
            )
        check_choice("--image-from", self.image_from, get_args(ImageSource))
        if self.has_pictures and self.renderer.denoise:
            raise InputError(
                "denoising is for rendered images",
                where="--denoise",
                got="--image-from pictures",
                expected="--image-from twin",
            )

    @property
    def has_pictures(self) -> bool:
        """Whether the log's own pictures are looked at."""
        return "image" in self.what and self.image_from == "pictures"

    @property
    def needs_light(self) -> bool:
        """Whether a buffer depends on the sky."""
        return bool(set(self.what) & set(LIGHT))
