"""File log.json: reading options and summary of a log; the recording itself is not copied."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lightsim.core.lidar_returns import EgoBox
from lightsim.core.log import DrivingLog
from lightsim.core.reading import LogReading, dataset_names
from lightsim.errors import ArtefactError
from lightsim.store.arrays import load_arrays, save_arrays
from lightsim.store.artefact import json_ready, read_json, write_json
from lightsim.store.entries import Entries

LOG_NAME = "log.json"
EGO_NAME = "ego_vehicle.npz"
SOURCE_HASHES_NAME = "source.json"


def held_out_stems(log: DrivingLog, hold_out: int) -> frozenset[str]:
    """Return the stems of the held-out frames of a log: the middle one of every `hold_out`."""
    return held_out_of(log.stems, hold_out)


def held_out_of(stems: Sequence[str], hold_out: int) -> frozenset[str]:
    """Return the held-out stems among a log's stems, which are in order of time; none if 0."""
    return frozenset(stems[hold_out // 2 :: hold_out] if hold_out > 0 else ())


def write_log(
    folder: Path, log: DrivingLog, reading: LogReading, source_hashes: Mapping[str, str]
) -> None:
    """Write log.json and source.json.

    log.json has the reading options and a summary for people and for `lightsim status`; source.json
    has the hash of every file of the recording.
    """
    write_json(folder / SOURCE_HASHES_NAME, dict(source_hashes))
    write_json(
        folder / LOG_NAME,
        {
            "name": log.name,
            "reading": json_ready(reading),
            "cameras": json_ready(dict(log.cameras)),
            "frames": [[f.camera_name, f.stem, f.time_ns] for f in log.frames],
            "sweeps": [[s.stem, s.time_ns] for s in log.sweeps],
            "held_out": sorted(held_out_stems(log, reading.hold_out)),
            "actors": [
                {
                    "actor_id": a.actor_id,
                    "kind": a.kind,
                    "label": a.label,
                    "size_lwh_m": a.size_lwh_m.tolist(),
                    "is_moving": a.is_moving,
                    "poses": len(a.trajectory),
                }
                for a in log.actors
            ],
            "geo": _geo_summary(log),
            "notes": list(log.notes),
        },
    )


def write_ego_vehicle(folder: Path, log: DrivingLog) -> None:
    """Write the detected ego vehicle: its masks, packed in bits, and its box."""
    box = log.ego_box
    corners = np.zeros((0, 3)) if box is None else np.stack([box.low_m, box.high_m])
    bits = {
        f"mask {name}": np.packbits(mask, axis=1) for name, mask in log.ego_vehicle_masks.items()
    }
    save_arrays(folder / EGO_NAME, {"box": corners.astype(np.float64), **bits})


def with_ego_vehicle(log: DrivingLog, folder: Path) -> DrivingLog:
    """Return a log as read from its recording with the ego vehicle and the notes of its artefact.

    Raises:
        ArtefactError: a file is missing or damaged.
    """
    arrays = load_arrays(folder / EGO_NAME)
    corners = arrays.pop("box")
    masks = {}
    for key, bits in arrays.items():
        name = key.removeprefix("mask ")
        width = log.cameras[name].width_px
        masks[name] = np.unpackbits(bits, axis=1, count=width).astype(bool)
    return replace(
        log,
        ego_vehicle_masks=masks,
        ego_box=EgoBox(*corners) if len(corners) else None,
        notes=Entries.of_file(folder / LOG_NAME).texts("notes"),
    )


def read_reading(folder: Path) -> LogReading:
    """Return the reading options of log.json.

    Raises:
        ArtefactError: the file is missing or damaged.
    """
    path = folder / LOG_NAME
    return _reading(Entries.of_file(path).object("reading"))


def read_source(path: Path) -> str:
    """Read the path of the recording at the last build. A recording may move without making
    artefacts stale.

    Args:
        path: build.json of a work folder.

    Raises:
        ArtefactError: the file is missing or broken.
    """
    try:
        return str(read_json(path)["reading"]["source"])
    except (KeyError, TypeError) as error:
        raise ArtefactError(
            "the options of the build are damaged",
            where=path,
            got=error,
            remedy="Run lightsim build again with the recording's folder.",
        ) from error


def read_source_hashes(folder: Path) -> dict[str, str]:
    """Return the hash of every file of the recording at the time of the build, by name."""
    hashes = Entries.of_file(folder / SOURCE_HASHES_NAME)
    return {name: hashes.text(name) for name in hashes}


def reading_from_json(value: Any) -> LogReading:
    """Return the reading options from JSON; inverse of `json_ready(reading)`.

    Raises:
        ArtefactError: an option is missing or of another type.
    """
    return _reading(Entries(value, "the reading options"))


def _reading(value: Entries) -> LogReading:
    return LogReading(
        source=value.text("source"),
        dataset=value.word("dataset", ("auto", *dataset_names())),
        frames=value.text("frames"),
        cameras=value.texts("cameras"),
        hold_out=int(value.number("hold_out")),
        image_scale=value.number("image_scale"),
        heading_deg=None if value.is_null("heading_deg") else value.number("heading_deg"),
        scene=value.text("scene"),
        place=value.text("place"),
        utc=value.text("utc"),
        sun=value.text("sun"),
    )


def _geo_summary(log: DrivingLog) -> dict[str, Any] | None:
    geo = log.geo
    if geo is None:
        return None
    sun = geo.sun_at(log.frames[0].time_ns)
    return {
        "latitude_deg": None if geo.place is None else geo.place.latitude_deg,
        "longitude_deg": None if geo.place is None else geo.place.longitude_deg,
        "place_origin": None if geo.place is None else geo.place.origin,
        "utc_minus_log_s": None if geo.clock is None else geo.clock.utc_minus_log_ns * 1e-9,
        "clock_origin": None if geo.clock is None else geo.clock.origin,
        "world_x_azimuth_deg": geo.heading_deg,
        "heading_origin": geo.heading_origin,
        "heading_residual_deg": geo.heading_residual_deg,
        "heading_residual_m": geo.heading_residual_m,
        "sun_azimuth_deg": None if sun is None else sun.azimuth_deg,
        "sun_elevation_deg": None if sun is None else sun.elevation_deg,
    }
