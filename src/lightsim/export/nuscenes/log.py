"""Exports in the layout of nuScenes, for nuscenes-devkit and loaders that are based on it."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from lightsim.export.nuscenes.boxes import add_boxes, add_names
from lightsim.export.nuscenes.samples import Samples
from lightsim.export.nuscenes.sensors import SensorWriter
from lightsim.export.nuscenes.tables import Tables
from lightsim.export.provenance import Written
from lightsim.export.scenario_log import ScenarioLog
from lightsim.progress import Progress
from lightsim.store.artefact import write_json
from lightsim.store.images import write_png

VERSION = "v1.0-lightsim"
SPLIT = "all"
_MASK_NAME = "maps/empty.png"
# Side of the map mask in pixels of 0.1 m; the mask is empty, as the map is not known.
_MASK_PX = 100


def write_nuscenes(log: ScenarioLog, folder: Path, progress: Progress) -> Written:
    """Write samples/, sweeps/, maps/ and the 13 tables in v1.0-lightsim/.

    Args:
        folder: empty, or with the pictures and sweeps of an interrupted export of the same log.
    """
    tables = Tables(log.key)
    # Names of scenes are unique among exports that are joined.
    scene = f"scene-{log.log.name}-{log.key[:8]}"
    samples = Samples.of(log, scene, tables)
    sensors = SensorWriter(log, folder, tables, samples)
    pictures = sensors.write_pictures(progress)
    sensors.write_sweeps(progress)
    samples.add_rows()
    add_names(tables)
    left_out = add_boxes(log, samples, tables, progress)
    _add_scene(log, tables, samples)
    (folder / "maps").mkdir(exist_ok=True)
    write_png(folder / _MASK_NAME, np.zeros((_MASK_PX, _MASK_PX), dtype=np.uint8))
    tables.write(folder / VERSION)
    write_json(folder / VERSION / "splits.json", {SPLIT: [scene]})
    usage = (
        f'`NuScenes(version="{VERSION}", dataroot=DIR)` loads it; the split `{SPLIT}` holds the'
        " scene.",
        "Boxes are at the time of the sweep of each sample, as in nuScenes; moving actors are some"
        " centimetres away in pictures taken before or after it.",
        "Visibility level 1 (0 to 40 %) includes actors outside all pictures and those without a"
        " mesh.",
        "The map mask is empty. There is no CAN bus and no radar.",
    )
    return Written(pictures, left_out, usage)


def _add_scene(log: ScenarioLog, tables: Tables, samples: Samples) -> None:
    first, last = samples.ends
    log_token = tables.token("log")
    tables.add(
        "scene",
        tables.token("scene"),
        {
            "log_token": log_token,
            "name": samples.scene,
            "description": f"LightSim {log.log.name}, sky {log.sky.get('sky')}",
            "nbr_samples": len(samples.key_stems),
            "first_sample_token": first,
            "last_sample_token": last,
        },
    )
    row = {"logfile": log.recording, "vehicle": "", "date_captured": _date(log), "location": ""}
    tables.add("log", log_token, row)
    row = {"log_tokens": [log_token], "category": "semantic_prior", "filename": _MASK_NAME}
    tables.add("map", tables.token("map"), row)


def _date(log: ScenarioLog) -> str:
    """Return the UTC date of the recording; empty if it is unknown."""
    geo = log.log.geo
    if geo is None or geo.clock is None:
        return ""
    time_ns = log.log.frames[0].time_ns + geo.clock.utc_minus_log_ns
    return datetime.fromtimestamp(time_ns * 1e-9, UTC).strftime("%Y-%m-%d")
