"""Put weights into the package: copies the files and writes their entry of manifest.json.

python tools/ship_weights.py NAME RUN/weights.safetensors
"""

from __future__ import annotations

import argparse
import hashlib
import json
from pathlib import Path

from lightsim.store.weights import WEIGHTS_FOLDER, list_weights, read_record


def ship(name: str, paths: list[Path]) -> None:
    """Shards are numbered; a file without a record is refused."""
    manifest = list_weights()
    manifest[name] = {}
    for number, path in enumerate(paths, start=1):
        read_record(path)
        content = path.read_bytes()
        file = f"{name}-{number}.safetensors" if len(paths) > 1 else f"{name}.safetensors"
        (WEIGHTS_FOLDER / file).write_bytes(content)
        manifest[name][file] = hashlib.sha256(content).hexdigest()
    (WEIGHTS_FOLDER / "manifest.json").write_text(json.dumps(manifest, indent=2) + "\n")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Put weights into the package.")
    parser.add_argument("name")
    parser.add_argument("weights", type=Path, nargs="+")
    options = parser.parse_args()
    ship(options.name, options.weights)
