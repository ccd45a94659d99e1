"""The neural field: rendering, prior, sampling, and a training that must find a known wall."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from wall import WALL_M, small_config, small_field, wall_fields, wall_pool

from journals import MemoryJournal
from lightsim.core.frames import RigidTransform
from lightsim.errors import ArtefactError, InputError
from lightsim.networks.devices import choose_device
from lightsim.progress import SilentProgress
from lightsim.reconstruct.field import config as neural_config
from lightsim.reconstruct.field.losses import scene_loss
from lightsim.reconstruct.field.prior_torch import TorchPrior
from lightsim.reconstruct.field.ray_pool import RayPool
from lightsim.reconstruct.field.refine import refined_fields
from lightsim.reconstruct.field.sampling import place_samples
from lightsim.reconstruct.field.train import TrainingRays, batch_of, train_field
from lightsim.reconstruct.field.tsdf_prior import TsdfPrior
from lightsim.reconstruct.field.volume_rendering import composite, crossings_m, opacities
from lightsim.store.checkpoint import FolderCheckpointer


def test_opaque_wall_gives_all_weight_and_its_exact_depth() -> None:
    """A steep linear distance: weight 1, and the interpolated crossing is the wall itself."""
    t = torch.sort(torch.rand(64, 12, generator=torch.Generator().manual_seed(0)), dim=1).values
    t = t + 2.0
    wall = torch.full((64, 1), 2.5)
    sdf = wall - t
    rendered = composite(opacities(sdf, torch.tensor(400.0), "neus"))
    has_passed = (sdf[:, -1] < -0.05) & (sdf[:, 0] > 0.05)
    depth = rendered.mean(crossings_m(t, sdf, "neus"))[has_passed]
    assert torch.allclose(depth, torch.full_like(depth, 2.5), atol=2e-3)
    assert (rendered.weights.sum(dim=1)[has_passed] > 0.999).all()


def test_weights_and_transmittance_sum_to_one() -> None:
    opacity = torch.rand(50, 9, generator=torch.Generator().manual_seed(1))
    rendered = composite(opacity)
    total = rendered.weights.sum(dim=1) + rendered.transmittance
    assert torch.allclose(total, torch.ones(50), atol=1e-4)


def test_prior_look_up_equals_its_torch_twin_and_the_plane() -> None:
    prior = TsdfPrior.of(wall_fields(0.0))
    points = (
        np.random.default_rng(0).uniform([0.5, -4, -2], [8, 4, 2.2], (2000, 3)).astype(np.float32)
    )
    ranges = np.tile(np.array(prior.background, dtype=np.int32), (len(points), 1))
    found = prior.look_up(points, ranges)
    twin = TorchPrior(prior.stack, torch.device("cpu"))
    assert np.allclose(
        found, twin.look_up(torch.from_numpy(points), torch.from_numpy(ranges)).numpy(), atol=2e-4
    )
    near = (found[:, 1] > 0) & (np.abs(points[:, 0] - WALL_M) < 0.15)
    assert near.sum() > 20
    assert np.allclose(found[near, 0], WALL_M - points[near, 0], atol=1e-4)


def test_samples_are_sorted_and_surround_the_surface() -> None:
    batch = batch_of(wall_pool(300, is_lidar=False), torch.device("cpu"))
    t = place_samples(batch, torch.Generator().manual_seed(0))
    assert (t[:, 1:] >= t[:, :-1]).all()
    assert (
        (t < batch.surface_m[:, None]).any(dim=1) & (t > batch.surface_m[:, None]).any(dim=1)
    ).all()


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def test_training_corrects_a_displaced_prior(device: str) -> None:
    """The prior stands 6 cm off with little evidence: returns pull the surface back."""
    if device == "cuda" and not torch.cuda.is_available():
        pytest.skip("needs a CUDA device")
    fields = wall_fields(0.06, weight=0.1)
    config = small_config(steps=80)
    field = small_field(config, fields).to(device)
    rays = TrainingRays(wall_pool(4000, False), wall_pool(4000, True))
    train_field(field, rays, 0, MemoryJournal().session())
    refined = refined_fields(fields, field, progress=SilentProgress()).background[0]
    points = _wall_points()
    before = np.abs(TsdfPrior.of(fields).look_up(points, _ranges(points))[:, 0])
    after = np.abs(
        TsdfPrior.of(replace(fields, background=(refined,))).look_up(points, _ranges(points))[:, 0]
    )
    assert np.median(before) > 0.055
    assert np.median(after) < 0.02
    assert np.array_equal(refined.weight, fields.background[0].weight)


def test_damaged_checkpoint_is_one_clear_error(tmp_path: Path) -> None:
    (tmp_path / "checkpoint.pt").write_bytes(b"PK not a checkpoint")
    with pytest.raises(ArtefactError, match="checkpoint"):
        FolderCheckpointer(tmp_path).load()


def test_paper_preset_uses_the_papers_terms_alone() -> None:
    config = replace(
        neural_config.paper(),
        background_grid=small_config().background_grid,
        actor_grid=small_config().actor_grid,
    )
    field = small_field(config, None)
    batch = batch_of(
        RayPool.joined([wall_pool(64, False), wall_pool(64, True)]), torch.device("cpu")
    )
    total, terms = scene_loss(field, batch, torch.Generator().manual_seed(0))
    w = config.weights
    expected = terms["rgb"] + w.lidar * terms["lidar"] + w.eikonal * terms["eikonal"]
    expected = expected + w.occupancy * terms["occupancy"]
    assert torch.allclose(total, expected)


def test_samples_in_a_box_belong_to_its_actor() -> None:
    pose = RigidTransform.from_yaw("world", "actor", 0.3, np.array([4.0, 0.0, 0.0]))
    pool = wall_pool(50, False)
    inverse = pose.inverse()
    span = np.full((50, 2, 2), np.inf, np.float32)
    span[:, 0] = [3.0, 4.0]
    actor = np.full((50, 2), -1, np.int32)
    actor[:, 0] = 2
    local = np.zeros((50, 2, 3), np.float32)
    local_direction = np.zeros((50, 2, 3), np.float32)
    local[:, 0] = inverse.apply(pool.origin.astype(np.float64))
    local_direction[:, 0] = inverse.rotate(pool.direction.astype(np.float64))
    boxed = replace(
        pool, slot_actor=actor, slot_span_m=span, slot_origin=local, slot_direction=local_direction
    )
    batch = batch_of(boxed, torch.device("cpu"))
    points, owner = batch.points(torch.tensor([[1.0, 3.5]]).expand(50, 2))
    owner, points = owner.reshape(50, 2), points.reshape(50, 2, 3)
    assert (owner[:, 0] == -1).all()
    assert (owner[:, 1] == 2).all()
    world = pool.origin + 3.5 * pool.direction
    assert np.allclose(points[:, 1].numpy(), inverse.apply(world.astype(np.float64)), atol=1e-5)


@pytest.mark.skipif(torch.cuda.is_available(), reason="a CUDA device is here")
def test_cuda_without_a_device_is_one_clear_error() -> None:
    with pytest.raises(InputError, match="no CUDA device"):
        choose_device("cuda")


def _wall_points() -> np.ndarray:
    rng = np.random.default_rng(5)
    return np.stack(
        [np.full(500, WALL_M), rng.uniform(-2, 2, 500), rng.uniform(-1, 1, 500)], axis=1
    ).astype(np.float32)


def _ranges(points: np.ndarray) -> np.ndarray:
    return np.tile(np.array([0, 1], dtype=np.int32), (len(points), 1))


def test_a_short_log_needs_fewer_steps_than_a_long_one() -> None:
    steps = [
        neural_config.standard().with_steps_for(sweeps).steps for sweeps in (3, 20, 30, 40, 80)
    ]
    assert steps == [1000, 1000, 1500, 2000, 2000]
    # Steps that were asked for, and those of the paper, do not depend on the log.
    asked = replace(neural_config.standard(), steps=70, steps_a_sweep=None)
    paper = neural_config.paper()
    assert [c.with_steps_for(3) for c in (asked, paper)] == [asked, paper]
