"""`lightsim sky`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from lightsim.cli.options import Verbose, say
from lightsim.core.sky_choice import SkyChoice
from lightsim.errors import InputError


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
    move_sun: str = ""
    """AZIMUTH,ELEVATION in degrees, clockwise from north (from the centre column without
    --heading-deg): the same sky under a sun that stands there."""
    sun_factor: float = 1.0
    """Factor on the sun's irradiance; 0 takes it out."""
    verbose: Verbose = False
    """Show the trace of an error."""

    def run(self) -> None:
        """Estimate the sky of a panorama."""
        from lightsim.lighting.sky.estimate import SkyConfig
        from lightsim.lighting.sky.image_sky import (
            edited_sky,
            estimate_from_picture,
            panorama_from_image,
        )
        from lightsim.lighting.sky.shipped import predict_sky
        from lightsim.simulation.skies import sun_of_command
        from lightsim.store.images import read_srgb8_alpha
        from lightsim.store.sky import write_sky

        edit = SkyChoice("source", move_sun=self.move_sun, sun_factor=self.sun_factor)
        picture, alpha = read_srgb8_alpha(self.panorama)
        sun = sun_of_command(self.time, self.latitude, self.longitude, self.heading_deg)
        try:
            panorama = panorama_from_image(picture, alpha > 127)
            prediction = predict_sky(panorama)
            estimate = estimate_from_picture(panorama, sun, SkyConfig(), prediction)
        except InputError as error:
            raise error.at(self.panorama) from error
        if edit.has_edited_sun:
            estimate = edited_sky(estimate, edit, self.heading_deg)
        self.out.mkdir(parents=True, exist_ok=True)
        write_sky(self.out, estimate, self.heading_deg, "sky.exr")
        say(f"sky: {self.out / 'sky.exr'}")
        say(f"sun: {self.out / 'sun.json'}")


@dataclass(frozen=True)
class SkyShow:
    """Describe a sky (sun, illuminance) and write a picture of it."""

    sky: tyro.conf.Positional[str]
    """A .hdr or .exr file, FILE.exr#LAYER, or sun:AZIMUTH,ELEVATION[,TURBIDITY] with world +y as
    north."""
    out: Path = Path("sky.png")
    """Picture to write."""
    verbose: Verbose = False
    """Show the trace of an error."""

    def run(self) -> None:
        """Describe a sky."""
        from lightsim.simulation.skies import sky_alone
        from lightsim.simulation.sky_description import describe_sky
        from lightsim.store.images import write_png
        from lightsim.view.figures import dome_preview

        choice = SkyChoice(self.sky)
        sky = sky_alone(choice)
        for line in describe_sky(choice, sky):
            say(line)
        write_png(self.out, dome_preview(sky.dome))
        say(f"picture: {self.out}")


Sky = (
    Annotated[SkyEstimateCommand, tyro.conf.subcommand("estimate")]
    | Annotated[SkyShow, tyro.conf.subcommand("show")]
)


@dataclass(frozen=True)
class SkyGroup:
    """Work with skies alone: estimate one from a panorama, or look at one."""

    do: tyro.conf.OmitSubcommandPrefixes[tyro.conf.OmitArgPrefixes[Sky]]

    def run(self) -> None:
        """Run the chosen command."""
        self.do.run()
