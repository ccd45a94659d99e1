"""`lightsim synthesize`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from lightsim.cli.options import Verbose, say
from lightsim.progress import terminal_progress


@dataclass(frozen=True)
class Synthesize:
    """Make a synthetic street log with exact ground truth."""

    out: Path
    """Folder to write: log/ and truth/."""
    seed: int = 0
    """Another seed, another street."""
    size: Literal["small", "medium", "full", "benchmark"] = "small"
    """Image size and number of frames."""
    denoise: bool = False
    """Pictures without the grain of few light paths, as a good camera takes them
    (pip install 'lightsim[denoise]')."""
    paths: int | None = None
    """Light paths a pixel; by default 24 of the log and 64 of the truth (full: 32 and 64;
    benchmark: 16)."""
    more_skies: bool = False
    """True pictures under three more skies than the usual three."""
    drawn_suns: int = 0
    """True pictures under so many skies whose suns stand anywhere, too: to learn from."""
    sky: tuple[Path, ...] = ()
    """HDR panoramas under which true pictures are made, too; turned and scaled at random."""
    edits: bool = False
    """Also true pictures of the street with actors removed, inserted and moved, and from a shifted
    ego: OUT/truth/edits."""
    device: Literal["cpu", "cuda"] = "cpu"
    """What traces light. On CUDA grain is another, so that a street is the same but to the eye."""
    verbose: Verbose = False
    """Show the trace of an error."""

    def run(self) -> None:
        """Make the street."""
        from lightsim_lab.synthetic import synthesize as make_street
        from lightsim_lab.synthetic import synthesize_edits
        from lightsim_lab.synthetic.skies import FurtherSkies

        progress = terminal_progress()
        make_street(
            self.out,
            seed=self.seed,
            size=self.size,
            progress=progress,
            is_denoised=self.denoise,
            paths=self.paths,
            further=FurtherSkies(self.more_skies, self.drawn_suns, self.sky),
            device=self.device,
        )
        if self.edits:
            synthesize_edits(
                self.out,
                seed=self.seed,
                size=self.size,
                progress=progress,
                is_denoised=self.denoise,
                device=self.device,
            )
        say(f"log:   {self.out / 'log'}")
        say(f"truth: {self.out / 'truth'}")
