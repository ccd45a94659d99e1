"""Maps of the centre head: encoding of boxes, loss, and decoding of detections.

The head follows CenterPoint (Yin et al. 2021, arXiv:2006.11275), with one class.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor
from torch.nn import functional

from lightsim_lab.detect.boxes import Detections, is_ignored, overlaps
from lightsim_lab.detect.config import DetectorConfig

HEAT = 0
"""Index of the heat map; offset x and y in metres, z, logarithm of the size, sine and cosine of
the yaw follow."""
MAPS = 9
"""Number of maps: the heat map and the eight values."""
_VALUES = slice(1, MAPS)
"""The eight maps after the heat map."""
# Standard deviation of a centre in the heat map, in cells: CenterPoint's at its least radius of 2.
_SIGMA_CELLS = 5 / 6
# Weight of the L1 loss of the box values, as in BEVFormer and CenterPoint.
_VALUE_WEIGHT = 0.25
# Exponent of the focal loss (alpha in equation 1 of Law & Deng 2018, arXiv:1808.01244).
_FOCUS = 2
# Exponent of its weight near centres (beta there).
_NEAR = 4
# Largest number of detections of a picture before repeated ones are removed. A crowded picture of
# PandaSet has 25 counted vehicles (002, frame 60) and several local maxima at each.
_MOST = 100
# Least score of a detection. Sensitivity not measured.
_LEAST_SCORE = 0.02
# Overlap above which the detection of lower score is removed.
_SAME_IOU = 0.2


def encode(
    boxes: Float[np.ndarray, "n 7"], ignored: Float[np.ndarray, "k 7"], config: DetectorConfig
) -> Float32[np.ndarray, "maps x y"]:
    """Return the target maps; NaN in the heat map is ignored, NaN in the values is undefined.

    Boxes outside the region of interest are left out. Of two boxes in a cell the nearer one stays.
    """
    side = config.cells
    maps = np.full((MAPS, side, side), np.nan, np.float32)
    centres = _cell_centres(config)
    heat = np.zeros((side, side), np.float32)
    heat[is_ignored(centres.reshape(-1, 2), ignored).reshape(side, side)] = np.nan
    for box in boxes[np.argsort(-np.hypot(boxes[:, 0], boxes[:, 1]), kind="stable")]:
        i, j = (int(np.floor(v)) for v in _in_cells(box[:2], config))
        if not (0 <= i < side and 0 <= j < side):
            continue
        squared = (np.arange(side)[:, None] - i) ** 2 + (np.arange(side) - j) ** 2
        # `fmax` lets a box count where it lies on an ignored one.
        near = np.exp(-squared / (2 * _SIGMA_CELLS**2)).astype(np.float32)
        heat = np.where(np.isnan(heat) & (near < 0.1), heat, np.fmax(heat, near))
        offset = box[:2] - centres[i, j]
        angle = (np.sin(box[6]), np.cos(box[6]))
        maps[_VALUES, i, j] = [*offset, box[2], *np.log(box[3:6]), *angle]
    maps[HEAT] = heat
    return maps


def decode(maps: Float[np.ndarray, "maps x y"], config: DetectorConfig) -> Detections:
    """Return the local maxima of the heat map, without repeated detections.

    Args:
        maps: output of the head, or target maps with probabilities turned into logits.
    """
    heat = torch.from_numpy(maps[HEAT].astype(np.float64))[None].sigmoid()
    is_peak = (heat == functional.max_pool2d(heat, 3, 1, 1)) & (heat >= _LEAST_SCORE)
    i, j = is_peak[0].numpy().nonzero()
    scores = heat[0].numpy()[i, j]
    best = np.argsort(-scores, kind="stable")[:_MOST]
    i, j, scores = i[best], j[best], scores[best]
    v = maps[_VALUES, i, j].astype(np.float64).T
    place = _cell_centres(config)[i, j] + v[:, :2]
    # Bounded, since the exponential of an untrained value may be infinite.
    size = np.exp(np.clip(v[:, 3:6], -3.0, 4.0))
    yaw = np.arctan2(v[:, 6], v[:, 7])
    boxes = np.concatenate([place, v[:, 2:3], size, yaw[:, None]], axis=1)
    is_same = overlaps(boxes, boxes) > _SAME_IOU
    kept: list[int] = []
    for k in range(len(boxes)):
        if not is_same[k, kept].any():
            kept.append(k)
    return boxes[kept], scores[kept]


def loss_of(
    output: Float[Tensor, "n maps x y"], target: Float[Tensor, "n maps x y"]
) -> tuple[Tensor, Tensor]:
    """Return the focal loss of the heat map and the weighted L1 loss of the values, per box."""
    heat, wanted = output[:, HEAT].float(), target[:, HEAT]
    is_centre = wanted == 1
    is_other = ~is_centre & ~wanted.isnan()
    probability = heat.sigmoid()
    hit = -functional.logsigmoid(heat) * (1 - probability) ** _FOCUS
    miss = -functional.logsigmoid(-heat) * probability**_FOCUS
    miss = miss * (1 - wanted.nan_to_num(0.0)) ** _NEAR
    count = is_centre.sum().clamp(min=1)
    focal = (hit[is_centre].sum() + miss[is_other].sum()) / count
    found, known = (x[:, _VALUES].float() for x in (output, target))
    is_known = ~known.isnan()
    return focal, _VALUE_WEIGHT * (found[is_known] - known[is_known]).abs().sum() / count


def _cell_centres(config: DetectorConfig) -> Float[np.ndarray, "x y 2"]:
    axis = (np.arange(config.cells) + 0.5) * config.cell_m
    x, y = np.meshgrid(axis, axis - config.reach_m / 2, indexing="ij")
    return np.stack([x, y], axis=-1)


def _in_cells(place: Float[np.ndarray, "2"], config: DetectorConfig) -> Float[np.ndarray, "2"]:
    return (place + [0.0, config.reach_m / 2]) / config.cell_m
