"""What `lightsim train` does: data, weights and scores in files."""

from __future__ import annotations

import logging
import shlex
from collections.abc import Mapping
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float32

from lightsim.errors import InputError
from lightsim.progress import terminal_progress
from lightsim.training.hdr_skies import split_hash
from lightsim.training.lighting_cache import (
    LightingCache,
    PrepareConfig,
    prepare_cache,
    read_cache,
    write_cache,
)
from lightsim.training.lighting_data import LightingSet
from lightsim.training.options import PrepareOptions, TrainingOptions
from lightsim.training.street_panoramas import StreetConfig
from lightsim.version import __version__

if TYPE_CHECKING:
    from lightsim.networks.loop import LoopConfig
    from lightsim.training.sky import Completion
    from lightsim.training.sky_models import SkyKind

_LOGGER = logging.getLogger(__name__)
WEIGHTS_NAME = "weights.safetensors"
SCORES_NAME = "scores.json"
_SCORED_AT_ONCE = 32
_DESCRIPTIONS = {
    "network": "completion of panoramas (docs/models/inpaint.md)",
    "lightsim": "sky dome estimator (docs/models/sky.md)",
}


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
    from lightsim.networks.devices import choose_device, joined_processes
    from lightsim.store.checkpoint import FolderJournal
    from lightsim.training import inpaint as inpaint_train
    from lightsim.training.inpaint_scores import evaluate_inpaint

    cache = read_cache(command.data)
    kind = inpaint_train.InpaintConfig
    config = kind.small() if command.preset == "small" else kind.full()
    config = replace(config, seed=command.seed, loop=_loop(config.loop, command))
    command.out.mkdir(parents=True, exist_ok=True)
    with joined_processes(choose_device(command.device)) as processes:
        weights, steps = inpaint_train.train_inpaint(
            LightingSet(cache),
            FolderJournal(command.out),
            config,
            device=command.device,
            minutes=command.minutes,
            processes=processes,
            progress=terminal_progress(),
        )
    if not processes.is_first:
        return
    test = _test_split(cache)
    stored = {name: value.half().float() for name, value in weights.items()}
    scores = evaluate_inpaint(test, stored) if test else {}
    _write(command, ("inpaint", "network"), weights, cache, steps, scores)


def train_sky_network(command: TrainingOptions, kind: SkyKind, inpaint: Path | None) -> None:
    """Train, write the weights, and score them on the fixed views of the test split."""
    from lightsim.networks.devices import choose_device, joined_processes
    from lightsim.store.checkpoint import FolderJournal
    from lightsim.training import sky as sky_train
    from lightsim.training.sky_models import sky_recipe, weights_of
    from lightsim.training.sky_scores import evaluate_sky_networks, parts_of

    cache = read_cache(command.data)
    data = LightingSet(cache)
    complete = None if inpaint is None else completion_of(inpaint)
    recipe = sky_recipe(kind, command.preset, command.seed, inpaints=inpaint is not None)
    loop = _loop(recipe.config.loop, command)
    recipe = replace(recipe, config=replace(recipe.config, loop=loop))
    command.out.mkdir(parents=True, exist_ok=True)
    with joined_processes(choose_device(command.device)) as processes:
        steps = sky_train.train_sky(
            recipe,
            data,
            FolderJournal(command.out),
            complete=complete,
            device=command.device,
            minutes=command.minutes,
            processes=processes,
            progress=terminal_progress(),
        )
    if not processes.is_first:
        return
    network = recipe.network.cpu().eval()
    test, scores = _test_split(cache), {}
    if test is not None:
        views = parts_of(test.fixed_views().batch, _SCORED_AT_ONCE)
        known = [data.batch(_SCORED_AT_ONCE, 0, k, only_sunny=False) for k in range(4)]
        rows = evaluate_sky_networks(views, {kind: network}, known, complete)  # type: ignore[dict-item]
        scores = {row.name: _known(asdict(row)) for row in rows}
    what = "sky" if kind.startswith("lightsim") else "baseline"
    _write(command, (what, kind), weights_of(network), cache, steps, scores)


def _loop(config: LoopConfig, command: TrainingOptions) -> LoopConfig:
    steps = config.steps if command.steps is None else command.steps
    return replace(config, steps=steps, is_compiled=command.is_compiled)


def _write(
    command: TrainingOptions,
    what: tuple[str, str],
    weights: Mapping[str, Any],
    cache: LightingCache,
    steps: int,
    scores: Mapping[str, Any],
) -> None:
    """The weights with their record, and the scores of all methods.

    Args:
        command: as the user gave it.
        what: the command's name, and the network's in the scores.
        weights: of the network.
        cache: that it was trained on.
        steps: done.
        scores: by method; empty where nothing was held out.
    """
    from lightsim.store.artefact import write_json
    from lightsim.store.weights import WeightsRecord, write_weights

    path, network = command.out / WEIGHTS_NAME, what[1]
    count = sum(sky.entry.split == "train" for sky in cache.skies)
    record = WeightsRecord(
        description=_DESCRIPTIONS.get(network, f"{network} (docs/models/sky.md)"),
        command=_command_line(what[0], command),
        training_data=f"{count} HDR skies, {len(cache.clear.elevation_deg)} clear skies and "
        f"{cache.view_is_test.count(False)} positions in synthetic streets",
        split_hash=split_hash(sky.entry for sky in cache.skies),
        seed=command.seed,
        steps=steps,
        scores=scores.get(network, "no data were held out"),
        licence=command.licence,
        version=__version__,
    )
    write_weights(path, weights, record)
    if scores:
        write_json(command.out / SCORES_NAME, scores)
    _LOGGER.info("%s: %s", path, record.line())


def _command_line(what: str, command: TrainingOptions) -> str:
    """The command that gives the same weights, without options that are at their default."""
    words = ["lightsim", "train", what]
    for option in fields(command):
        value = getattr(command, option.name)
        if value != option.default and option.name != "verbose":
            words.append("--" + option.name.replace("_", "-"))
            words += [] if value is True else [str(value)]
    return shlex.join(words)


def _known(row: dict[str, Any]) -> dict[str, Any]:
    """NaN is what a method does not say; JSON has null for it."""
    return {key: None if value != value else value for key, value in row.items()}


def completion_of(weights: Path) -> Completion:
    """The completion with the weights of a file, as a function of batches.

    Raises:
        ArtefactError: the file is missing or damaged.
    """
    from lightsim.lighting.panorama.inpaint import fill_by_network
    from lightsim.store.weights import read_weights

    tensors = read_weights(weights)

    def complete(
        ldr: Float32[np.ndarray, "n h w 3"], seen: Bool[np.ndarray, "n h w"]
    ) -> Float32[np.ndarray, "n h w 3"]:
        return fill_by_network(ldr, seen, tensors)

    return complete


def _test_split(cache: LightingCache) -> LightingSet | None:
    """The held-out side, or None where the cache was made without a split."""
    try:
        return LightingSet(cache, "test")
    except InputError as error:
        _LOGGER.warning("no scores: %s", error)
        return None
