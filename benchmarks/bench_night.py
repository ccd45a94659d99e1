"""Which HDRIs look like night panoramas (lightsim.lighting.night).

python benchmarks/bench_night.py FOLDER    (of .hdr files)
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from lightsim.lighting.night import is_night_panorama
from lightsim.lighting.target_sky import dome_from_array
from lightsim.store.images import read_sky


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    for path in sorted(parser.parse_args().folder.glob("*.hdr")):
        dome = dome_from_array(read_sky(path).radiance, path.name)
        sys.stdout.write(f"{path.stem:36} {'night' if is_night_panorama(dome) else 'day'}\n")


if __name__ == "__main__":
    main()
