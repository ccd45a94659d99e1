"""The edge of a tree before an inserted actor: the mesh's, and the picture's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lightsim.core.buffers import BACKGROUND, GBuffers
from lightsim.relighting.physical.occlusion import occlusion_from_picture

H, W = 60, 90
MESH_EDGE, LEAF_EDGE = 30, 36
LEAF, WALL = np.array([0.2, 0.4, 0.15]), np.array([0.6, 0.58, 0.5])
TREE_M, ACTOR_M = 10.0, 14.0
FOCAL_PX = 1000.0
"""0.12 m at the tree are 12 pixels."""


def buffers() -> GBuffers:
    """A tree on the left, an actor behind it that fills the right."""
    is_tree = np.arange(W) < MESH_EDGE
    depth = np.tile(np.where(is_tree, TREE_M, ACTOR_M).astype(np.float32), (H, 1))
    nothing = np.zeros((H, W, 3), np.float32)
    towards = np.tile(np.array([-1.0, 0.0, 0.0], np.float32), (H, W, 1))
    actor = np.tile(np.where(is_tree, BACKGROUND, 4).astype(np.int32), (H, 1))
    return GBuffers(depth, nothing, towards, nothing, nothing[..., 0], actor)


def picture(behind: np.ndarray = WALL) -> np.ndarray:
    """The tree's leaves reach farther than its mesh."""
    rng = np.random.default_rng(0)
    is_leaf = (np.arange(W) < LEAF_EDGE)[None, :, None]
    codes = np.where(is_leaf, LEAF, behind) + 0.03 * rng.standard_normal((H, W, 3))
    return np.clip(codes, 0, 1).astype(np.float32)


def hidden(codes: np.ndarray, street: GBuffers) -> np.ndarray:
    return occlusion_from_picture(codes, street, street.actor_index == 4, FOCAL_PX)


def test_leaves_that_the_mesh_lacks_hide_the_actor() -> None:
    found = hidden(picture(), buffers())
    assert found[:, MESH_EDGE:LEAF_EDGE].mean() > 0.9
    assert found[:, LEAF_EDGE + 1 :].max() < 0.2
    assert found[:, LEAF_EDGE + 1 :].mean() < 0.01
    assert (found[:, : MESH_EDGE - 1] == 0).all()


@pytest.mark.parametrize("why", ["one colour", "ground", "touches", "an actor", "none new"])
def test_nothing_is_hidden_where_the_picture_does_not_tell(why: str) -> None:
    street, codes = buffers(), picture()
    if why == "one colour":
        codes = picture(LEAF)
    elif why == "ground":
        street = replace(street, normal_world=street.normal_world[..., [1, 1, 0]] * -1)
    elif why == "touches":
        street = replace(street, depth_z_m=np.minimum(street.depth_z_m, TREE_M + 0.3))
    elif why == "an actor":
        street = replace(street, actor_index=np.maximum(street.actor_index, 2))
    else:
        street = replace(street, actor_index=np.minimum(street.actor_index, 3))
    assert hidden(codes, street).mean() < (0.01 if why == "one colour" else 1e-9)
