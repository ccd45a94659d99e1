"""Classify crowns by colour: beams scatter in leaves, but also in transformers and pipes."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Int64

from lightsim.core.casting import RayCaster
from lightsim.core.foliage import GREENER, excess_green
from lightsim.geometry.completion.crowns import Crowns
from lightsim.geometry.completion.view_evidence import OBJECT_VIEW_M, ViewEvidence

# Maximum number of returns of a crown whose colours are read, to limit the time.
_MAX_RETURNS = 400


def is_green(crowns: Crowns, evidence: ViewEvidence, caster: RayCaster) -> Bool[np.ndarray, " k"]:
    """Return True for crowns whose median excess green exceeds that of the images that show them.

    Crowns that no image shows count as green.

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
        sightlines = view.sightlines(points, OBJECT_VIEW_M).visible(caster)
        if not len(sightlines.row):
            continue
        own = excess_green(view.frame.load_srgb8())[sightlines.pixel]
        for k in np.unique(number[sightlines.row]):
            found[k].append(own[number[sightlines.row] == k])
    medians = [np.median(np.concatenate(own)) if own else np.inf for own in found]
    return np.array(medians, np.float64) > GREENER


def _some_of_each(number: Int64[np.ndarray, " r"]) -> Int64[np.ndarray, " s"]:
    """Return evenly spaced rows of each number, at most about `_MAX_RETURNS`."""
    rows = [np.flatnonzero(number == k) for k in np.unique(number)]
    return np.concatenate(
        [np.zeros(0, np.int64), *(own[:: -(-len(own) // _MAX_RETURNS)] for own in rows)]
    )
