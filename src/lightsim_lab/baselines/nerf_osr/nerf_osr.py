"""NeRF-OSR of one street: training on the log of a work folder, storage, use by `relight`."""

from __future__ import annotations

import logging
import time
from functools import partial
from pathlib import Path

import numpy as np
import torch

from lightsim.build.workspace import Workspace
from lightsim.core.checks import check_number, check_seed
from lightsim.core.version import __version__
from lightsim.errors import InputError
from lightsim.networks.loop import Session
from lightsim.networks.stored import load_stored, stored_config, stored_tensors
from lightsim.progress import Progress
from lightsim.reconstruct.field.ray_pool import PriorSurfaces, camera_rays
from lightsim.relighting.estimate import Relight
from lightsim.render.casters.embree import make_embree_caster
from lightsim.store.artefact import hash_names
from lightsim.store.checkpoint import FolderCheckpointer
from lightsim.store.lock import LOCK_NAME, locked
from lightsim.store.weights import WeightsRecord, read_weights, write_weights
from lightsim_lab.baselines.nerf_osr.relightable import (
    NerfOsrConfig,
    RelightableField,
    field_surface,
)
from lightsim_lab.baselines.nerf_osr.train_relightable import FieldPixels, train_relightable
from lightsim_lab.baselines.relight import lighting_of, relit_field
from lightsim_lab.weights import FIELD_WEIGHTS

_LOGGER = logging.getLogger(__name__)
_KIND = "nerf-osr"
# Pixels to train on; as many as for the neural fields of `lightsim build`.
_PIXELS = 1_500_000
# Rays per training step.
_RAYS = 4096


def train_nerf_osr(
    work: Path, steps: int, seed: int, progress: Progress, *, allow_stale: bool = False
) -> Path:
    """Train the field of a street on the recorded pictures, without held-out ones.

    An interrupted training continues from its last checkpoint.

    Returns:
        The path of the weights, in the work folder.

    Raises:
        ArtefactError: the twin has not been built, or the recording has changed since.
        InputError: the log shows no surface.
    """
    check_number("--steps", steps, 1, 10_000_000)
    check_seed(seed)
    workspace = Workspace(work, is_stale_allowed=allow_stale)
    workspace.need("twin")
    path = work / FIELD_WEIGHTS
    path.parent.mkdir(exist_ok=True)
    began = time.process_time()
    # The twin is only read: other readers may run, but builds must wait.
    with locked(work / LOCK_NAME, is_shared=True), locked(path.parent / LOCK_NAME):
        # The estimated sky as initial lighting fixes the scale between albedo and light.
        first = torch.from_numpy(lighting_of(workspace.sky.dome))
        config, generator = NerfOsrConfig(), torch.Generator().manual_seed(seed)
        field = RelightableField(config, generator, first)
        pixels = _pixels(workspace, seed, progress)
        checkpointer = FolderCheckpointer(path.parent)
        session = Session(checkpointer, progress, device="cpu")
        done = train_relightable(field, pixels, steps, _RAYS, seed, session)
        write_weights(path, stored_tensors(field, config, _KIND), _record(workspace, seed, done))
        checkpointer.finish()
    _LOGGER.info("%s: %.0f processor seconds", path, time.process_time() - began)
    return path


def relight_by_field(path: Path) -> Relight:
    """Return the relighting function of a trained field.

    Raises:
        InputError, ArtefactError: the file is damaged or holds another network.
    """
    return partial(relit_field, partial(field_surface, read_field(path)))


def read_field(path: Path) -> RelightableField:
    """Read a trained field.

    Raises:
        InputError, ArtefactError: the file is damaged or holds another network.
    """
    tensors = read_weights(path)
    kind, values = stored_config(tensors)
    if kind != _KIND:
        raise InputError(
            "the file contains the weights of another network",
            where=path,
            got=kind,
            expected="weights written by lightsim train nerf-osr",
        )
    # The initial values are overwritten by the stored tensors.
    field = RelightableField(NerfOsrConfig(**values), torch.Generator())
    load_stored(field, tensors)
    return field


def _pixels(workspace: Workspace, seed: int, progress: Progress) -> FieldPixels:
    """Draw pixels of all frames, with their surface on the twin's static background."""
    log, assets = workspace.training_log, workspace.twin.assets
    guide = PriorSurfaces(make_embree_caster([assets.background]), {})
    rng = np.random.default_rng(seed)
    pool = camera_rays(log, _PIXELS, guide, workspace.sky_matte, rng, progress)
    gains = np.stack([assets.camera_gains[name] for name in log.cameras])
    return FieldPixels.of(pool, gains.astype(np.float32))


def _record(workspace: Workspace, seed: int, steps: int) -> WeightsRecord:
    frames = [f"{f.camera_name}/{f.stem}" for f in workspace.training_log.frames]
    return WeightsRecord(
        description="re-implementation of NeRF-OSR (docs/models/baselines.md)",
        command=f"lightsim train nerf-osr {workspace.root.name} --steps {steps} --seed {seed}",
        training_data="pictures of the log of this folder",
        split_hash=hash_names({"frames": frames}),
        seed=seed,
        steps=steps,
        scores="no frame was held out for scores",
        licence="as the log allows",
        version=__version__,
    )
