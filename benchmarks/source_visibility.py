"""The recorded sun's visibility, found in the pictures and rendered, against a street's truth.

    python benchmarks/source_visibility.py WORK --truth DIR

Pixels of the frames that have exact buffers, where the true surface faces the sun: intersection
over union of lit pixels, fraction that is lit and taken for shadowed, and the reverse; Markdown.
"""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict
from pathlib import Path

import numpy as np

from lightsim.build.workspace import Workspace
from lightsim.render.frame_renderer import FrameRenderer
from lightsim.scenario.replay import replay
from lightsim.simulation.relighter import RelightConfig
from lightsim.store.exr import read_exr
from lightsim_lab.synthetic.reader import true_sky

_LEVEL, _UPRIGHT, _FACING = 0.9, 0.3, 0.05


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("work", type=Path)
    parser.add_argument("--truth", type=Path, required=True)
    options = parser.parse_args()
    counts = _count(Workspace(options.work), options.truth)
    lines = [
        "| surface | visibility | lit | IoU | taken for shadowed | taken for lit |",
        "|---|---|---:|---:|---:|---:|",
    ]
    for (surface, method), (both, missed, false, neither) in counts.items():
        total = both + missed + false + neither
        lines.append(
            f"| {surface} | {method} | {(both + missed) / total:.2f} |"
            f" {both / max(both + missed + false, 1):.3f} | {missed / total:.3f} |"
            f" {false / total:.3f} |"
        )
    sys.stdout.write("\n".join(lines) + "\n")


def _count(work: Workspace, truth: Path) -> dict[tuple[str, str], np.ndarray]:
    """Pixels by surface and method: lit in both, in truth alone, in the estimate alone, in none."""
    sky, sun = work.sky.dome, true_sky(truth, "source").sun
    assert sun is not None
    transport = RelightConfig().transport
    renderer = FrameRenderer(work.twin.assets.background, work.unobserved_occluders, transport, 0)
    log = work.log_at(1.0)
    counts: dict[tuple[str, str], np.ndarray] = defaultdict(lambda: np.zeros(4, dtype=np.int64))
    for path in sorted((truth / "sun_visibility").glob("*/*.exr")):
        name = path.parent.name
        frame = next(f for f in log.frames_of(name) if f.stem == path.stem)
        scenario = replay(work.twin, "as recorded", (frame,), "recorded", 0)
        traced = renderer.trace(scenario, frame, log.cameras[name])
        found = traced.found_visibility(sky.sun)
        if found is None:
            continue
        lit = read_exr(path).reshape(found.shape) > 0.5
        normal = read_exr(truth / "normal_world" / name / path.name)
        faces = normal @ sun.direction_world.astype(np.float32) > _FACING
        is_shown = faces & np.isfinite(found) & traced.buffers.has_surface
        rendered = traced.light(sky).sun_visibility
        for surface, members in (
            ("ground", normal[..., 2] > _LEVEL),
            ("facades", np.abs(normal[..., 2]) < _UPRIGHT),
        ):
            rows = is_shown & members
            for method, visibility in (("found", found), ("rendered", rendered)):
                true, made = lit[rows], visibility[rows] > 0.5
                kinds = (true & made, true & ~made, ~true & made, ~true & ~made)
                counts[surface, method] += [int(kind.sum()) for kind in kinds]
    return counts


if __name__ == "__main__":
    main()
