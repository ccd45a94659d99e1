"""Tell weights, in their record, which streets they have learned from; their numbers stay.

    python tools/name_streets.py WEIGHTS --training 77 412 ... [--validation 5021]

For weights of relighting networks from before the record had a field for it. Weights of the package
are then shipped again (tools/ship_weights.py).
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

from lightsim.store.atomic import whole_file
from lightsim.store.weights import read_record

_ALIGNMENT = 8
"""Tensors begin at a multiple of so many bytes (the format of safetensors)."""


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("weights", type=Path)
    parser.add_argument("--training", nargs="+", required=True)
    parser.add_argument("--validation", nargs="*", default=[])
    options = parser.parse_args()
    streets = {"training": options.training, "validation": options.validation}
    record = replace(read_record(options.weights), streets=streets)
    content = options.weights.read_bytes()
    end = 8 + int.from_bytes(content[:8], "little")
    header = json.loads(content[8:end]) | {"__metadata__": record.metadata()}
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % _ALIGNMENT)
    with whole_file(options.weights) as temporary:
        temporary.write_bytes(len(text).to_bytes(8, "little") + text + content[end:])


if __name__ == "__main__":
    main()
