"""Commands of `lightsim train` for the lighting networks: data, weights and scores in files."""

from __future__ import annotations

import logging
import shlex
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float32

from lightsim.core.checks import check_number
from lightsim.core.version import __version__
from lightsim.errors import InputError
from lightsim.lighting.weights import tensors_of
from lightsim.progress import terminal_progress
from lightsim.store.artefact import write_json
from lightsim.store.weights import WeightsRecord, read_weights, write_weights
from lightsim_lab.training.hdr_skies import split_hash
from lightsim_lab.training.lighting_cache import (
    LightingCache,
    PrepareConfig,
    prepare_cache,
    read_cache,
    write_cache,
)
from lightsim_lab.training.lighting_data import LightingSet
from lightsim_lab.training.options import PrepareOptions, RunOptions, TrainingOptions
from lightsim_lab.training.street_panoramas import StreetConfig

if TYPE_CHECKING:
    from torch import Tensor, nn

    from lightsim.networks.loop import LoopConfig, Session
    from lightsim_lab.training.sky import Completion
    from lightsim_lab.training.sky_models import SkyKind, SkyPart

_LOGGER = logging.getLogger(__name__)
WEIGHTS_NAME = "weights.safetensors"
SCORES_NAME = "scores.json"
# Panoramas per batch of the scores; it limits memory and does not change the scores.
_SCORE_BATCH = 32
_INPAINT = "completion of panoramas (docs/models/inpaint.md)"
_SKY = "sky dome estimator (docs/models/sky.md)"
# Command, row of the scores and description by network; all other networks are baselines.
_COMMANDS = {
    "inpaint": ("inpaint", "network", _INPAINT),
    "lightsim": ("sky", "lightsim", _SKY),
    "lightsim_paper": ("sky", "lightsim_paper", f"{_SKY}, in the paper's form"),
}


