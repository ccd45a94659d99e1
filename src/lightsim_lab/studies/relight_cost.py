"""Computing cost of relit frames, stored beside the scenario for scoring in a later run."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path

from lightsim.store.artefact import peak_memory_mb, read_record, write_json
from lightsim.store.entries import Entries
from lightsim_lab.metrics.report import Cost

# Folders of frames by sky and kind, among them "predicted".
Folders = Mapping[str, Mapping[str, Path]]


def with_cost(work: Path, name: str, relight: Callable[[], Folders]) -> tuple[Folders, Cost | None]:
    """Relight, and return the cost of this run or of the run that made all these frames.

    The cost is None if some frames are from an interrupted run.

    Args:
        name: name of the scenario that `relight` makes.
    """
    scenarios = work / "scenarios"
    earlier = [scenarios / name, scenarios / f".{name}.partial"]
    is_anew, began_s = not any(path.exists() for path in earlier), time.process_time()
    folders = relight()
    records = [read_record(frames["predicted"].parent) for frames in folders.values()]
    keys = [None if record is None else record["key"] for record in records]
    path = scenarios / f".{name}.cost.json"
    if is_anew:
        count = sum(len(list(frames["predicted"].glob("*/*.png"))) for frames in folders.values())
        cost = Cost((time.process_time() - began_s) / count, peak_memory_mb())
        write_json(path, {"keys": keys, **asdict(cost)})
        return folders, cost
    if not path.is_file():
        return folders, None
    found = Entries.of_file(path, "Remove the file: the cost is then unknown.")
    # The stored cost may belong to other frames of the same name.
    is_same = found.mapping().get("keys") == keys
    return folders, Cost.read(found) if is_same else None
