"""Which HDRIs show a place of their own, and how much of their sky it hides.

python benchmarks/bench_scenery.py FOLDER    (of .hdr files)
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from lightsim.lighting.scenery import column_contrast, without_scenery
from lightsim.lighting.target_sky import dome_from_array
from lightsim.simulation.skies import picture_matte
from lightsim.store.images import read_sky


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    for path in sorted(parser.parse_args().folder.glob("*.hdr")):
        dome = dome_from_array(read_sky(path).radiance, path.name)
        start = time.perf_counter()
        behind, hidden = without_scenery(dome, picture_matte)
        seconds = time.perf_counter() - start
        kind = "sky alone" if behind is dome else f"place, hides {100 * hidden:.0f} %"
        sys.stdout.write(
            f"{path.stem:36} step {column_contrast(dome.radiance):.4f}  {kind}  {seconds:.1f} s\n"
        )


if __name__ == "__main__":
    main()
