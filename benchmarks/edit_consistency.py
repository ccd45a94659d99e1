"""Whether an edit looks the same to neighbouring cameras and in successive frames.

    python benchmarks/edit_consistency.py WORK SCENARIO.json [--frames 60:63] [--cameras a,b]

New and moved actors, beside recorded surfaces (which no edit touches: what poses, depth and the
cameras' colours let one hope for): reprojection error through exact depth, shift of the pictures
against each other (patches with enough texture), difference of radiance, and intersection over
union of the shadows that edits cast on static surfaces. Markdown; over all pairs of views that see
the same thing.
"""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
from scipy.ndimage import binary_erosion
from view_agreement import colour_difference, overlap, picture_shifts_px

from lightsim.build.workspace import Workspace
from lightsim.core.buffers import BACKGROUND
from lightsim.core.colour import linear_from_srgb8, luminance
from lightsim.core.scenario import Scenario, ScenarioFrame, changed_placements
from lightsim.core.sky_choice import SkyChoice
from lightsim.scenario.edits import read_scenario_request
from lightsim.simulation.edited import asset_library, edited_scenario
from lightsim.simulation.options import RelightOptions
from lightsim.simulation.relight import replayed
from lightsim.simulation.relighter import RelightConfig, Relighter
from lightsim.simulation.skies import resolve_sky
from lightsim_lab.metrics.consistency import Matches, View, match

# What the edit takes of a pixel's light where it counts as shadow.
_SHADOW = 0.8
# Fewer matching pixels tell nothing.
_FEWEST = 200


@dataclass(frozen=True, eq=False)
class Edited:
    """One view of the edit: pixels that are new, that are as recorded, and that it shades; and
    whether all that is new stands."""

    view: View
    frame: ScenarioFrame
    is_new: np.ndarray
    is_kept: np.ndarray
    is_shaded: np.ndarray
    is_standing: bool


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("work", type=Path)
    parser.add_argument("scenario", type=Path)
    parser.add_argument("--frames", default="")
    parser.add_argument("--cameras", default="")
    options = parser.parse_args()
    names = tuple(filter(None, options.cameras.split(",")))
    chosen = RelightOptions(name="consistency", frames=options.frames, cameras=names)
    views = list(_views(Workspace(options.work, is_stale_allowed=True), options.scenario, chosen))
    found: dict[tuple[str, str], dict[str, list]] = defaultdict(lambda: defaultdict(list))
    for a, b in combinations(views, 2):
        pair = _pair(a.frame, b.frame)
        if pair:
            _compare(a, b, pair, found)
    sys.stdout.write(_table(found) + "\n")


def _views(work: Workspace, path: Path, options: RelightOptions) -> Iterator[Edited]:
    """The frames that the edit changes."""
    recorded = replayed(work, options)
    asked = read_scenario_request(path)
    scenario = edited_scenario(work, recorded, asked, asset_library(None, path.parent))
    log = work.log_at(work.reading.image_scale)
    relighter = Relighter(work, log, RelightConfig(), options, recorded)
    target = relighter.target(resolve_sky(SkyChoice("source"), work))
    gains = work.twin.assets.camera_gains
    for frame in scenario.frames:
        (made,) = relighter.relit(frame, scenario, [target])
        if made.traced is None:
            continue
        buffers, camera = made.traced.geometry, log.cameras[frame.camera_name]
        new = _new_numbers(recorded, scenario, frame)
        before = linear_from_srgb8(frame.load_srgb8()) / gains[camera.name]
        light = (luminance(made.source.radiance) + 1e-3) / (luminance(before) + 1e-3)
        is_static = buffers.actor_index == BACKGROUND
        poses = {
            scenario.number_by_actor[p.track.actor_id]: p.world_from_actor(frame.time_ns)
            for p in scenario.placements_at(frame.time_ns)
        }
        yield Edited(
            View(frame, camera, buffers, made.source.radiance, poses),
            frame,
            # Pixels at edges are mixed with what is behind.
            np.asarray(binary_erosion(np.isin(buffers.actor_index, new)), dtype=bool),
            is_static & ~made.source.is_edited,
            is_static & (light < _SHADOW),
            not any(scenario.tracks[number].is_moving for number in new),
        )


def _new_numbers(recorded: Scenario, scenario: Scenario, frame: ScenarioFrame) -> list[int]:
    changed = changed_placements(recorded, scenario, frame.time_ns)
    return (
        [] if changed is None else [scenario.number_by_actor[p.track.actor_id] for p in changed[1]]
    )


def _pair(a: ScenarioFrame, b: ScenarioFrame) -> str:
    """How two frames are neighbours; empty where they are not."""
    if a.stem == b.stem:
        return "cameras"
    is_next = abs(int(a.stem) - int(b.stem)) == 1
    return "frames" if a.camera_name == b.camera_name and is_next else ""


def _compare(a: Edited, b: Edited, pair: str, found: dict) -> None:
    for surface, chosen in (("new actors", a.is_new), ("recorded", a.is_kept)):
        matches = match(a.view, b.view, chosen)
        is_chosen = (b.is_new if surface == "new actors" else b.is_kept)[matches.other]
        matches = Matches(
            matches.pixel[is_chosen], matches.uv[is_chosen], matches.error_px[is_chosen]
        )
        if len(matches.pixel) < _FEWEST:
            continue
        row = found[pair, surface]
        row["pixels"].append(len(matches.pixel))
        row["error"].append(matches.error_px)
        row["shift"].append(picture_shifts_px(a.view, b.view, matches))
        row["colour"].append(colour_difference(a.view, b.view, matches))
    # A shadow that moves lies elsewhere in another frame.
    if pair == "cameras" or (a.is_standing and b.is_standing):
        matches = match(a.view, b.view, a.is_shaded | (a.view.buffers.actor_index == BACKGROUND))
        found[pair, "new actors"]["shadow"].append(overlap(a.is_shaded, b.is_shaded, matches))


def _table(found: dict) -> str:
    lines = [
        "| views | surfaces | pairs | pixels | reprojection px, 95 % | picture shift px, patches |"
        " colour difference | shadow IoU, points |",
        "|---|---|---:|---:|---:|---:|---:|---:|",
    ]
    for (pair, surface), row in sorted(found.items()):
        if not row["error"]:
            continue
        error, shift, colour = (np.concatenate(row[k]) for k in ("error", "shift", "colour"))
        moved = f"{np.median(shift):.2f}, {len(shift)}" if len(shift) else "-"
        both, either = np.sum(row["shadow"], axis=0) if row["shadow"] else (0, 0)
        shadow = f"{both / either:.2f}, {either}" if either else "-"
        lines.append(
            f"| {pair} | {surface} | {len(row['error'])} | {sum(row['pixels'])} |"
            f" {np.median(error):.3f}, {np.quantile(error, 0.95):.3f} | {moved} |"
            f" {100 * np.median(colour):.1f} % | {shadow} |"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    main()
