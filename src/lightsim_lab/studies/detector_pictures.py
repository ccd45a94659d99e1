"""Test pictures in which a row of the detector's experiment detects most more and most fewer
vehicles than the reference, with the detections of both."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw

from lightsim.core.resample import resize_area
from lightsim.errors import InputError
from lightsim.store.images import read_srgb8, write_jpeg
from lightsim_lab.detect.boxes import IOU_THRESHOLDS, corners
from lightsim_lab.detect.config import DetectorConfig
from lightsim_lab.detect.labels import View, read_views
from lightsim_lab.studies.detector_data import data_of
from lightsim_lab.studies.detector_options import RECORDED, DetectorTableOptions
from lightsim_lab.studies.detector_table import Run, read_runs

# Pictures of each kind, at most one of a camera of a street.
_COUNT = 3
# Width of each half: both fit on a screen of 1440 pixels.
_WIDTH_PX = 720
# Overlap of a true detection in the pictures: the middle one of the experiment.
_OVERLAP = 1
# Colour of labelled vehicles: yellow.
_LABEL = (255, 220, 60)
# Colour of true detections: green.
_TRUE = (80, 255, 120)
# Colour of false detections: red.
_FALSE = (255, 70, 70)
# Pairs of corners of a box that an edge joins: underside, top, uprights.
_EDGES = (*((i, (i + 1) % 4) for i in range(4)), *((4 + i, 4 + (i + 1) % 4) for i in range(4)),
          *((i, i + 4) for i in range(4)))  # fmt: skip
# Least depth, in metres, of the corners of a drawn box.
_NEAR_M = 0.5


def write_pictures(options: DetectorTableOptions, folder: Path) -> list[Path]:
    """Write the pictures of `--compared` beside the reference: gain-1.jpg, ..., loss-1.jpg, ...

    The left half has the detections of the reference's first seed, the right half those of the
    row. Each half shows the best detections, as many as the picture has vehicles. True detections
    are green, false ones red, labelled vehicles yellow.

    Raises:
        InputError: the rows have no finished trainings of a common seed.
    """
    row = options.compared
    runs = {name: read_runs(options, name) for name in (options.reference, row)}
    seeds = sorted(runs[row].keys() & runs[options.reference].keys())
    if not seeds:
        raise InputError(
            "two rows have no finished training of a common seed",
            where=options.results / "runs",
            expected=f"{options.reference} and {row}",
            remedy="Run: lightsim evaluate detector run, with the same options.",
        )
    found = [{name: _found(own[seed]) for name, own in runs.items()} for seed in seeds]
    gain = np.mean([one[row] - one[options.reference] for one in found], axis=0)
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for kind, order in (("gain", np.argsort(-gain)), ("loss", np.argsort(gain))):
        for number, k in enumerate(_distinct(runs[row][seeds[0]], order), 1):
            halves = [_drawn(options, runs[name][seeds[0]], k) for name in (options.reference, row)]
            path = folder / f"{kind}-{number}.jpg"
            write_jpeg(path, np.concatenate(halves, axis=1))
            written.append(path)
    return written


def _found(run: Run) -> Float[np.ndarray, " p"]:
    """Return the number of vehicles of every picture times its average precision, the mean over
    thresholds."""
    count = len(run.arrays["light"])
    truth = np.bincount(run.arrays["truth_picture"], minlength=count)
    each = [run.precision(np.arange(count) == k).mean() if truth[k] else 0.0 for k in range(count)]
    return truth * np.array(each)


def _distinct(run: Run, order: np.ndarray) -> list[int]:
    """Return the first pictures of an order, one of each camera and street, without the light of
    the training."""
    chosen: dict[tuple[str, str], int] = {}
    for k in order.tolist():
        view = str(run.arrays["view"][k]).split("/")[0]
        if run.arrays["light"][k] != RECORDED or run.lights == [RECORDED]:
            chosen.setdefault((str(run.arrays["street"][k]), view), k)
    return list(chosen.values())[:_COUNT]


def _drawn(options: DetectorTableOptions, run: Run, k: int) -> UInt8[np.ndarray, "h w 3"]:
    """Return a test picture with the detections of a run."""
    a = run.arrays
    street, light, name = str(a["street"][k]), str(a["light"][k]), str(a["view"][k])
    views = read_views(options.labels(street))
    view = next(v for v in views if v.name == name).within(DetectorConfig().reach_m)
    srgb = read_srgb8(data_of(options).true_pictures(street, light) / f"{name}.jpg")
    height = round(srgb.shape[0] * _WIDTH_PX / srgb.shape[1])
    small = resize_area(srgb.astype(np.float32), height, _WIDTH_PX)
    picture = Image.fromarray(np.round(small).astype(np.uint8))
    pen = ImageDraw.Draw(picture)
    use = np.flatnonzero((a["picture"] == k) & a["is_counted"][:, _OVERLAP])[: len(view.boxes)]
    _draw(pen, view, {_LABEL: view.boxes})
    is_true = a["is_true"][use, _OVERLAP]
    _draw(pen, view, {_FALSE: a["boxes"][use][~is_true], _TRUE: a["boxes"][use][is_true]})
    pen.text((6, 4), f"{light}, overlap {IOU_THRESHOLDS[_OVERLAP]}", fill=(255, 255, 255))
    return np.asarray(picture)


def _draw(
    pen: ImageDraw.ImageDraw, view: View, boxes: Mapping[tuple[int, int, int], np.ndarray]
) -> None:
    scale = _WIDTH_PX / view.size_px[0]
    for colour, rows in boxes.items():
        for box, ground in zip(rows, corners(rows), strict=True):
            heights = box[2] + np.repeat([-0.5, 0.5], 4) * box[5]
            points = np.column_stack([np.tile(ground, (2, 1)), heights, np.ones(8)])
            u, v, depth = view.projection @ points.T
            if depth.min() > _NEAR_M:
                at = np.column_stack([u, v]) / depth[:, None] * scale
                for first, last in _EDGES:
                    pen.line([*at[first], *at[last]], fill=colour, width=2)
