"""Command `lightsim synthesize`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from lightsim.cli.options import Verbose, print_line
from lightsim.errors import InputError
from lightsim.progress import terminal_progress


@dataclass(frozen=True)
class Synthesize:
    """Make a synthetic street log with exact ground truth."""

    out: Path
    """Folder for log/ and truth/."""
    seed: int = 0
    """Seed of the street."""
    style: Literal["city", "suburban", "boulevard", "industrial"] = "city"
    """Kind of street: terraced houses; detached houses with gardens; a wide road with trees and
    trams; halls and yards with lorries."""
    size: Literal["small", "medium", "full", "benchmark"] = "small"
    """Image size and number of frames."""
    denoise: bool = False
    """Remove the sampling noise of few light paths (pip install 'lightsim[denoise]')."""
    paths: int | None = None
    """Light paths per pixel; by default 24 for the log and 64 for the truth (full: 32 and 64;
    benchmark: 16)."""
    more_skies: bool = False
    """Make true pictures under three skies in addition to the usual three."""
    drawn_suns: int = 0
    """Number of additional skies with random suns, for training."""
    sky: tuple[Path, ...] = ()
    """HDR panoramas as additional skies, with random azimuth and intensity."""
    edits: bool = False
    """Also make true pictures with actors removed, inserted and moved, and from a shifted ego path:
    OUT/truth/edits."""
    renderer: Literal["mitsuba", "cycles"] = "mitsuba"
    """Path tracer of the pictures. cycles: Blender's, with other materials, exposure, tone curve
    and noise, for tests on pictures of another generator."""
    blender_python: Path | None = None
    """Python 3.11 interpreter that has bpy 4.5, for --renderer cycles."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Device of Mitsuba. Sampling noise differs between devices, so pictures are equal only up to
    noise."""
    sway: float = 0.0
    """Pitch, roll and heave of the ego vehicle: 0 none, 1 as on an uneven city street."""
    fast_traffic: bool = False
    """Oncoming traffic is a dense column at 15 to 18 m/s; not with --edits."""
    standing: Literal["stand", "start", "stop"] | None = None
    """The ego vehicle waits at a junction with cross traffic, and cameras and LiDAR see its bonnet
    and boot. stand: it creeps 0.2 m in all; start: it starts in the second half; stop: it stops and
    stands in the middle third. Not with --edits or --fast-traffic."""
    verbose: Verbose = False
    """Show the stack trace of an error."""

    def run(self) -> None:
        """Make the street."""
        from lightsim_lab.synthetic import synthesize as make_street
        from lightsim_lab.synthetic import synthesize_edits
        from lightsim_lab.synthetic.generate import Variation
        from lightsim_lab.synthetic.renderers import StreetRenderer
        from lightsim_lab.synthetic.skies import FurtherSkies

        traffic = {
            "--edits": self.edits,
            "--fast-traffic": self.fast_traffic,
            "--standing": self.standing is not None,
        }
        given = [name for name, is_given in traffic.items() if is_given]
        if len(given) > 1:
            raise InputError(
                f"{' and '.join(given)} exclude each other",
                expected="one of them: edits are defined for the usual traffic",
                remedy="Leave out all but one of the options.",
            )
        if self.standing is not None and self.style != "city":
            raise InputError(
                "--standing is available in the style city only",
                got=f"--style {self.style}",
                remedy="Leave --style or --standing out.",
            )
        renderer = StreetRenderer(self.renderer, self.device, self.blender_python)
        progress = terminal_progress()
        make_street(
            self.out,
            seed=self.seed,
            size=self.size,
            progress=progress,
            is_denoised=self.denoise,
            variation=Variation(
                self.paths, self.sway, self.fast_traffic, self.style, self.standing
            ),
            further=FurtherSkies(self.more_skies, self.drawn_suns, self.sky),
            renderer=renderer,
        )
        if self.edits:
            synthesize_edits(
                self.out,
                seed=self.seed,
                size=self.size,
                progress=progress,
                is_denoised=self.denoise,
                renderer=renderer,
                style=self.style,
            )
        print_line(f"log:   {self.out / 'log'}")
        print_line(f"truth: {self.out / 'truth'}")
