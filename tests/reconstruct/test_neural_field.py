"""The neural field: rendering, prior, sampling, and a training that must find a known wall."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from lightsim.core.fields import BLOCK, GroundMap, SceneFields, TsdfGrid
from lightsim.core.frames import RigidTransform
from lightsim.errors import ArtefactError, InputError
from lightsim.progress import SilentProgress
from lightsim.reconstruct.field import config as neural_config
from lightsim.reconstruct.field import train
from lightsim.reconstruct.field.hash_grid.spec import HashGridSpec
from lightsim.reconstruct.field.losses import scene_loss
from lightsim.reconstruct.field.neural import choose_device
from lightsim.reconstruct.field.prior_torch import TorchPrior
from lightsim.reconstruct.field.ray_pool import RayPool
from lightsim.reconstruct.field.refine import refined_fields
from lightsim.reconstruct.field.sampling import place_samples
from lightsim.reconstruct.field.sdf_field import SceneField
from lightsim.reconstruct.field.train import TrainingRays, batch_of, train_field
from lightsim.reconstruct.field.tsdf_prior import TsdfPrior
from lightsim.reconstruct.field.volume_rendering import composite, crossings_m, opacities
from lightsim.store.checkpoint import FolderJournal

WALL_M = 5.0


def _grid(voxel_m: float, offset_m: float, weight: float = 4.0) -> TsdfGrid:
    """A wall at x = WALL_M + offset that faces -x, known in a slab around it."""
    coords = np.argwhere(np.ones((8, 8, 4), dtype=bool)).astype(np.int32)
    steps = np.stack(np.meshgrid(*[np.arange(BLOCK)] * 3, indexing="ij"), axis=-1)
    origin = np.array([1.0, -3.2, -1.6])
    x = origin[0] + voxel_m * (BLOCK * coords[:, None, None, None] + steps)[..., 0]
    sdf = np.clip(WALL_M + offset_m - x, -3 * voxel_m, 3 * voxel_m).astype(np.float32)
    weights = np.where(sdf > -3 * voxel_m, weight, 0.0).astype(np.float32)
    return TsdfGrid("world", origin, voxel_m, 3 * voxel_m, coords, sdf, weights)


def _fields(offset_m: float, weight: float = 4.0) -> SceneFields:
    flat = np.full((4, 4), -1.6, dtype=np.float32)
    ground = GroundMap(np.zeros(2), 1.0, flat, np.ones((4, 4), dtype=bool))
    return SceneFields(
        (_grid(0.1, offset_m, weight),), (50.0,), {}, ground, np.zeros((2, 3)), ("fused",)
    )


def _pool(count: int, is_lidar: bool) -> RayPool:
    """Rays from the origin at the wall, which is red on one side and green on the other."""
    rng = np.random.default_rng(3)
    target = np.stack(
        [np.full(count, WALL_M), rng.uniform(-2.5, 2.5, count), rng.uniform(-1.2, 1.2, count)],
        axis=1,
    )
    distance = np.linalg.norm(target, axis=1)
    colour = np.where(target[:, 1:2] > 0, [[0.8, 0.2, 0.2]], [[0.2, 0.7, 0.2]])
    f32, far = np.float32, np.full((count, 2, 2), np.inf, np.float32)
    return RayPool(
        np.zeros((count, 3), f32),
        (target / distance[:, None]).astype(f32),
        np.full((count, 2), -1, np.int32),
        far,
        np.zeros((count, 2, 3), f32),
        np.zeros((count, 2, 3), f32),
        distance.astype(f32),
        colour.astype(f32) * (0.0 if is_lidar else 1.0),
        np.full(count, -1 if is_lidar else 0, np.int32),
        np.zeros(count, f32),
        distance.astype(f32) if is_lidar else np.full(count, np.inf, f32),
        np.full(count, 0 if is_lidar else -1, np.int32),
    )


def _config(**changes: object) -> neural_config.NeuralConfig:
    small = HashGridSpec(levels=6, log2_entries=14, coarsest_m=2.0, finest_m=0.1)
    base = replace(
        neural_config.standard(),
        background_grid=small,
        actor_grid=small,
        camera_batch=256,
        lidar_batch=256,
    )
    return replace(base, **changes)  # pyright: ignore[reportArgumentType]


def _field(config: neural_config.NeuralConfig, fields: SceneFields | None) -> SceneField:
    prior = TsdfPrior.of(fields) if fields is not None else None
    return SceneField(config, (), ("front",), prior, torch.Generator().manual_seed(1))


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
    prior = TsdfPrior.of(_fields(0.0))
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
    batch = batch_of(_pool(300, is_lidar=False), torch.device("cpu"))
    t = place_samples(batch, torch.Generator().manual_seed(0))
    assert (t[:, 1:] >= t[:, :-1]).all()
    assert (
        (t < batch.surface_m[:, None]).any(dim=1) & (t > batch.surface_m[:, None]).any(dim=1)
    ).all()


def test_training_corrects_a_displaced_prior() -> None:
    """The prior stands 6 cm off with little evidence: returns pull the surface back."""
    fields = _fields(0.06, weight=0.1)
    config = _config(steps=80)
    field = _field(config, fields)
    rays = TrainingRays(_pool(4000, False), _pool(4000, True))
    train_field(field, rays, _Memory(), 0, progress=SilentProgress())
    refined = refined_fields(fields, field, progress=SilentProgress()).background[0]
    points = _wall_points()
    before = np.abs(TsdfPrior.of(fields).look_up(points, _ranges(points))[:, 0])
    after = np.abs(
        TsdfPrior.of(replace(fields, background=(refined,))).look_up(points, _ranges(points))[:, 0]
    )
    assert np.median(before) > 0.055
    assert np.median(after) < 0.02
    assert np.array_equal(refined.weight, fields.background[0].weight)


def test_interrupted_training_equals_uninterrupted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(train, "_SAVE_EVERY_S", 0.0)
    config = _config(steps=12)
    rays = TrainingRays(_pool(500, False), _pool(500, True))
    whole = _field(config, _fields(0.0))
    train_field(whole, rays, _Memory(), 7, progress=SilentProgress())
    with pytest.raises(KeyboardInterrupt):
        train_field(
            _field(config, _fields(0.0)), rays, FolderJournal(tmp_path), 7, progress=_Stopping(5)
        )
    assert (tmp_path / "checkpoint.pt").is_file()
    second = _field(config, _fields(0.0))
    train_field(second, rays, FolderJournal(tmp_path), 7, progress=SilentProgress())
    for name, value in whole.state_dict().items():
        assert torch.equal(value, second.state_dict()[name]), name
    steps = [
        json.loads(line)["step"] for line in (tmp_path / "metrics.jsonl").read_text().splitlines()
    ]
    assert steps == [0, 11]


def test_damaged_checkpoint_is_one_clear_error(tmp_path: Path) -> None:
    (tmp_path / "checkpoint.pt").write_bytes(b"PK not a checkpoint")
    with pytest.raises(ArtefactError, match="checkpoint"):
        FolderJournal(tmp_path).load()


def test_paper_preset_uses_the_papers_terms_alone() -> None:
    config = replace(
        neural_config.paper(),
        background_grid=_config().background_grid,
        actor_grid=_config().actor_grid,
    )
    field = _field(config, None)
    batch = batch_of(RayPool.joined([_pool(64, False), _pool(64, True)]), torch.device("cpu"))
    total, terms = scene_loss(field, batch, torch.Generator().manual_seed(0))
    w = config.weights
    expected = terms["rgb"] + w.lidar * terms["lidar"] + w.eikonal * terms["eikonal"]
    expected = expected + w.occupancy * terms["occupancy"]
    assert torch.allclose(total, expected)


def test_samples_in_a_box_belong_to_its_actor() -> None:
    pose = RigidTransform.from_yaw("world", "actor", 0.3, np.array([4.0, 0.0, 0.0]))
    pool = _pool(50, False)
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


class _Memory:
    def load(self) -> None:
        return None

    def save(self, state: dict) -> None:
        self.state = state

    def record(self, metrics: dict) -> None:
        self.metrics = metrics


class _Stopping:
    """Progress that interrupts before a given step."""

    def __init__(self, step: int) -> None:
        self._step = step

    def track(self, items, description, total=None):
        for item in items:
            if item == self._step:
                raise KeyboardInterrupt
            yield item
