"""Classify crowns by colour: beams scatter in leaves, but also in transformers and pipes."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Int64

from lightsim.core.casting import RayCaster
from lightsim.core.foliage import GREENER, excess_green
from lightsim.geometry.completion.crowns import Crowns
from lightsim.geometry.completion.view_evidence import OBJECT_VIEW_M, ViewEvidence

# Largest number of returns of a crown whose colours are read; more would cost time alone.
_MOST_RETURNS = 400


def is_green(crowns: Crowns, evidence: ViewEvidence, caster: RayCaster) -> Bool[np.ndarray, " k"]:
    """Return whether each crown is greener than the images in which it is visible.

    The median excess green of a crown's returns decides. Crowns that are visible in no image count
    as green.

    Args:
        crowns: candidates.
        evidence: the views of the log.
        caster: over the measured background.

    Raises:
        InputError: a matte does not fit its camera.
    """
    number = np.repeat(crowns.crown, np.diff(crowns.first_return))
    rows = _some_of_each(number)
    points, number = crowns.returns_m[rows], number[rows]
    found: list[list[np.ndarray]] = [[] for _ in range(len(crowns))]
    for view in evidence.views() if len(rows) else ():
        lines = view.lines(points, OBJECT_VIEW_M).visible(caster)
        if not len(lines.row):
            continue
        own = excess_green(view.frame.load_srgb8())[lines.pixel]
        for k in np.unique(number[lines.row]):
            found[k].append(own[number[lines.row] == k])
    medians = [np.median(np.concatenate(own)) if own else np.inf for own in found]
    return np.array(medians, np.float64) > GREENER


def _some_of_each(number: Int64[np.ndarray, " r"]) -> Int64[np.ndarray, " s"]:
    """Return evenly spaced rows of each number, at most about `_MOST_RETURNS`."""
    rows = [np.flatnonzero(number == k) for k in np.unique(number)]
    return np.concatenate(
        [np.zeros(0, np.int64), *(own[:: -(-len(own) // _MOST_RETURNS)] for own in rows)]
    )