def prepare(command: PrepareOptions) -> None:
    """Write the cache of the lighting networks' training data.

    Raises:
        InputError: fewer than three streets or no position, no skies, or an invalid split.
    """
    if command.streets < 3 or command.positions < 1:
        raise InputError(
            "too few streets or positions: one side of the split would be empty",
            where="--streets, --positions",
            got=f"{command.streets} and {command.positions}",
            expected="at least 3 and 1",
        )
    if not command.out.absolute().parent.is_dir():
        raise InputError(
            "the folder of the output file does not exist",
            where=command.out.parent,
            remedy="Create the folder first.",
        )
    # A sixth of the streets for validation, and a sixth for tests.
    streets = StreetConfig(
        street_count=command.streets,
        held_out=max(1, command.streets // 6),
        positions=command.positions,
    )
    config = PrepareConfig(height_px=command.height, seed=command.seed, streets=streets)
    cache = prepare_cache(command.hdri, command.split, config, terminal_progress(), command.ldr)
    write_cache(command.out, cache)
    size_mb = command.out.stat().st_size / 1e6
    _LOGGER.info(
        "%s: %d skies, %d LDR panoramas, %d street positions, %.1f MB",
        command.out,
        len(cache.skies),
        len(cache.ldr),
        len(cache.views),
        size_mb,
    )


def train_inpaint(
    command: TrainingOptions, ldr_fraction: float, *, is_published: bool = False
) -> None:
    """Train the inpainting, write the weights, and score them if there is a validation side.

    Args:
        ldr_fraction: fraction of LDR panoramas among the samples, if the data have any.
        is_published: holes start grey and both stages paint anew, as in DeepFill v2.

    Raises:
        InputError: the fraction is outside [0, 1], or the size of the data does not fit the
            network.
    """
    from lightsim_lab.training import inpaint as inpaint_train
    from lightsim_lab.training.inpaint_scores import evaluate_inpaint

    cache = read_cache(command.data)
    kind = inpaint_train.InpaintConfig
    config = kind.small() if command.preset == "small" else kind.full()
    config = replace(
        config,
        seed=command.seed,
        loop=loop_of(config.loop, command),
        is_residual=not is_published,
    )
    check_number("--ldr-fraction", ldr_fraction, 0.0, 1.0)
    data = LightingSet(cache, ldr_fraction=ldr_fraction)
    with session_of(command) as session:
        weights, steps = inpaint_train.train_inpaint(data, config, session)
    if session.processes.is_first:
        held_out = _validation(cache)
        # Scored after rounding to half precision, as the weights are stored.
        stored = {name: value.half().float() for name, value in weights.items()}
        scores = evaluate_inpaint(held_out, stored) if held_out else {}
        write_run(
            command, weights, scores, _record(command, "inpaint", cache, session, steps, scores)
        )


def train_sky_network(
    command: TrainingOptions,
    kind: SkyKind,
    inpaint: Path | None,
    start: Path | None = None,
    part: SkyPart = "all",
) -> None:
    """Train a sky network, write its weights, and score them if there is a validation side.

    Args:
        inpaint: weights of the inpainting, for the networks in USES_INPAINTING.
        start: initial weights; None: random.
        part: part of the network to train.

    Raises:
        InputError: the network does not use inpainting, the data have another size, or `start`
            belongs to another network.
    """
    from lightsim.lighting.sky.network import SkyNetwork
    from lightsim_lab.training import sky as sky_train
    from lightsim_lab.training.sky_calibration import calibrate_concentration
    from lightsim_lab.training.sky_models import (
        USES_INPAINTING,
        sky_recipe,
        started_from,
        weights_of,
    )
    from lightsim_lab.training.sky_scores import parts_of

    if inpaint is not None and kind not in USES_INPAINTING:
        raise InputError(
            "this network does not use inpainting",
            where="--inpaint",
            got=kind,
            expected=f"one of {', '.join(USES_INPAINTING)}",
            remedy="Omit --inpaint.",
        )
    cache = read_cache(command.data)
    data = LightingSet(cache)
    complete = None if inpaint is None else completion_of(inpaint)
    recipe = sky_recipe(kind, command.preset, command.seed, part)
    if start is not None:
        recipe = started_from(recipe, read_weights(start))
    loop = loop_of(recipe.config.loop, command)
    recipe = replace(recipe, config=replace(recipe.config, loop=loop))
    with session_of(command) as session:
        steps = sky_train.train_sky(recipe, data, session, complete)
    if session.processes.is_first:
        network, held_out = recipe.network.cpu().eval(), _validation(cache)
        if held_out and isinstance(network, SkyNetwork):
            calibrate_concentration(network, parts_of(held_out.fixed_views().batch, _SCORE_BATCH))
        scores = _sky_scores(kind, network, (data, held_out), complete) if held_out else {}
        record = _record(command, kind, cache, session, steps, scores)
        write_run(command, weights_of(kind, network), scores, record)


def _sky_scores(
    kind: SkyKind,
    network: nn.Module,
    sides: tuple[LightingSet, LightingSet],
    complete: Completion | None,
) -> dict[str, Any]:
    from lightsim_lab.training.sky_scores import evaluate_sky_networks, parts_of

    train, held_out = sides
    views = parts_of(held_out.fixed_views().batch, _SCORE_BATCH)
    # Four batches suffice for the mean sun and median peak of the baseline `constant`.
    known = [train.batch(_SCORE_BATCH, 0, k, only_sunny=False) for k in range(4)]
    rows = evaluate_sky_networks(views, {kind: network}, known, complete)  # type: ignore[dict-item]
    return {row.name: _known(asdict(row)) for row in rows}


def loop_of(config: LoopConfig, command: RunOptions) -> LoopConfig:
    """Return a preset's loop settings with the changes of the command."""
    steps = config.steps if command.steps is None else command.steps
    return replace(config, steps=steps, is_compiled=command.compile)


@contextmanager
def session_of(command: RunOptions) -> Generator[Session]:
    """Create the output folder, and yield the session of a training command."""
    from lightsim.networks.devices import choose_device, joined_processes
    from lightsim.networks.loop import Session
    from lightsim.store.checkpoint import FolderCheckpointer

    command.out.mkdir(parents=True, exist_ok=True)
    checkpointer, progress = FolderCheckpointer(command.out), terminal_progress()
    with joined_processes(choose_device(command.device)) as processes:
        yield Session(checkpointer, progress, command.minutes, command.device, processes)


def _record(
    command: TrainingOptions,
    network: str,
    cache: LightingCache,
    session: Session,
    steps: int,
    scores: Mapping[str, Any],
) -> WeightsRecord:
    baseline = ("baseline", network, f"{network} (docs/models/sky.md)")
    what, row, description = _COMMANDS.get(network, baseline)
    count = sum(sky.entry.split == "train" for sky in cache.skies)
    positions = cache.view_sides.count("train")
    ldr_count = sum(picture.side == "train" for picture in cache.ldr)
    ldr = f", {ldr_count} LDR panoramas" if ldr_count and network == "inpaint" else ""
    return WeightsRecord(
        description=description,
        command=command_line(what, command, session.processes.count),
        training_data=f"{count} HDR skies, {len(cache.clear.elevation_deg)} clear skies and "
        f"{positions} positions in synthetic streets{ldr}",
        split_hash=split_hash(sky.entry for sky in cache.skies),
        seed=command.seed,
        steps=steps,
        scores=scores.get(row, "no data were held out"),
        licence=command.licence,
        version=__version__,
    )


def write_run(
    command: RunOptions,
    weights: Mapping[str, Tensor],
    scores: Mapping[str, Any],
    record: WeightsRecord,
) -> None:
    """Write the weights with their record, and the scores of all methods."""
    write_weights(command.out / WEIGHTS_NAME, weights, record)
    if scores:
        write_json(command.out / SCORES_NAME, scores)
    _LOGGER.info("%s: %s", command.out / WEIGHTS_NAME, record.line())


def command_line(what: str, command: RunOptions, processes: int) -> str:
    """Return the command that reproduces the weights, without options at their default."""
    torchrun = ["torchrun", "--nproc-per-node", str(processes), "--no-python"]
    words = [*(torchrun if processes > 1 else []), "lightsim", "train", what]
    for option in fields(command):
        value = getattr(command, option.name)
        # `verbose` does not change the weights.
        if value != option.default and option.name != "verbose":
            words.append("--" + option.name.replace("_", "-"))
            many = value if isinstance(value, tuple) else (value,)
            words += [] if value is True else [str(one) for one in many]
    return shlex.join(words)


def _known(row: dict[str, Any]) -> dict[str, Any]:
    """Replace NaN (quantities that a method does not estimate) by None, as JSON has no NaN."""
    return {key: None if value != value else value for key, value in row.items()}


def completion_of(weights: str | Path) -> Completion:
    """Return the inpainting of shipped weights or of a weights file, as a function of batches.

    Raises:
        InputError: the weights are missing, unknown or damaged.
    """
    from lightsim.lighting.panorama.inpaint import fill_by_network

    tensors = tensors_of(weights)

    def complete(
        ldr: Float32[np.ndarray, "n h w 3"], seen: Bool[np.ndarray, "n h w"]
    ) -> Float32[np.ndarray, "n h w 3"]:
        return fill_by_network(ldr, seen, tensors)

    return complete


def _validation(cache: LightingCache) -> LightingSet | None:
    """Return the validation side, or None if the cache was made without a split."""
    try:
        return LightingSet(cache, "validation")
    except InputError as error:
        _LOGGER.warning("no scores: %s", error)
        return None
