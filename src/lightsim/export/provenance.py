"""provenance.json and README.md, which every export has."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lightsim.core.sensors import CameraFrame
from lightsim.core.version import __version__
from lightsim.export.scenario_log import ScenarioLog
from lightsim.store.artefact import write_json, write_text

PROVENANCE_NAME = "provenance.json"
_UNKNOWN_LICENCE = "not known to LightSim; see the recording"


@dataclass(frozen=True, eq=False)
class Written:
    """Summary of a written export.

    Args:
        pictures: file of each picture, relative to the export, with its frame.
        left_out: number of boxes without a class in the format, by kind.
        usage: sentences for README.md: how the files are loaded, and what they mean.
    """

    pictures: Sequence[tuple[str, CameraFrame]]
    left_out: Mapping[str, int] = field(default_factory=dict[str, int])
    usage: Sequence[str] = ()


def write_provenance(folder: Path, log: ScenarioLog, written: Written, kind: str) -> None:
    """Write README.md and provenance.json of an export.

    Args:
        kind: name of the format.
    """
    write_json(folder / PROVENANCE_NAME, _provenance(log, written, kind))
    write_text(folder / "README.md", _readme(log, written, kind))


def _provenance(log: ScenarioLog, written: Written, kind: str) -> dict[str, Any]:
    return {
        "made_by": f"LightSim {__version__}",
        "format": kind,
        "scenario": log.log.name,
        "frames_key": log.key,
        "recording": log.recording,
        "licence": log.log.licence or _UNKNOWN_LICENCE,
        "sky": log.sky,
        "edits": log.edits,
        "pictures": [
            {
                "file": name,
                "camera": frame.camera_name,
                "frame": frame.stem,
                "time_ns": frame.time_ns,
                "source": log.source[frame.camera_name, frame.stem],
            }
            for name, frame in written.pictures
        ],
        "sweeps": {
            sweep.stem: "simulated" if sweep.stem in log.simulated_sweeps else "recorded"
            for sweep in log.log.sweeps
        },
        "boxes_left_out": dict(sorted(written.left_out.items())),
        "notes": log.notes,
    }


def _readme(log: ScenarioLog, written: Written, kind: str) -> str:
    left_out = ", ".join(f"{n} {name}" for name, n in sorted(written.left_out.items()))
    lines = [
        f"# {log.log.name}, in the format {kind}",
        "",
        f"Simulated with LightSim {__version__} from the recording {log.recording}, under the sky"
        f" `{log.sky.get('sky')}`. These are not recorded pictures.",
        "",
        f"Licence of the recording, which also holds for this copy: "
        f"{log.log.licence or _UNKNOWN_LICENCE}",
        "",
        f"{PROVENANCE_NAME} lists the source of every picture before relighting (`recorded`: the"
        " camera's picture; `rendered`: the digital twin; `composite`: the camera's picture with"
        " rendered parts) and of every LiDAR sweep, the sky and the edits.",
        "",
        *(f"- {sentence}" for sentence in written.usage),
        f"- Boxes without a class in this format: {left_out or 'none'}.",
        *(f"- {note}" for note in log.notes),
    ]
    return "\n".join(lines) + "\n"
