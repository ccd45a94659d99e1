"""Weights of a relighting network between two that have the same shape.

    python tools/mix_weights.py BEFORE AFTER --share 0.25 --out FILE

For AFTER that went on from BEFORE (`lightsim train relight --start`): a share of the way keeps most
of what was gained where training has been, and most of what BEFORE knew elsewhere (Wortsman et al.
2022, arXiv:2109.01903).
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from lightsim.core.checks import check_number
from lightsim.relighting.network.model import RelitNet
from lightsim.relighting.network.stored import network_for, probe, tensors_of_network
from lightsim.store.weights import read_record, write_weights


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("before", type=Path)
    parser.add_argument("after", type=Path)
    parser.add_argument("--share", type=float, required=True)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    check_number("--share", options.share, 0.0, 1.0)
    first, network = (network_for(RelitNet, path) for path in (options.before, options.after))
    state = first.state_dict()
    mixed = {k: state[k].lerp(v, options.share) for k, v in network.state_dict().items()}
    # As it is stored.
    network.load_state_dict({name: value.half().float() for name, value in mixed.items()})
    record = read_record(options.after)
    command = f"{record.command}; tools/mix_weights.py --share {options.share} from --start to it"
    record = replace(record, command=command, probe=probe(network))
    write_weights(options.out, tensors_of_network(network), record)


if __name__ == "__main__":
    main()
