"""Evaluation of edited frames against true pictures of the edited street: `lightsim evaluate
edits`.

Edits remove, move and insert actors, or shift the ego path.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool
from scipy.ndimage import binary_dilation, uniform_filter

from lightsim.build.quality.frames import FrameTask
from lightsim.build.workspace import Workspace
from lightsim.errors import InputError
from lightsim.progress import Progress
from lightsim.scenario.edits import read_scenario_request
from lightsim.simulation.edited import simulate
from lightsim.simulation.options import SimulateOptions
from lightsim.store.exr import read_exr
from lightsim.store.images import read_srgb8
from lightsim_lab.baselines.colour_transfer_tables import copy_source
from lightsim_lab.metrics.folders import folder_tasks
from lightsim_lab.metrics.options import OURS, MeasureOptions
from lightsim_lab.metrics.report import EvaluationReport
from lightsim_lab.studies.evaluation import measured

# Name of the recorded pictures in tables.
UNEDITED = "no edit"
_UNEDITED_FOLDER = "none"
# Difference between the true pictures' 3 x 3 means above which a pixel is affected by an edit; it
# exceeds the path tracer's noise.
_PICTURE_CHANGE = 6 / 255
# Difference of sun visibility above which a pixel is affected; sensitivity not measured.
_VISIBILITY_CHANGE = 0.05


@dataclass(frozen=True, eq=False)
class TrueView:
    """True buffers and pictures of one view before and after an edit."""

    camera: str
    stem: str
    before: dict[str, np.ndarray]
    after: dict[str, np.ndarray]
    pictures: tuple[np.ndarray, np.ndarray]

    @property
    def is_other_surface(self) -> Bool[np.ndarray, "h w"]:
        """Pixels that show another surface after the edit."""
        depth = [b["depth_z_m"] for b in (self.before, self.after)]
        # A finite depth of the sky makes differences between sky and surface finite.
        gap = np.abs(np.nan_to_num(depth[0], posinf=1e4) - np.nan_to_num(depth[1], posinf=1e4))
        return (gap > 0.02) | (self.before["actor_index"] != self.after["actor_index"])

    @property
    def is_affected(self) -> Bool[np.ndarray, "h w"]:
        """Pixels whose surface or light the edit changes."""
        sun = (
            np.abs(self.before["sun_visibility"] - self.after["sun_visibility"])
            > _VISIBILITY_CHANGE
        )
        # One pixel of margin covers the antialiased edges of the pictures.
        exact = binary_dilation(self.is_other_surface | sun, np.ones((3, 3)))
        difference = np.subtract(*(p.astype(np.float32) / 255 for p in self.pictures))
        smooth = np.abs(uniform_filter(difference, 3, axes=(0, 1))).max(axis=-1)
        return exact | (smooth > _PICTURE_CHANGE)

    @property
    def is_surface(self) -> Bool[np.ndarray, "h w"]:
        """Pixels that show a surface after the edit."""
        return np.isfinite(self.after["depth_z_m"])


def true_views(truth: Path, name: str) -> Iterator[TrueView]:
    """Load the rendered views of an edit."""

    def read(edit: str, what: str, view: Path) -> np.ndarray:
        image = read_exr(truth / "edits" / edit / what / view.parent.name / f"{view.stem}.exr")
        return image.reshape(image.shape[:2])

    for path in sorted((truth / "edits" / name / "frames").glob("*/*.png")):
        unedited = truth / "edits" / _UNEDITED_FOLDER / "frames" / path.parent.name / path.name
        before, after = (
            {w: read(e, w, path) for w in ("depth_z_m", "actor_index", "sun_visibility")}
            for e in (_UNEDITED_FOLDER, name)
        )
        pictures = read_srgb8(unedited), read_srgb8(path)
        yield TrueView(path.parent.name, path.stem, before, after, pictures)


def evaluate_edits(
    work: Path, truth: Path, options: MeasureOptions, progress: Progress
) -> EvaluationReport:
    """Score the frames of every edit of TRUTH/edits, simulated from the twin under its source sky.

    Pixels are scored where the edit changes the true picture; for a shifted ego path, on all
    surfaces. The recorded frames are scored as a baseline.

    Raises:
        InputError: `truth` contains no edits.
    """
    tasks: list[FrameTask] = []
    for request in sorted((truth / "edits").glob("*/SCENARIO.json")):
        tasks += _edit_tasks(work, truth, request, progress)
    if not tasks:
        raise InputError(
            "the truth of edits is missing",
            where=truth / "edits",
            remedy="Make it: lightsim synthesize --edits.",
        )
    return measured(tasks, options, progress, f"Edits of {work.name}")


def _edit_tasks(work: Path, truth: Path, request: Path, progress: Progress) -> list[FrameTask]:
    name = request.parent.name
    views = {(view.camera, view.stem): view for view in true_views(truth, name)}
    if not views:
        return []
    stems = sorted(int(stem) for _, stem in views)
    options = SimulateOptions(
        sky=("source",),
        cameras=tuple(dict.fromkeys(camera for camera, _ in views)),
        frames=f"{stems[0]}:{stems[-1] + 1}",
        image_scale=1.0,
        overwrite=True,
    )
    (made,) = simulate(work, request, options, progress)
    is_ego = any(entry["do"] == "ego" for entry in read_scenario_request(request).spelt)

    def counts(camera: str, stem: str) -> Bool[np.ndarray, "h w"]:
        view = views[camera, stem]
        return view.is_surface if is_ego else view.is_affected

    folders = {
        OURS: made / "frames",
        "truth": truth / "edits" / name / "frames",
        "source": Path(Workspace(work).reading.source) / "camera",
    }
    return folder_tasks(name, [OURS], folders, counts, {UNEDITED: copy_source})
