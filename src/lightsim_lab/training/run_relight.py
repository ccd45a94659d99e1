"""Command `lightsim train relight`: streets, weights and scores in files."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from typing import get_args

from lightsim.core.checks import check_choice, check_number
from lightsim.core.version import __version__
from lightsim.errors import InputError
from lightsim.progress import terminal_progress
from lightsim.relighting.network.features import RemovedInput
from lightsim.relighting.network.model import RelitNet
from lightsim.relighting.network.stored import probe, tensors_of_network
from lightsim.store.weights import UNKNOWN, WeightsRecord, read_record
from lightsim_lab.baselines.epe import EpeConfig
from lightsim_lab.baselines.methods import all_kinds
from lightsim_lab.baselines.self_osr import SelfOsrConfig
from lightsim_lab.training.options import RelightTrainingOptions
from lightsim_lab.training.relight import (
    Pairs,
    RelightTrainConfig,
    ablated,
    full,
    paper,
    train_relight,
)
from lightsim_lab.training.relight_baselines import BaselineTrainConfig, train_baseline
from lightsim_lab.training.relight_baselines import full as full_baseline
from lightsim_lab.training.relight_data import RelightData, RelightDataConfig
from lightsim_lab.training.relight_scores import score_relight
from lightsim_lab.training.run import command_line, loop_of, session_of, write_run

_DESCRIPTION = {
    "network": "correction of physical relighting (docs/models/relight.md)",
    "paper": "RelitNet as the paper describes it (docs/models/relight.md)",
    "self-osr": "re-implementation of Self-OSR (docs/models/baselines.md)",
    "epe": "re-implementation of EPE (docs/models/baselines.md)",
}
_BASELINES = {"self-osr": SelfOsrConfig(), "epe": EpeConfig()}
# Factor on the learning rate if the initial weights are trained ones. Sensitivity not measured.
_FINE_TUNING_RATE = 0.3


def train(command: RelightTrainingOptions) -> None:
    """Train a relighting network, write its weights, and score them on the validation streets.

    Raises:
        InputError: a street is missing, or a validation street is also a training street, of this
            training or of the initial weights.
    """
    streets = _streets(command)
    config = _config(command)
    first = None if command.start is None else read_record(command.start)
    before = [] if first is None else _streets_of(first, command)
    data = RelightData([command.data / name for name in streets], config.data)
    _check_pairs(data, config, command)
    with session_of(command) as session:
        if isinstance(config, BaselineTrainConfig):
            network, steps = train_baseline(config, data, session)
        else:
            network, steps = train_relight(config, data, session, command.start)
    if not session.processes.is_first:
        return
    network.cpu()
    tensors = tensors_of_network(network, all_kinds())
    # Scored after rounding to half precision, as the weights are stored.
    network.load_state_dict({k: v.half().float() for k, v in network.state_dict().items()})
    scores = {}
    if command.validation:
        held_out = RelightData([command.data / n for n in command.validation], RelightDataConfig())
        scores = score_relight(network, held_out, terminal_progress())
    record = WeightsRecord(
        description=_DESCRIPTION[command.network],
        command=command_line("relight", command, session.processes.count),
        training_data=f"{len(data)} frames of twins built from the logs {', '.join(streets)}, "
        f"{'with path-traced truth' if data.has_truth else 'without truth'}; target skies: "
        f"{', '.join(data.sky_names)}"
        + ("" if first is None else f"; initial weights: {first.training_data}"),
        split_hash=_hash(streets, command.validation),
        seed=command.seed,
        steps=steps,
        scores=scores or "no street was held out",
        licence=command.licence,
        version=__version__,
        streets={
            "training": sorted({*before, *streets}, key=by_number),
            "validation": list(command.validation),
        },
        probe=probe(network) if isinstance(network, RelitNet) else UNKNOWN,
    )
    write_run(command, tensors, scores, record)


def _check_pairs(
    data: RelightData,
    config: RelightTrainConfig | BaselineTrainConfig,
    command: RelightTrainingOptions,
) -> None:
    """Reject samples without true pictures for networks that learn from them."""
    if config.data.true_fraction > 0 and not data.has_truth:
        raise InputError(
            "the samples have no true pictures, which this network learns from",
            where=command.data,
            got=f"--network {command.network}",
            remedy="Give --network paper, or --network network --without truth physical.",
        )


def _config(command: RelightTrainingOptions) -> RelightTrainConfig | BaselineTrainConfig:
    """Return the training settings of the command."""
    config = _baseline(command) if command.network in _BASELINES else _own(command)
    if command.edge_weight is not None:
        check_number("--edge-weight", command.edge_weight, 0.0, 1e4)
        config = replace(config, edges=command.edge_weight)
    return replace(config, seed=command.seed, loop=loop_of(config.loop, command))


def _baseline(command: RelightTrainingOptions) -> BaselineTrainConfig:
    given = {
        "--without": command.without,
        "--start": command.start,
        "--crops": command.crops,
        "--crop-px": command.crop_px,
    }
    given_one = next((option for option, value in given.items() if value), None)
    if given_one is not None:
        raise InputError(
            "baselines do not have this option",
            where=given_one,
            got=f"--network {command.network}",
            expected="--network network or paper",
        )
    config = BaselineTrainConfig(network=_BASELINES[command.network])
    return config if command.preset == "small" else full_baseline(config)


def _own(command: RelightTrainingOptions) -> RelightTrainConfig:
    for part in command.without:
        check_choice("--without", part, (*get_args(Pairs), *get_args(RemovedInput)))
    # RelitNet corrects the physical estimate, which pairs of renderings do not have.
    has_estimate = command.network == "network" and "physical" not in command.without
    if has_estimate and "truth" in command.without:
        raise InputError(
            "without true pairs there is no physical estimate to correct",
            where="--without truth",
            remedy="Omit the estimate as well: --without truth physical.",
        )
    config = _varied(RelightTrainConfig() if command.preset == "small" else full(), command)
    if command.network == "paper":
        config = paper(config)
    if command.start is not None:
        config = replace(config, rate=config.rate * _FINE_TUNING_RATE)
    return ablated(config, command.without)  # type: ignore[arg-type]


def _varied(config: RelightTrainConfig, command: RelightTrainingOptions) -> RelightTrainConfig:
    """Apply the options of the batches."""
    if command.crops is not None:
        check_number("--crops", command.crops, 1, 4096)
        config = replace(config, data=replace(config.data, batch=command.crops))
        # As in the preset small: LPIPS is evaluated on a quarter of the crops.
        config = replace(config, perception_crops=max(1, command.crops // 4))
    if command.crop_px is not None:
        check_number("--crop-px", command.crop_px, 32, 4096)
        size_px = (command.crop_px, command.crop_px)
        config = replace(config, data=replace(config.data, crop_px=size_px))
    return config


def _streets(command: RelightTrainingOptions) -> tuple[str, ...]:
    """Return the training streets; check that all streets exist and are on one side."""
    # By default all folders with samples, except those for validation.
    names = command.streets or tuple(
        path.name
        for path in sorted(command.data.glob("*"))
        if any(path.glob("*.npz")) and path.name not in command.validation
    )
    both = set(names) & set(command.validation)
    missing = [n for n in (*names, *command.validation) if not (command.data / n).is_dir()]
    if both or missing or not names:
        raise InputError(
            "a street is both a training and a validation street"
            if both
            else "streets are missing",
            where=command.data,
            got=", ".join(sorted(both) or missing) or "none",
            remedy="Give other --streets and --validation, or make them with lightsim train"
            " prepare relight.",
        )
    return tuple(names)


def _streets_of(first: WeightsRecord, command: RelightTrainingOptions) -> list[str]:
    """Return the training streets of the initial weights, which also count for the new weights.

    Raises:
        InputError: the record has no streets, or a validation street is among them.
    """
    streets = first.streets
    if isinstance(streets, str):
        both, message = [], "the record of the initial weights has no training streets"
    else:
        both = sorted({*streets["training"]} & {*command.validation})
        message = "the initial weights were trained on validation streets"
    if isinstance(streets, str) or both:
        raise InputError(
            message,
            where=command.start,
            got=", ".join(both) or None,
            remedy="Give weights of lightsim train relight, and other streets for --validation.",
        )
    return streets["training"]


def by_number(name: str) -> tuple[int, str]:
    """Return the key that sorts street names by number."""
    return (int(name) if name.isdigit() else 0, name)


def _hash(train: Sequence[str], validation: Sequence[str]) -> str:
    """Return the SHA-256 of the sorted lines `street,side`."""
    sides = {**dict.fromkeys(train, "train"), **dict.fromkeys(validation, "validation")}
    lines = sorted(f"{name},{side}\n" for name, side in sides.items())
    return hashlib.sha256("".join(lines).encode()).hexdigest()
