"""Put trained weights into the package: copies the file and writes its entry of manifest.json.

python tools/ship_weights.py NAME RUN/weights.safetensors
"""

from __future__ import annotations

import argparse
import hashlib
import json
from pathlib import Path

FOLDER = Path(__file__).resolve().parents[1] / "src" / "lightsim" / "data" / "weights"
SKIES = "HDR skies of the train side of benchmarks/hdri_split.csv (NOTICE) and synthetic streets"
DESCRIPTIONS = {
    "inpaint-small": f"completion of panoramas (docs/models/inpaint.md), trained on {SKIES}",
    "sky-small": f"sky dome estimator (docs/models/sky.md), trained on {SKIES}",
}


def main() -> None:
    parser = argparse.ArgumentParser(description="Put trained weights into the package.")
    parser.add_argument("name", choices=sorted(DESCRIPTIONS))
    parser.add_argument("weights", type=Path)
    options = parser.parse_args()
    content = options.weights.read_bytes()
    file = f"{options.name}.safetensors"
    (FOLDER / file).write_bytes(content)
    path = FOLDER / "manifest.json"
    manifest = json.loads(path.read_text())
    manifest[options.name] = {
        "sha256_by_file": {file: hashlib.sha256(content).hexdigest()},
        "description": DESCRIPTIONS[options.name],
        "source": "trained by lightsim train (docs/training.md)",
        "licence": "Apache-2.0",
    }
    path.write_text(json.dumps(manifest, indent=2) + "\n")


if __name__ == "__main__":
    main()
