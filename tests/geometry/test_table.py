"""The table of completion steps: each can be left out, and every matte is read once."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from tests.geometry.test_buildings import (
    LEFT_HOUSE,
    NO_CROWNS,
    WIDE,
    _seen,
    _truth,
    _views,
    inputs_of,
)

from lightsim.core.camera import PinholeCamera
from lightsim.errors import InputError
from lightsim.geometry.completion.scene import Scene
from lightsim.geometry.completion.table import STEPS, check_steps, complete, level_changes
from lightsim.geometry.completion.view_evidence import View, ViewEvidence, log_odds_of_views
from lightsim.geometry.completion.walls import find_walls


def test_each_step_can_be_left_out_and_each_matte_is_read_once() -> None:
    seen = _seen([LEFT_HOUSE])
    reads: Counter[str] = Counter()

    def read(key: str, matte: np.ndarray) -> np.ndarray:
        reads[key] += 1
        return matte

    grey = np.full((WIDE.height_px, WIDE.width_px, 3), 128, np.uint8)
    views = [
        (
            replace(frame, load_srgb8=lambda: grey),
            camera,
            partial(read, f"{frame.camera_name} {frame.stem}", matte),
        )
        for frame, camera, matte in _views(_truth([LEFT_HOUSE]), WIDE)
    ]
    inputs = replace(inputs_of([]), evidence=ViewEvidence(views))
    scene = Scene(seen, NO_CROWNS, find_walls(seen))
    whole, _ = complete(inputs, scene)
    assert len(whole.background.faces) > len(seen.faces)
    # Without roofs the front is not raised; without the far field nothing is far away.
    no_roofs, _ = complete(inputs, scene, ("roofs", "far_field", "panes"))
    assert no_roofs.background.vertices[:, 2].max() < whole.background.vertices[:, 2].max()
    assert not no_roofs.rooflines
    assert (
        np.abs(no_roofs.background.vertices).max() < 100 < np.abs(whole.background.vertices).max()
    )
    all_names = [step.name for step in STEPS]
    nothing, notes = complete(inputs, scene, all_names)
    assert nothing is scene
    assert notes == []
    assert level_changes(inputs, all_names)(seen, 0.1) is seen
    assert complete(inputs, scene, until=all_names[0])[0] is scene
    assert set(reads.values()) == {1}


def test_names_of_steps() -> None:
    names = [step.name for step in STEPS]
    assert len(set(names)) == len(names)
    check_steps(names)
    with pytest.raises(InputError, match="no-complete"):
        check_steps(["rooves"])


def test_a_view_keeps_what_its_matte_says() -> None:
    frame, _, _ = _views(_truth([LEFT_HOUSE]), WIDE)[0]
    matte = np.full((5, 7), 0.5, np.float32)
    matte[:2], matte[4] = 1.0, 0.0
    view = View.of(frame, PinholeCamera("small", 7, 5, 5.0, 5.0, 3.5, 2.5), matte)
    np.testing.assert_array_equal(view.has_sky, matte == 1.0)
    np.testing.assert_array_equal(view.has_surface, matte == 0.0)
    # The second row of sky borders on mixed pixels.
    np.testing.assert_array_equal(view.classes[:, 3], [1, 0, 0, 0, -1])


def test_sky_outweighs_surface_and_silence_is_no_evidence() -> None:
    surface_views, sky = np.array([0, 1, 1, 9, 0]), np.array([0, 0, 1, 1, 9])
    np.testing.assert_allclose(log_odds_of_views(surface_views, sky), [-0.5, 1.0, -1.0, 4.0, -6.0])
