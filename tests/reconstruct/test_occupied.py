"""The paper's field: nothing but rays tells it where to look, and its heads know the grid alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from tests.render.rendering_scenes import constant_sky
from tests.tiny_world import BOX_LWH_M, tiny_world
from wall import WALL_M, small_config, small_field, wall_fields, wall_grid, wall_pool

from journals import MemoryJournal
from lightsim.build.sample_guide import sample_guide
from lightsim.core.log import DrivingLog
from lightsim.core.sensors import LazySweep, LidarSweep
from lightsim.progress import SilentProgress
from lightsim.reconstruct.field import config as neural_config
from lightsim.reconstruct.field.config import NeuralConfig
from lightsim.reconstruct.field.occupancy import VOXEL_M, Occupancy
from lightsim.reconstruct.field.occupied_fields import occupied_fields
from lightsim.reconstruct.field.ray_pool import PriorSurfaces
from lightsim.reconstruct.field.refine import signed_distances
from lightsim.reconstruct.field.sampling import place_samples
from lightsim.reconstruct.field.sdf_field import SeparateHeads
from lightsim.reconstruct.field.train import TrainingRays, batch_of, train_field
from lightsim.reconstruct.fusion.config import OccupiedConfig

WALL_X_M = 7.1
"""In the voxel from 7.0 m to 7.5 m, whose neighbours make it 6.5 m to 8.0 m."""


def log_of(points: np.ndarray) -> DrivingLog:
    """The tiny world with one sweep of these returns."""
    count = len(points)
    flat = np.zeros(count, np.float32)
    unknown = np.full(count, -1, np.int16)
    origins = np.zeros((count, 3), np.float32)
    sweep = LidarSweep("00", 0, points.astype(np.float32), origins, flat, flat, unknown, unknown)
    log = tiny_world(constant_sky()).log
    return replace(log, sweeps=(LazySweep("00", 0, lambda: sweep),))


def wall_log() -> DrivingLog:
    y, z = np.meshgrid(np.arange(-4, 4, 0.2), np.arange(0, 3, 0.2))
    return log_of(np.stack([np.full(y.size, WALL_X_M), y.ravel(), z.ravel()], axis=1))


def occupancy_of(log: DrivingLog) -> Occupancy:
    return Occupancy.of_returns(log, np.zeros((2, 3)), 10.0, SilentProgress())


def small_paper(**changes: object) -> NeuralConfig:
    grids = {name: getattr(small_config(), name) for name in ("background_grid", "actor_grid")}
    batches = {"camera_batch": 256, "lidar_batch": 256}
    return replace(neural_config.paper(), **(grids | batches | changes))  # type: ignore[arg-type]


def test_rays_are_searched_where_returns_are_and_in_no_box() -> None:
    found = occupancy_of(wall_log())
    origin = np.tile([0.0, 0.1, 1.0], (3, 1))
    direction = np.array([[1.0, 0, 0], [-1.0, 0, 0], [1.0, 0, 0]])
    boxes = np.full((3, 2, 2), np.inf, np.float32)
    boxes[2, 0] = [6.0, 9.0]
    stretches = found.stretches_m(origin, direction, boxes)
    np.testing.assert_allclose(stretches[0, 0], [6.5, 8.0], atol=VOXEL_M / 4)
    assert (stretches[0, 1:] == 0).all()
    assert (stretches[1:] == 0).all()


def test_samples_fill_occupied_space_and_boxes_more_densely() -> None:
    pool = wall_pool(400, is_lidar=False, room_m=1.0)
    pool.slot_actor[200:, 0] = 0
    pool.slot_span_m[200:, 0] = [1.0, 2.0]
    t = place_samples(batch_of(pool, torch.device("cpu")), torch.Generator().manual_seed(0)).numpy()
    assert (t[:, 1:] >= t[:, :-1]).all()
    start, end = pool.occupied_m[:, 0].T
    is_there = (t >= start[:, None] - 1e-4) & (t <= end[:, None] + 1e-4)
    assert is_there[:200].all()
    in_box = (t >= 1.0) & (t <= 2.0)
    assert (is_there | in_box)[200:].all()
    # A metre in a box counts as four elsewhere.
    expected = 4.0 / (4.0 + (end - start)[200:])
    assert np.abs(in_box[200:].mean(axis=1) - expected).max() < 1.5 / t.shape[1]


def test_the_field_is_read_out_where_returns_are_and_in_boxes() -> None:
    log = wall_log()
    config = OccupiedConfig((0.25,), (10.0,), 0.25)
    fields = occupied_fields(log, config, progress=SilentProgress())
    (grid,) = fields.background
    points = np.concatenate([grid.positions(b) for b in range(len(grid.block_coords))])
    x, y, z = points[grid.weight.reshape(points.shape[:3]) > 0].T
    assert (x.min(), x.max()) == (WALL_X_M // VOXEL_M * VOXEL_M - 0.5, 7.75)
    assert (y.min(), y.max()) == (-4.5, 4.25)
    assert (z.min(), z.max()) == (-0.5, 3.25)
    # Nothing is known of the surface before the field is read out.
    assert (grid.sdf_m == grid.truncation_m).all()
    (box,) = fields.actors.values()
    inside = np.concatenate([box.positions(b) for b in range(len(box.block_coords))])
    reach = np.abs(inside[box.weight.reshape(inside.shape[:3]) > 0]).max(axis=0)
    np.testing.assert_allclose(reach, BOX_LWH_M / 2 + 0.1, atol=config.actor_voxel_m)


def test_heads_know_features_alone_and_nothing_of_each_other() -> None:
    field = small_field(small_paper(), None)
    points, nobody = torch.rand(50, 3), torch.full((50,), -1)
    heads = field.background_head
    assert isinstance(heads, SeparateHeads)
    with torch.no_grad():
        before = field(points, nobody)
        for weights in heads.colour.parameters():
            weights.add_(1.0)
        after = field(points, nobody)
        field.background_table.zero_()
        empty = field(points, nobody)
    assert torch.equal(before[0], after[0])
    assert not torch.allclose(before[1], after[1])
    assert before[0].std() > 0
    for values in empty[:2]:
        assert (values == values[0]).all()


def test_rays_alone_teach_colour_and_depth() -> None:
    """The wall stands 0.3 m behind the middle of 2.6 m that are known to be occupied. The paper's
    losses put the zero level behind what is seen as long as its opacity is soft."""
    field = small_field(small_paper(steps=300), None)
    pools = [wall_pool(4000, is_lidar, room_m=1.0) for is_lidar in (False, True)]
    for pool in pools:
        pool.occupied_m[..., 0] -= 0.6
    journal = MemoryJournal()
    train_field(field, TrainingRays(*pools), 0, journal.session())
    assert journal.lines[-1]["depth_error_m"] < 0.3
    assert journal.lines[-1]["psnr_db"] > 25
    across = np.random.default_rng(0).uniform(-1, 1, (400, 2)) * [2.0, 1.0]
    before, behind = (
        signed_distances(field, np.insert(across, 0, x, axis=1).astype(np.float32), -1)
        for x in (WALL_M - 0.6, WALL_M + 0.9)
    )
    assert np.mean(before > 0) > 0.9
    assert np.mean(behind < 0) > 0.8


def test_the_guide_is_the_fused_surface_or_else_the_space_around_returns() -> None:
    log, fields = wall_log(), wall_fields(0.2)
    fields = replace(fields, actors={"car": replace(wall_grid(0.1, 1.0), frame="actor")})
    start, ahead = np.zeros((1, 3)), np.array([[1.0, 0.0, 0.0]])
    fused = sample_guide(log, fields, small_config(), SilentProgress())
    assert isinstance(fused, PriorSurfaces)
    for caster, offset_m in ((fused.background, 0.2), (fused.actors["car"], 1.0)):
        hits = caster.intersect(start, ahead)
        np.testing.assert_allclose(hits.distance_m, WALL_M + offset_m, atol=1e-5)
    around = sample_guide(log, fields, small_paper(), SilentProgress())
    assert isinstance(around, Occupancy)
    places = np.array([[WALL_X_M, 0.0, 1.0], [WALL_M, 0.0, 1.0]])
    assert around.holds(places).tolist() == [True, False]
