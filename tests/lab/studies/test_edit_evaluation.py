"""Edited frames are scored where an edit changes the true picture."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import binary_dilation
from tests.render.rendering_scenes import sun_sky
from tests.tiny_world import STEMS, in_shadow, on_ground, tiny_world

from lightsim.core.buffers import BACKGROUND
from lightsim.core.reading import LogReading
from lightsim.errors import InputError
from lightsim.progress import SilentProgress
from lightsim.simulation.options import SimulateOptions
from lightsim.store.images import write_exr, write_png
from lightsim_lab.metrics.options import MeasureOptions
from lightsim_lab.studies import edit_evaluation
from lightsim_lab.studies.edit_evaluation import UNEDITED, evaluate_edits, true_views

SKY = sun_sky(np.radians(40.0), 35.0, 0.2)
ENTRIES = {
    "remove": {"do": "remove", "actor": "car"},
    "ego": {"do": "ego", "offset_m": [0.0, 1.0, 0.0]},
}


def codes(region_by_code: dict[int, np.ndarray]) -> np.ndarray:
    """A grey picture of 150 with other codes in regions."""
    grey = np.full((96, 96, 3), 150, np.uint8)
    for code, region in region_by_code.items():
        grey[region] = code
    return grey


@pytest.fixture
def changed(tmp_path: Path) -> dict[str, np.ndarray]:
    """Truth of a street whose car, with its shadow, is removed; where that changes pictures."""
    work, affected = tiny_world(SKY), {}
    assert SKY.sun is not None
    for frame in work.log.frames:
        shadow = in_shadow(frame, SKY.sun.direction_world) & on_ground(frame)
        car = ~on_ground(frame)
        before = {
            "depth_z_m": np.where(car, 28.5, 30.0),
            "actor_index": np.where(car, 0, BACKGROUND),
            "sun_visibility": np.where(shadow, 0.0, 1.0),
        }
        after = {
            "depth_z_m": np.full(car.shape, 30.0),
            "actor_index": np.full(car.shape, BACKGROUND),
            "sun_visibility": np.ones(car.shape),
        }
        shown = codes({40: car, 90: shadow})
        cases = {"none": (before, shown), "remove": (after, codes({})), "ego": (after, codes({}))}
        for name, (buffers, picture) in cases.items():
            folder = tmp_path / "truth" / "edits" / name
            for what, values in buffers.items():
                (folder / what / "above").mkdir(parents=True, exist_ok=True)
                write_exr(folder / what / "above" / f"{frame.stem}.exr", values.astype(np.float32))
            (folder / "frames" / "above").mkdir(parents=True, exist_ok=True)
            write_png(folder / "frames" / "above" / f"{frame.stem}.png", picture)
        (tmp_path / "log" / "camera" / "above").mkdir(parents=True, exist_ok=True)
        write_png(tmp_path / "log" / "camera" / "above" / f"{frame.stem}.png", shown)
        affected[frame.stem] = binary_dilation(car | shadow, np.ones((3, 3)))
    for name, entry in ENTRIES.items():
        request = {"version": 1, "name": name, "edits": [entry]}
        (tmp_path / "truth" / "edits" / name / "SCENARIO.json").write_text(json.dumps(request))
    return affected


def test_what_an_edit_changes_is_the_car_and_its_shadow(
    changed: dict[str, np.ndarray], tmp_path: Path
) -> None:
    views = {view.stem: view for view in true_views(tmp_path / "truth", "remove")}
    assert set(views) == set(STEMS)
    for stem, view in views.items():
        np.testing.assert_array_equal(view.is_affected, changed[stem])
        assert view.is_surface.all()


def test_frames_are_scored_where_the_edit_counts(
    changed: dict[str, np.ndarray], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Right where the removal changes the picture and black elsewhere: perfect for the removal, and
    wrong for the shifted path, which counts all surfaces."""
    work = tiny_world(SKY, reading=LogReading(source=str(tmp_path / "log"), image_scale=1.0))
    asked: dict[str, SimulateOptions] = {}

    def simulate(root: Path, request: Path, options: SimulateOptions, _: object) -> list[Path]:
        name = request.parent.name
        asked[name] = options
        for stem, region in changed.items():
            (tmp_path / name / "frames" / "above").mkdir(parents=True, exist_ok=True)
            picture = codes({0: ~region})
            write_png(tmp_path / name / "frames" / "above" / f"{stem}.png", picture)
        return [tmp_path / name]

    monkeypatch.setattr(edit_evaluation, "Workspace", lambda root: work)
    monkeypatch.setattr(edit_evaluation, "simulate", simulate)
    given = tmp_path, tmp_path / "truth", MeasureOptions(), SilentProgress()
    report = evaluate_edits(*given).frames
    assert {(o.cameras, o.frames, o.sky) for o in asked.values()} == {
        (("above",), "0:3", ("source",))
    }
    ours = report.methods[0]
    assert report.mean("remove", ours, "masked").psnr_db == np.inf
    assert report.mean("remove", UNEDITED, "masked").psnr_db < 15
    assert report.mean("ego", ours, "masked").psnr_db < 10
    for name in ENTRIES:
        (tmp_path / "truth" / "edits" / name / "SCENARIO.json").unlink()
    with pytest.raises(InputError, match="--edits"):
        evaluate_edits(*given)
