"""Weights of relighting networks whose pictures are averaged.

    python tools/join_weights.py FIRST PARTNER [PARTNER ...] --out FILE [--validation 231]

Of networks that were trained each on its own (`lightsim train relight`); each costs its time again.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from lightsim.errors import InputError
from lightsim.relighting.network.model import RelitNet
from lightsim.relighting.network.stored import network_for, probe, tensors_of_network
from lightsim.store.weights import WeightsRecord, read_record, write_weights
from lightsim_lab.training.run_relight import by_number


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("weights", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--validation", nargs="*", default=[], help="streets that chose them")
    options = parser.parse_args()
    networks = [network_for(RelitNet, path) for path in options.weights]
    joined = RelitNet(
        replace(networks[0].config, partners=tuple(one.config for one in networks[1:]))
    ).eval()
    state = dict(networks[0].state_dict())
    for number, one in enumerate(networks[1:]):
        state |= {f"partners.{number}.{name}": value for name, value in one.state_dict().items()}
    joined.load_state_dict(state)
    record = _joined([read_record(path) for path in options.weights], options.validation)
    write_weights(options.out, tensors_of_network(joined), replace(record, probe=probe(joined)))


def _joined(records: list[WeightsRecord], validation: list[str]) -> WeightsRecord:
    """Of all: what one learned from, the joined ones have learned from."""
    if len({record.licence for record in records}) > 1:
        raise InputError("weights of one file have one licence", where="--out")
    told = [record.streets for record in records if not isinstance(record.streets, str)]
    if len(told) < len(records):
        raise InputError("weights do not tell what streets they learned from", where="--out")
    streets = {
        "training": sorted({name for one in told for name in one["training"]}, key=by_number),
        "validation": sorted(
            {*validation, *(name for one in told for name in one["validation"])}, key=by_number
        ),
    }
    return replace(
        records[0],
        command="; ".join(record.command for record in records) + "; tools/join_weights.py",
        training_data="; ".join(record.training_data for record in records),
        steps=" and ".join(str(record.steps) for record in records),
        seed=" and ".join(str(record.seed) for record in records),
        scores="docs/models/relight.md",
        streets=streets,
    )


if __name__ == "__main__":
    main()
