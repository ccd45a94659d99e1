"""What relit frames took: kept beside the scenario, so that frames can be scored later."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path

from lightsim.store.artefact import peak_memory_mb, read_record, write_json
from lightsim.store.entries import Entries
from lightsim_lab.metrics.report import Cost

Folders = Mapping[str, Mapping[str, Path]]
"""By sky: the folder of frames "predicted", and others."""


def with_cost(work: Path, name: str, relight: Callable[[], Folders]) -> tuple[Folders, Cost | None]:
    """Relights, and tells what it cost: now, or when all these frames were made; None where some
    had been kept from an interrupted run.

    Args:
        name: of the scenario that `relight` makes.
    """
    scenarios = work / "scenarios"
    kept = [scenarios / name, scenarios / f".{name}.partial"]
    is_anew, began_s = not any(path.exists() for path in kept), time.process_time()
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
    # Those of other frames of this name tell nothing.
    is_of_these = found.mapping().get("keys") == keys
    return folders, Cost.read(found) if is_of_these else None
