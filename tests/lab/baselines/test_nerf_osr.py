"""The neural field that can be relit, on a wall whose colours are known."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tests.reconstruct.wall import WALL_M, wall_pool

from lightsim import cli
from lightsim.build.workspace import Workspace
from lightsim.errors import InputError
from lightsim.networks.loop import Session
from lightsim.networks.stored import stored_tensors
from lightsim.progress import SilentProgress
from lightsim.reconstruct.field.ray_pool import RayPool
from lightsim.simulation.options import RelightOptions
from lightsim.simulation.relight_methods import relight_of, weights_hash
from lightsim.store.artefact import hash_file
from lightsim.store.checkpoint import FolderCheckpointer
from lightsim.store.images import read_srgb8
from lightsim.store.weights import WeightsRecord, read_record, write_weights
from lightsim_lab.baselines.nerf_osr.nerf_osr import read_field, train_nerf_osr
from lightsim_lab.baselines.nerf_osr.relightable import (
    FieldRays,
    NerfOsrConfig,
    RelightableField,
    field_surface,
)
from lightsim_lab.baselines.nerf_osr.train_relightable import FieldPixels, train_relightable
from lightsim_lab.baselines.spherical_harmonics import COUNT
from lightsim_lab.weights import FIELD_WEIGHTS

SMALL = NerfOsrConfig(levels=4, log2_entries=12, coarsest_m=2.0, finest_m=0.25, hidden=16)
GAINS = np.ones((1, 3), np.float32)


def even_light(radiance: float) -> torch.Tensor:
    """From everywhere the same."""
    light = torch.zeros(COUNT, 3)
    light[0] = radiance * np.sqrt(4 * np.pi)
    return light


def new_field(radiance: float = 1.0) -> RelightableField:
    return RelightableField(SMALL, torch.Generator().manual_seed(0), even_light(radiance))


def lit_wall(count: int) -> RayPool:
    pool = wall_pool(count, is_lidar=False)
    surface = (WALL_M / pool.direction[:, 0]).astype(np.float32)
    return replace(pool, surface_m=surface, camera=np.zeros(count, np.int32))


def test_a_field_learns_the_colours_of_a_wall_and_brightens_with_the_light(tmp_path: Path) -> None:
    pixels, field = FieldPixels.of(lit_wall(4000), GAINS), new_field()
    session = Session(FolderCheckpointer(tmp_path), SilentProgress())
    assert train_relightable(field, pixels, 150, 256, 0, session) == 150
    rays = FieldRays(torch.from_numpy(pixels.point), torch.from_numpy(pixels.direction))
    with torch.no_grad():
        shown = field(rays, field.light)
        error = (shown.pixels(field.light) - torch.from_numpy(pixels.colour)).square().mean()
        brighter = shown.pixels(4 * field.light) / shown.pixels(field.light)
    assert float(error) < 0.1 * float(torch.from_numpy(pixels.colour).var())
    torch.testing.assert_close(brighter, torch.full_like(brighter, 4 ** (1 / 2.2)))
    torch.testing.assert_close(shown.normal.norm(dim=1), torch.ones(len(pixels)))
    assert float(shown.depth_m.abs().max()) <= SMALL.half_band_m
    surface = field_surface(field, pixels.point, pixels.direction, field.light.detach().numpy())
    np.testing.assert_allclose(surface.albedo, shown.albedo.numpy() ** 2.2, rtol=1e-4, atol=1e-5)
    assert surface.normal_world.shape == (len(pixels), 3)
    assert surface.shadow.min() >= 0


def test_samples_lie_within_half_a_metre_of_the_surface() -> None:
    field = new_field()
    places = field._places(1000, torch.Generator().manual_seed(1))
    assert places.shape == (1000, 8)
    assert float(places.abs().max()) <= 0.5
    assert bool((places.diff(dim=1) > 0).all())
    assert float(places.std()) == pytest.approx(1 / np.sqrt(12), rel=0.02)


def test_sky_and_actors_teach_nothing() -> None:
    pool = lit_wall(100)
    sky = pool.sky.copy()
    sky[:40] = 1
    slot, span = pool.slot_actor.copy(), pool.slot_span_m.copy()
    slot[40:70, 0], span[40:70, 0] = 0, (2.0, 4.0)
    kept = FieldPixels.of(replace(pool, sky=sky, slot_actor=slot, slot_span_m=span), GAINS)
    assert len(kept) == 30
    np.testing.assert_allclose(kept.point[:, 0], WALL_M, rtol=1e-5)
    with pytest.raises(InputError, match="static background"):
        FieldPixels.of(replace(pool, sky=np.ones_like(pool.sky)), GAINS)


def test_a_stored_field_comes_back_and_another_networks_is_refused(tmp_path: Path) -> None:
    record, path = WeightsRecord("a", "b", "c", "d", 0, 1, {}, "e", "f"), tmp_path / "w.safetensors"
    field = new_field(0.7)
    write_weights(path, stored_tensors(field, SMALL, "nerf-osr"), record)
    again = read_field(path)
    assert again.config == SMALL
    torch.testing.assert_close(again.light, field.light, atol=1e-3, rtol=1e-3)
    write_weights(path, stored_tensors(field, SMALL, "sky"), record)
    with pytest.raises(InputError, match="another network"):
        read_field(path)


def test_a_street_uses_the_field_in_its_own_folder(tmp_path: Path) -> None:
    options, work = RelightOptions(name="x", method="nerf-osr"), Workspace(tmp_path)
    with pytest.raises(InputError, match="no weights of --method nerf-osr"):
        weights_hash(work, options)
    path = tmp_path / FIELD_WEIGHTS
    path.parent.mkdir()
    record = WeightsRecord("a", "b", "c", "d", 0, 1, {}, "e", "f")
    write_weights(path, stored_tensors(new_field(), SMALL, "nerf-osr"), record)
    assert relight_of(work, options)
    assert weights_hash(work, options) == {"weights": hash_file(path)}
    assert weights_hash(work, RelightOptions(name="x", method="physical")) == {}


@pytest.mark.slow
def test_a_street_s_field_is_trained_from_its_pictures_and_relights_them(
    built_street: Any,
) -> None:
    """Nothing of the street but its own pictures: one seed gives one field, which explains the
    colours better the longer it learns."""
    work = Workspace(built_street.work)
    path, losses = built_street.work / FIELD_WEIGHTS, []
    try:
        for steps in (1, 30, 30):
            assert train_nerf_osr(work.root, steps, 3, SilentProgress()) == path
            losses.append(hash_file(path))
        assert losses[1] == losses[2] != losses[0]
        record = read_record(path)
        assert (record.seed, record.steps) == (3, 30)
        assert np.isfinite(read_field(path).light.detach().numpy()).all()
        words = ("--method", "nerf-osr", "--sky", "sun:73,30", "--name", "field")
        chosen = ("--cameras", "left_camera", "--frames", "2:3")
        cli.main(["relight", str(work.root), *words, *chosen])
        made = work.root / "scenarios" / "field" / "frames" / "left_camera" / "02.png"
        assert read_srgb8(made).std() > 5
    finally:
        shutil.rmtree(path.parent)
        shutil.rmtree(work.root / "scenarios" / "field", ignore_errors=True)
