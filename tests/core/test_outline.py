"""What walls hide in a picture beyond the twin's."""

from __future__ import annotations

import numpy as np

from lightsim.core.outline import continued_surface, surface_beside

SHAPE = 40, 120
WALL_M, FOCAL_PX = 10.0, 400.0
"""0.5 m are 20 pixels there."""


def wall_to(column: int) -> np.ndarray:
    is_wall = np.zeros(SHAPE, dtype=bool)
    is_wall[:, :column] = True
    return is_wall


def test_a_wall_may_go_on_half_a_metre_where_the_twin_has_nothing() -> None:
    is_wall = wall_to(50)
    distance = np.where(is_wall, WALL_M, np.inf).astype(np.float32)
    distance[:, 100:] = 60.0
    beside = surface_beside(is_wall, distance, FOCAL_PX)
    np.testing.assert_array_equal(beside[:, 50:70], WALL_M)
    assert np.isinf(beside[:, :50]).all()
    assert np.isinf(beside[:, 72:]).all()


def test_matter_that_hangs_on_to_a_wall_is_its_own_and_a_wire_beside_it_is_not() -> None:
    """Slivers of a wall whose twin ends too soon stood in the sky like posts, once a picture."""
    is_wall = wall_to(50)
    is_matter = wall_to(56)
    is_matter[:, 66:68] = True
    found = continued_surface(is_wall, is_matter)
    assert found[:, 50:57].all()
    assert not found[:, 57:].any()


def test_nothing_goes_on_where_there_is_no_surface() -> None:
    nothing = np.zeros(SHAPE, dtype=bool)
    assert not continued_surface(nothing, ~nothing).any()
    assert np.isinf(surface_beside(nothing, np.full(SHAPE, np.inf, np.float32), 400.0)).all()
