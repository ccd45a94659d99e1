"""What fills a view where no recorded picture shows what is there."""

from __future__ import annotations

import numpy as np
import pytest

from lightsim.simulation.unobserved import completed_by_twin

SHAPE = 64, 96
SKYLINE = 32
SKY, WALL = np.array([0.4, 0.6, 0.9]), np.array([0.5, 0.3, 0.2])


def guessed(hole: tuple[slice, slice], *, is_surface_there: bool) -> np.ndarray:
    """A wall below a sky, with one hole; the twin is half as bright as the pictures."""
    is_wall = np.zeros(SHAPE, dtype=bool)
    is_wall[SKYLINE:] = True
    is_observed = np.ones(SHAPE, dtype=bool)
    is_observed[hole] = False
    truth = np.dstack([np.where(is_wall[..., None], WALL, SKY), ~is_wall]).astype(np.float32)
    is_surface = is_wall.copy()
    is_surface[hole] = is_surface_there
    rendered = 0.5 * np.where(is_surface[..., None], WALL, SKY).astype(np.float32)
    seen = np.where(is_observed[..., None], truth, 0).astype(np.float32)
    found = completed_by_twin(seen, rendered, is_observed, is_surface)
    np.testing.assert_array_equal(found[is_observed], truth[is_observed])
    return found[hole].reshape(-1, 4)


def test_a_gap_in_matter_that_no_picture_looks_into_is_matter() -> None:
    """It was the target's sky: bright specks in crowns and beside walls."""
    found = guessed(np.s_[45:50, 40:46], is_surface_there=False)
    np.testing.assert_allclose(found, np.broadcast_to([*WALL, 0], found.shape), atol=1e-4)


@pytest.mark.parametrize(
    ("hole", "is_surface_there", "expected"),
    [
        (np.s_[8:14, 40:46], False, [*SKY, 1]),
        (np.s_[45:50, 40:46], True, [*WALL, 0]),
    ],
)
def test_sky_and_surfaces_of_the_twin_follow_the_pictures(
    hole: tuple[slice, slice], is_surface_there: bool, expected: list[float]
) -> None:
    found = guessed(hole, is_surface_there=is_surface_there)
    np.testing.assert_allclose(found, np.broadcast_to(expected, found.shape), atol=2e-3)


def test_a_hole_that_opens_to_the_sky_is_sky_as_a_whole() -> None:
    """Its lower half was matter in the colour of sky, and shone under a darker one."""
    opening = guessed(np.s_[SKYLINE - 8 : SKYLINE + 8, 40:46], is_surface_there=False)
    np.testing.assert_array_equal(opening[:, 3], 1)


def test_without_any_picture_the_twin_is_shown() -> None:
    rendered = np.full((*SHAPE, 3), 0.3, dtype=np.float32)
    is_surface = np.zeros(SHAPE, dtype=bool)
    is_surface[SKYLINE:] = True
    nothing = np.zeros((*SHAPE, 4), dtype=np.float32)
    found = completed_by_twin(nothing, rendered, np.zeros(SHAPE, dtype=bool), is_surface)
    np.testing.assert_array_equal(found[..., :3], rendered)
    np.testing.assert_array_equal(found[..., 3], ~is_surface)
