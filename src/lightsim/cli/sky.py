"""`lightsim sky`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro

from lightsim.cli.options import CommandGroup, Verbose, print_line
from lightsim.core.checks import check_number
from lightsim.core.sky_choice import SkyChoice
from lightsim.errors import InputError

if TYPE_CHECKING:
    from lightsim.lighting.sun.direction import SunDirection


@dataclass(frozen=True)
class SkyEstimateCommand:
    """Estimate the HDR sky of an equirectangular sRGB panorama (alpha 0 = not observed)."""

    panorama: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="PANORAMA")]]
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
    move_sun: str = ""
    """AZIMUTH,ELEVATION in degrees, clockwise from north (from the centre column without
    --heading-deg): move the sun there; the rest of the sky is unchanged."""
    sun_factor: float = 1.0
    """Factor on the sun's irradiance; 0 removes the sun."""
    weights: Path | None = None
    """Weights of the sky network, in LightSim's form or in the published one, as lightsim train sky
    writes them; by default those of the package."""
    verbose: Verbose = False

    def run(self) -> None:
        """Estimate the sky of a panorama and write sky.exr and sun.json."""
        from lightsim.lighting.sky.estimate import SkyConfig
        from lightsim.lighting.sky.image_sky import (
            edited_sky,
            estimate_from_picture,
            panorama_from_image,
        )
        from lightsim.lighting.sky.predict import predict_sky
        from lightsim.lighting.weights import LightingWeights
        from lightsim.simulation.skies import parse_sky
        from lightsim.store.images import read_srgb8_alpha
        from lightsim.store.sky import write_sky

        weights = LightingWeights() if self.weights is None else LightingWeights(self.weights)
        weights.check()
        if self.panorama.suffix.lower() in (".hdr", ".exr"):
            raise InputError(
                "the file is an HDR sky already",
                where=self.panorama,
                expected="an sRGB panorama, PNG or JPEG",
                remedy="Give it to lightsim sky show, or to --sky of relight.",
            )
        edit = SkyChoice("source", move_sun=self.move_sun, sun_factor=self.sun_factor)
        picture, alpha = read_srgb8_alpha(self.panorama)
        sun = sun_of_command(self.time, self.latitude, self.longitude, self.heading_deg)
        try:
            # Alpha marks observed pixels; partly transparent pixels count by majority.
            panorama = panorama_from_image(picture, alpha > 127)
            prediction = predict_sky(panorama, weights)
            estimate = estimate_from_picture(panorama, sun, SkyConfig(), prediction)
        except InputError as error:
            raise error.at(self.panorama) from error
        # The estimate is edited after it is complete: the edit is not evidence about the sky.
        if edit.has_edited_sun:
            position = parse_sky(edit).moved_sun
            estimate = edited_sky(estimate, position, self.sun_factor, self.heading_deg)
        self.out.mkdir(parents=True, exist_ok=True)
        write_sky(self.out, estimate, self.heading_deg, "sky.exr")
        print_line(f"sky: {self.out / 'sky.exr'}")
        print_line(f"sun: {self.out / 'sun.json'}")


@dataclass(frozen=True)
class SkyShow:
    """Describe a sky (sun, illuminance) and write a picture of it."""

    sky: tyro.conf.Positional[Annotated[str, tyro.conf.arg(metavar="SKY")]]
    """A .hdr or .exr file, FILE.exr#LAYER, or sun:AZIMUTH,ELEVATION[,TURBIDITY] with world +y as
    north."""
    out: Path = Path("sky.png")
    """PNG file to write."""
    verbose: Verbose = False

    def run(self) -> None:
        """Print a description of a sky and write a picture of it."""
        from lightsim.simulation.skies import sky_without_log
        from lightsim.simulation.sky_description import describe_sky
        from lightsim.store.images import write_png
        from lightsim.view.figures import dome_preview

        if self.out.suffix.lower() != ".png":
            raise InputError(
                "the picture is written as PNG", where=f"--out {self.out}", expected="NAME.png"
            )
        sky = sky_without_log(SkyChoice(self.sky))
        for line in describe_sky(sky):
            print_line(line)
        self.out.parent.mkdir(parents=True, exist_ok=True)
        write_png(self.out, dome_preview(sky.dome))
        print_line(f"picture: {self.out}")


def sun_of_command(
    time: str | None,
    latitude_deg: float | None,
    longitude_deg: float | None,
    heading_deg: float | None,
) -> SunDirection | None:
    """Return the sun at a place and time for a heading (azimuth of world +x, degrees), or None if
    no option is given.

    Raises:
        InputError: only some of the options are given, or the time is not ISO 8601.
    """
    from lightsim.core.frames import RigidTransform
    from lightsim.core.log import Clock, GeoReference, Place
    from lightsim.lighting.sun.direction import sun_from_geo
    from lightsim.simulation.skies import parse_time

    given = (time, latitude_deg, longitude_deg, heading_deg)
    if all(value is None for value in given):
        return None
    if time is None or latitude_deg is None or longitude_deg is None or heading_deg is None:
        raise InputError(
            "the sun needs all of --time, --latitude, --longitude and --heading-deg",
            remedy="Give all four, or none to find the sun in the picture.",
        )
    check_number("--latitude", latitude_deg, -90.0, 90.0)
    check_number("--longitude", longitude_deg, -180.0, 180.0)
    check_number("--heading-deg", heading_deg, -360.0, 360.0)
    time_ns = parse_time(f"time:{time}")
    # Azimuths are clockwise from north, yaw is counter-clockwise from east.
    yaw_rad = np.radians(90.0 - heading_deg)
    enu_from_world = RigidTransform.from_yaw("enu", "world", float(yaw_rad), np.zeros(3))
    place = Place(latitude_deg, longitude_deg, "given")
    geo = GeoReference(place, Clock(), enu_from_world, "given", None)
    return sun_from_geo(geo, time_ns)


Sky = (
    Annotated[SkyEstimateCommand, tyro.conf.subcommand("estimate")]
    | Annotated[SkyShow, tyro.conf.subcommand("show")]
)


@dataclass(frozen=True)
class SkyGroup(CommandGroup):
    """Skies without a log: estimate one from a panorama, or describe one."""

    do: tyro.conf.OmitSubcommandPrefixes[tyro.conf.OmitArgPrefixes[Sky]]
