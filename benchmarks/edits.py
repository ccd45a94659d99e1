"""Edited frames against the true pictures of the edited street.

    lightsim synthesize --seed S --denoise --edits --out DIR
    python benchmarks/edits.py WORK --truth DIR/truth [--pictures FOLDER] [--edits NAME ...]

Each edit of DIR/truth/edits is made from the twin, each view once. The affected region is where the
exact buffers (surface, actor, visibility of the sun) or the noise-free pictures differ between the
street with and without the edit. PSNR / SSIM / LPIPS in it and outside, beside the recorded
picture as it is (no edit) and the actor alone (paste: our pixels within the true outline, no
shadow). IoU of new shadows: where our picture is darker than the recorded one, against where the
true sun is gone; and that of the true picture in the place of ours, which is not 1: what an actor
takes of the sky's light darkens, too. For a shifted ego: all but the sky, beside the picture from
the recorded place.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import binary_dilation

from lightsim.build.quality.metrics import fill_invalid, psnr, ssim
from lightsim.build.workspace import Workspace
from lightsim.core.colour import linear_from_srgb8, luminance
from lightsim.core.scenario import Scenario
from lightsim.scenario.edits import ScenarioRequest, read_scenario_request
from lightsim.simulation.edited import asset_library, edited_scenario
from lightsim.simulation.options import RelightOptions
from lightsim.simulation.relight import replayed
from lightsim.simulation.relighter import RelightConfig, Relighter
from lightsim.simulation.skies import resolve_sky
from lightsim.store.images import write_png
from lightsim_lab.metrics.lpips import lpips_features, lpips_of_features
from lightsim_lab.studies.edit_evaluation import TrueView, true_views

_DARKENED = 0.75
"""A pixel of our shadow has less than this fraction of its recorded radiance: half of the sun's
share of the light is gone."""
_OUTLINE_PX = 2
METHODS = ("LightSim", "no edit", "paste")


def is_new_shadow(view: TrueView) -> np.ndarray:
    """Pixels of the same surface that lose most of their sun."""
    lost = view.before["sun_visibility"] - view.after["sun_visibility"]
    return ~view.is_other_surface & (lost > 0.5)


@dataclass(frozen=True)
class Made:
    """A view with our picture, the recorded one, pixels that we left alone, processor seconds."""

    view: TrueView
    picture: np.ndarray
    recorded: np.ndarray
    is_kept: np.ndarray
    spent_s: float


class Bench:
    """A twin whose frames are edited."""

    def __init__(self, work: Path) -> None:
        self.workspace = Workspace(work, is_stale_allowed=True)
        self.options = RelightOptions(name="edits", image_scale=1.0)
        self.recorded = replayed(self.workspace, self.options)

    def scenario(self, request: ScenarioRequest) -> Scenario:
        library = asset_library(None, request.source.parent)
        return edited_scenario(self.workspace, self.recorded, request, library)

    def made(self, scenario: Scenario, seen: list[TrueView]) -> Iterator[Made]:
        """The views, one after the other."""
        log = self.workspace.log_at(1.0)
        relighter = Relighter(self.workspace, log, RelightConfig(), self.options, self.recorded)
        target = relighter.target(resolve_sky(self.options.sky_by_name["source"], self.workspace))
        frames = {(f.camera_name, f.stem): f for f in scenario.frames}
        for view in seen:
            frame = frames[view.camera, view.stem]
            start_s = time.process_time()
            (found,) = relighter.relit(frame, scenario, [target])
            spent_s = time.process_time() - start_s
            recorded, is_kept = frame.load_srgb8(), ~found.source.is_edited
            yield Made(view, found.image_srgb8, recorded, is_kept, spent_s)


def scores(made: np.ndarray, truth: np.ndarray, is_valid: np.ndarray) -> tuple[float, ...]:
    """PSNR, SSIM and LPIPS over some pixels."""
    one, other = (x.astype(np.float32) / 255 for x in (made, truth))
    filled = fill_invalid(one, other, is_valid).astype(np.float32)
    features = lpips_features(filled), lpips_features(other)
    return (
        psnr(one, other, is_valid),
        ssim(one, other, is_valid),
        lpips_of_features(*features, is_valid),
    )


def shadow_iou(view: TrueView, made: np.ndarray, recorded: np.ndarray) -> float:
    """Of new shadows on surfaces that stay; NaN where the truth has none."""
    light = [luminance(linear_from_srgb8(p)) for p in (made, recorded)]
    darker = ~view.is_other_surface & (light[0] < _DARKENED * light[1])
    true = is_new_shadow(view)
    return float((darker & true).sum() / (darker | true).sum()) if true.sum() > 20 else np.nan


def pasted(view: TrueView, made: np.ndarray, recorded: np.ndarray) -> np.ndarray:
    """Our pixels within the true outline of the actor, the recorded ones elsewhere."""
    outline = binary_dilation(view.is_other_surface, iterations=_OUTLINE_PX)
    return np.where(outline[..., None], made, recorded)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("work", type=Path)
    parser.add_argument("--truth", type=Path, required=True)
    parser.add_argument("--edits", nargs="*")
    parser.add_argument("--pictures", type=Path, help="ours, truth, recorded side by side")
    options = parser.parse_args()
    bench = Bench(options.work)
    head = ["edit", *(f"{m}, {where}" for where in ("inside", "outside") for m in METHODS)]
    head += ["shadow IoU", "untouched pixels identical", "region", "processor s"]
    sys.stdout.write("| " + " | ".join(head) + " |\n|---|" + "---:|" * (len(head) - 1) + "\n")
    for path in sorted((options.truth / "edits").glob("*/SCENARIO.json")):
        name = path.parent.name
        seen = list(true_views(options.truth, name))
        if not seen or (options.edits and name not in options.edits):
            continue
        request = read_scenario_request(path)
        is_ego = any(entry["do"] == "ego" for entry in request.spelt)
        table = defaultdict(list)
        for made in bench.made(bench.scenario(request), seen):
            _add(table, made, is_ego=is_ego)
            if options.pictures is not None:
                options.pictures.mkdir(parents=True, exist_ok=True)
                pictures = made.picture, made.view.pictures[1], made.recorded
                file = f"{name}_{made.view.camera}_{made.view.stem}.png"
                write_png(options.pictures / file, np.concatenate(pictures, axis=1))
        sys.stdout.write(f"| {name} ({len(seen)}) | " + " | ".join(_cells(table)) + " |\n")
        sys.stdout.flush()


def _add(table: dict[Any, list[Any]], made: Made, *, is_ego: bool) -> None:
    view, truth = made.view, made.view.pictures[1]
    region = view.is_surface if is_ego else view.is_affected
    rivals = [made.picture, made.recorded]
    if not is_ego:
        rivals.append(pasted(view, made.picture, made.recorded))
    for method, picture in zip(METHODS, rivals, strict=False):
        table[method, "inside"].append(scores(picture, truth, region))
        if not is_ego:
            table[method, "outside"].append(scores(picture, truth, ~region))
    if not is_ego:
        before, after = view.pictures
        table["iou"].append(
            (shadow_iou(view, made.picture, made.recorded), shadow_iou(view, after, before))
        )
    table["same"].append((made.picture[made.is_kept] == made.recorded[made.is_kept]).all())
    table["region"].append(region.mean())
    table["s"].append(made.spent_s)


def _cells(table: dict[Any, list[Any]]) -> Iterator[str]:
    for where in ("inside", "outside"):
        for method in METHODS:
            found = table.get((method, where))
            yield (
                " / ".join(
                    f"{v:.{d}f}" for v, d in zip(np.mean(found, axis=0), (2, 3, 3), strict=True)
                )
                if found
                else "-"
            )
    ious = [pair for pair in table["iou"] if np.isfinite(pair).all()]
    yield " / ".join(f"{v:.2f}" for v in np.mean(ious, axis=0)) if ious else "-"
    yield "yes" if all(table["same"]) else "NO"
    yield f"{np.mean(table['region']):.3f}"
    yield f"{np.mean(table['s']):.1f}"


if __name__ == "__main__":
    main()
