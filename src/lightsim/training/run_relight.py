"""What `lightsim train relight` does: streets, weights and scores in files."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from typing import get_args

from lightsim.core.checks import check_choice, check_number
from lightsim.errors import InputError
from lightsim.progress import terminal_progress
from lightsim.relighting.baselines.epe import EpeConfig
from lightsim.relighting.baselines.self_osr import SelfOsrConfig
from lightsim.relighting.network.features import Unseen
from lightsim.relighting.network.stored import tensors_of_network
from lightsim.store.weights import WeightsRecord
from lightsim.training.options import RelightTrainingOptions
from lightsim.training.relight import (
    Pairs,
    RelightTrainConfig,
    ablated,
    full,
    paper,
    train_relight,
)
from lightsim.training.relight_baselines import BaselineTrainConfig, train_baseline
from lightsim.training.relight_baselines import full as full_baseline
from lightsim.training.relight_data import RelightData, RelightDataConfig
from lightsim.training.relight_scores import score_relight
from lightsim.training.run import command_line, loop_of, session_of, write_run
from lightsim.version import __version__

_DESCRIPTION = {
    "network": "correction of physical relighting (docs/models/relight.md)",
    "paper": "RelitNet as the paper describes it (docs/models/relight.md)",
    "self-osr": "re-implementation of Self-OSR (docs/models/baselines.md)",
    "epe": "re-implementation of EPE (docs/models/baselines.md)",
}
_BASELINES = {"self-osr": SelfOsrConfig(), "epe": EpeConfig()}
_MOST_EDGES = 1e4


def train(command: RelightTrainingOptions) -> None:
    """Train, write the weights, and score them on the validation streets.

    Raises:
        InputError: a street is missing, or one is on both sides.
    """
    streets = _streets(command)
    config = _config(command)
    is_baseline = isinstance(config, BaselineTrainConfig)
    data = RelightData([command.data / name for name in streets], config.data)
    with session_of(command) as session:
        train_it = train_baseline if is_baseline else train_relight
        network, steps = train_it(config, data, session)  # type: ignore[arg-type]
    if not session.processes.is_first:
        return
    network.cpu()
    tensors = tensors_of_network(network)
    scores = {}
    if command.validation:
        held_out = RelightData([command.data / n for n in command.validation], RelightDataConfig())
        network.load_state_dict({k: v.half().float() for k, v in network.state_dict().items()})
        scores = score_relight(network, held_out, terminal_progress())
    record = WeightsRecord(
        description=_DESCRIPTION[command.network],
        command=command_line("relight", command, session.processes.count),
        training_data=f"{len(data)} frames of the synthetic streets {', '.join(streets)} with "
        "path-traced truth, seen through twins that were built from their logs; target skies: "
        f"{', '.join(data.sky_names)}",
        split_hash=_hash(streets, command.validation),
        seed=command.seed,
        steps=steps,
        scores=scores or "no street was held out",
        licence=command.licence,
        version=__version__,
        streets={"training": list(streets), "validation": list(command.validation)},
    )
    write_run(command, tensors, scores, record)


def _config(command: RelightTrainingOptions) -> RelightTrainConfig | BaselineTrainConfig:
    """What the command asks for."""
    config = _baseline(command) if command.network in _BASELINES else _own(command)
    if command.edge_weight is not None:
        check_number("--edge-weight", command.edge_weight, 0.0, _MOST_EDGES)
        config = replace(config, edges=command.edge_weight)
    return replace(config, seed=command.seed, loop=loop_of(config.loop, command))


def _baseline(command: RelightTrainingOptions) -> BaselineTrainConfig:
    if command.without:
        raise InputError(
            "ablations are of the paper's network and of ours",
            where="--without",
            got=f"--network {command.network}",
            expected="--network network or paper",
        )
    config = BaselineTrainConfig(_BASELINES[command.network])
    return config if command.preset == "small" else full_baseline(config)


def _own(command: RelightTrainingOptions) -> RelightTrainConfig:
    for part in command.without:
        check_choice("--without", part, (*get_args(Pairs), *get_args(Unseen)))
    has_estimate = command.network == "network" and "physical" not in command.without
    if has_estimate and "truth" in command.without:
        raise InputError(
            "pairs of renderings have no physical estimate to correct",
            where="--without truth",
            remedy="Leave it out as well: --without truth physical.",
        )
    config = RelightTrainConfig() if command.preset == "small" else full()
    if command.network == "paper":
        config = paper(config)
    return ablated(config, command.without)  # type: ignore[arg-type]


def _streets(command: RelightTrainingOptions) -> tuple[str, ...]:
    """Those to learn from."""
    names = command.streets or tuple(
        path.name
        for path in sorted(command.data.glob("*"))
        if any(path.glob("*.npz")) and path.name not in command.validation
    )
    both = set(names) & set(command.validation)
    missing = [n for n in (*names, *command.validation) if not (command.data / n).is_dir()]
    if both or missing or not names:
        raise InputError(
            "a street would be learned from and tell how good that is"
            if both
            else "streets are missing",
            where=command.data,
            got=", ".join(sorted(both) or missing) or "none",
            remedy="Give other --streets and --validation, or make them with lightsim train"
            " prepare relight.",
        )
    return tuple(names)


def _hash(train: Sequence[str], validation: Sequence[str]) -> str:
    """SHA-256 of the sorted lines `street,side`."""
    sides = {**dict.fromkeys(train, "train"), **dict.fromkeys(validation, "validation")}
    lines = sorted(f"{name},{side}\n" for name, side in sides.items())
    return hashlib.sha256("".join(lines).encode()).hexdigest()
