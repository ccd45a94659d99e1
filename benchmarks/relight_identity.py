"""A log relit by its own sky: PSNR dB beside the recorded pictures, outside sky and clipped pixels.

    python benchmarks/relight_identity.py WORK [--methods network physical paper] [--frames 0:80:4]

`relight --sky source` gives back the recorded pictures without asking a method; here methods are
asked. Mean over frames and the lowest. Markdown.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from lightsim.build.quality.metrics import psnr
from lightsim.build.workspace import Workspace
from lightsim.core.sky_choice import SkyChoice
from lightsim.simulation.options import RelightOptions
from lightsim.simulation.relight import replayed
from lightsim.simulation.relighter import RelightConfig, Relighter
from lightsim.simulation.skies import resolve_sky


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("work", type=Path)
    parser.add_argument("--methods", nargs="+", default=["network", "physical", "paper"])
    parser.add_argument("--frames", default="0:80:4")
    options = parser.parse_args()
    work = Workspace(options.work, is_stale_allowed=True)
    sys.stdout.write("| method | PSNR dB | lowest | frames |\n|---|---:|---:|---:|\n")
    for method in options.methods:
        asked = RelightOptions(name="identity", method=method, frames=options.frames)
        found = list(scores(work, asked))
        row = f"{np.mean(found):.1f} | {np.min(found):.1f} | {len(found)}"
        sys.stdout.write(f"| {method} | {row} |\n")


def scores(work: Workspace, options: RelightOptions) -> Iterator[float]:
    """Of every frame."""
    scenario = replayed(work, options)
    log = work.log_at(work.reading.image_scale)
    relighter = Relighter(work, log, RelightConfig(), options)
    sky = replace(resolve_sky(SkyChoice("source"), work), is_source=False)
    target = relighter.target(sky)
    for frame in scenario.frames:
        (relit,) = relighter.relit(frame, scenario, [target])
        assert relit.inputs is not None
        is_kept = (relit.inputs.sky_matte < 0.5) & ~relit.inputs.is_clipped
        if frame.camera_name in log.ego_vehicle_masks:
            is_kept &= ~log.ego_vehicle_masks[frame.camera_name]
        made, recorded = (
            picture.astype(np.float32) / 255
            for picture in (relit.image_srgb8, relit.frame.load_srgb8())
        )
        yield psnr(made, recorded, is_kept)


if __name__ == "__main__":
    main()
