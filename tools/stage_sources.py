"""Which sources decide which stage of a build; Markdown tables.

    python tools/stage_sources.py [PATH ...]

Without PATH: for each stage the number of its source files and the packages that they lie in, then
for each package the stages whose own sources have a file of it. With paths such as
lightsim/core/mesh.py: for each of them the stages whose own sources it is in, and all stages that
a change in it makes stale.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter

from lightsim.build.pipeline import STAGES
from lightsim.build.sources import stage_sources


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("paths", nargs="*", metavar="PATH")
    paths = parser.parse_args().paths
    sources = {row.name: stage_sources(row.make, is_first=not row.needs) for row in STAGES}
    table = _by_path(paths, sources) if paths else [*_by_stage(sources), "", *_by_room(sources)]
    sys.stdout.write("\n".join(table) + "\n")


def _by_stage(sources: dict[str, dict[str, str]]) -> list[str]:
    lines = ["| stage | files | of them in |", "|---|---:|---|"]
    for stage, files in sources.items():
        rooms = Counter(path.split("/")[1] for path in files)
        lines.append(
            f"| {stage} | {len(files)} | {', '.join(f'{r} {n}' for r, n in rooms.items())} |"
        )
    return lines


def _by_room(sources: dict[str, dict[str, str]]) -> list[str]:
    rooms = sorted({path.split("/")[1] for files in sources.values() for path in files})
    lines = ["| package | in the sources of |", "|---|---|"]
    for room in rooms:
        stages = [s for s, files in sources.items() if any(p.split("/")[1] == room for p in files)]
        lines.append(f"| {room} | {', '.join(stages)} |")
    return lines


def _by_path(paths: list[str], sources: dict[str, dict[str, str]]) -> list[str]:
    lines = ["| file | in the sources of | a change makes stale |", "|---|---|---|"]
    for path in paths:
        own = [stage for stage, files in sources.items() if path in files]
        stale = set(own)
        for row in STAGES:  # In order: a stage follows all that it needs.
            if stale & set(row.needs):
                stale.add(row.name)
        ordered = [row.name for row in STAGES if row.name in stale]
        lines.append(f"| {path} | {', '.join(own) or '-'} | {', '.join(ordered) or '-'} |")
    return lines


if __name__ == "__main__":
    main()
