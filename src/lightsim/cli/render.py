"""`lightsim render`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from lightsim.cli.options import Verbose, names, say


@dataclass(frozen=True)
class Render:
    """Write geometry and light buffers of the twin as EXR files."""

    work: tyro.conf.Positional[Path]
    """Work folder of a finished build."""
    what: str
    """Comma-separated: depth position normal albedo ao actor shaded unshadowed shadow image."""
    out: Path
    """Folder for DIR/<what>/<camera>/<frame>.exr, or DIR/<sky>/<what>/... with several skies;
    files that are there are kept, so the same command goes on with a run that was stopped."""
    sky: tuple[str, ...] = ("source",)
    """One or more of: a .hdr or .exr file, sun:AZIMUTH,ELEVATION[,TURBIDITY], time:ISO, source.
    Each frame is traced once for all of them."""
    sky_yaw_deg: float = 0.0
    """Turn the skies, clockwise seen from above."""
    sky_scale: str = "auto"
    """auto: the mean illuminance of the source; none: radiance as stored; or a number."""
    cameras: str = ""
    """Comma-separated camera names; empty for all."""
    frames: str = ""
    """START:STOP[:STEP] over the log's own frame numbers; empty for all."""
    image_scale: float | None = None
    """Factor on the log's image size; by default that of the build."""
    renderer: Literal["transport", "path", "cycles"] = "transport"
    """transport: one ray table for all skies; path: Mitsuba's path tracer; cycles: Blender's, in a
    process of its own. The latter two start anew for every sky."""
    backend: Literal["auto", "embree", "mitsuba-cuda", "mitsuba-llvm"] = "auto"
    """What casts the rays of the ray table: auto takes CUDA where there is one, else Embree."""
    rays: int | None = None
    """Rays over the hemisphere of each traced pixel, or paths of each pixel; more are less
    noisy."""
    pixel_samples: int = 4
    """Points of each pixel at which the ray table looks: 1, 4, 9, 16; more are smoother edges."""
    bounces: int | None = None
    """Of light between surfaces, 1 to 64; by default 1 with the ray table, 4 with the others."""
    denoise: bool = False
    """Remove noise from `image` with Open Image Denoise (extra `denoise`)."""
    blender_python: Path | None = None
    """Python 3.11 that has bpy 4.5, for --renderer cycles."""
    shard: str = ""
    """I/N, I from 1 to N: render the I-th of N parts of the frames; parts may share DIR."""
    seed: int = 0
    """Of the sampling of rays."""
    allow_stale: bool = False
    """Go on where the recording has changed since the build."""
    verbose: Verbose = False
    """Show the trace of an error."""

    def run(self) -> None:
        """Render, and say how many frames were."""
        from lightsim.progress import terminal_progress
        from lightsim.render.renderers import RendererChoice
        from lightsim.simulate import buffers as rendering
        from lightsim.simulate.shard import Shard
        from lightsim.simulate.skies import SkyChoice

        skies = tuple(SkyChoice(s, self.sky_yaw_deg, self.sky_scale) for s in self.sky)
        options = rendering.RenderOptions(
            what=names(self.what),
            skies=skies,
            cameras=names(self.cameras),
            frames=self.frames,
            image_scale=self.image_scale,
            renderer=RendererChoice(
                self.renderer,
                self.backend,
                self.rays,
                self.pixel_samples,
                self.blender_python,
                self.bounces,
                self.denoise,
            ),
            shard=Shard.parse(self.shard),
            seed=self.seed,
            is_stale_allowed=self.allow_stale,
        )
        done = rendering.render(self.work, self.out, options, terminal_progress())
        kept = done.frames - done.rendered
        say(f"buffers: {self.out} ({done.rendered} frames rendered, {kept} were complete)")
