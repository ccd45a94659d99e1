"""What `lightsim train` does: data, weights and scores in files."""

from __future__ import annotations

import logging
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float32

from lightsim.errors import InputError
from lightsim.progress import terminal_progress
from lightsim.training.lighting_cache import PrepareConfig, prepare_cache, write_cache
from lightsim.training.lighting_data import LightingSet
from lightsim.training.options import PrepareOptions, TrainingOptions
from lightsim.training.street_panoramas import StreetConfig

if TYPE_CHECKING:
    from lightsim.training.sky import Completion
    from lightsim.training.sky_models import SkyKind

_LOGGER = logging.getLogger(__name__)
WEIGHTS_NAME = "weights.safetensors"
SCORES_NAME = "scores.json"
_SCORED_AT_ONCE = 32


def prepare(command: PrepareOptions) -> None:
    """Write the cache.

    Raises:
        InputError: fewer than two streets or no position, no skies, or a wrong split.
    """
    if command.streets < 2 or command.positions < 1:
        raise InputError(
            "too few streets: one side of the split would be empty",
            where="--streets, --positions",
            got=f"{command.streets} and {command.positions}",
            expected="at least 2 and 1",
        )
    if not command.out.absolute().parent.is_dir():
        raise InputError(
            "the folder to write to does not exist",
            where=command.out.parent,
            remedy="Create the folder first.",
        )
    streets = StreetConfig(
        street_count=command.streets,
        test_count=max(1, command.streets // 5),
        positions=command.positions,
    )
    config = PrepareConfig(height_px=command.height, seed=command.seed, streets=streets)
    cache = prepare_cache(command.hdri, command.split, config, terminal_progress())
    write_cache(command.out, cache)
    size_mb = command.out.stat().st_size / 1e6
    _LOGGER.info(
        "%s: %d skies, %d street positions, %.1f MB",
        command.out,
        len(cache.skies),
        len(cache.views),
        size_mb,
    )


def train_inpaint(command: TrainingOptions) -> None:
    """Train the completion; weights and, where the cache has a test split, scores."""
    from lightsim.store.artefact import write_json
    from lightsim.store.checkpoint import FolderJournal, read_weights, write_weights
    from lightsim.training import inpaint as inpaint_train
    from lightsim.training.inpaint_scores import evaluate_inpaint

    data = LightingSet.load(command.data)
    kind = inpaint_train.InpaintConfig
    config = kind.small() if command.preset == "small" else kind.full()
    config = replace(config, seed=command.seed, steps=command.steps or config.steps)
    command.out.mkdir(parents=True, exist_ok=True)
    weights = inpaint_train.train_inpaint(
        data,
        FolderJournal(command.out),
        config,
        device=command.device,
        minutes=command.minutes,
        progress=terminal_progress(),
    )
    write_weights(command.out / WEIGHTS_NAME, weights)
    test = _test_split(command.data)
    if test is not None:
        scores = evaluate_inpaint(test, read_weights(command.out / WEIGHTS_NAME))
        write_json(command.out / SCORES_NAME, scores)


def train_sky_network(command: TrainingOptions, kind: SkyKind, inpaint: Path | None) -> None:
    """Train, write the weights, and score them on the fixed views of the test split."""
    from lightsim.store.artefact import write_json
    from lightsim.store.checkpoint import FolderJournal, write_weights
    from lightsim.training import sky as sky_train
    from lightsim.training.sky_models import sky_recipe, weights_of
    from lightsim.training.sky_scores import evaluate_sky_networks, parts_of

    data = LightingSet.load(command.data)
    complete = None if inpaint is None else completion_of(inpaint)
    recipe = sky_recipe(kind, command.preset, command.seed, inpaints=inpaint is not None)
    if command.steps is not None:
        loop = replace(recipe.config.loop, steps=command.steps)
        recipe = replace(recipe, config=replace(recipe.config, loop=loop))
    command.out.mkdir(parents=True, exist_ok=True)
    sky_train.train_sky(
        recipe,
        data,
        FolderJournal(command.out),
        complete=complete,
        device=command.device,
        minutes=command.minutes,
        progress=terminal_progress(),
    )
    network = recipe.network.cpu().eval()
    write_weights(command.out / WEIGHTS_NAME, weights_of(network))
    test = _test_split(command.data)
    if test is not None:
        views = parts_of(test.fixed_views().batch, _SCORED_AT_ONCE)
        known = [data.batch(_SCORED_AT_ONCE, 0, k, only_sunny=False) for k in range(4)]
        rows = evaluate_sky_networks(views, {kind: network}, known, complete)  # type: ignore[dict-item]
        write_json(command.out / SCORES_NAME, {row.name: _known(asdict(row)) for row in rows})


def _known(row: dict[str, Any]) -> dict[str, Any]:
    """NaN is what a method does not say; JSON has null for it."""
    return {key: None if value != value else value for key, value in row.items()}


def completion_of(weights: Path) -> Completion:
    """The completion with the weights of a file, as a function of batches.

    Raises:
        ArtefactError: the file is missing or damaged.
    """
    from lightsim.lighting.panorama.inpaint import fill_by_network
    from lightsim.store.checkpoint import read_weights

    tensors = read_weights(weights)

    def complete(
        ldr: Float32[np.ndarray, "n h w 3"], seen: Bool[np.ndarray, "n h w"]
    ) -> Float32[np.ndarray, "n h w 3"]:
        return fill_by_network(ldr, seen, tensors)

    return complete


def _test_split(path: Path) -> LightingSet | None:
    """The held-out side, or None where the cache was made without a split."""
    try:
        return LightingSet.load(path, "test")
    except InputError as error:
        _LOGGER.warning("no scores: %s", error)
        return None
