"""`--write-log`: the simulated log in PandaSet's own layout, as if it had been recorded.

What no edit touches is the recording itself: files are copied, rows and list entries taken over.
Files are numbered from 00 without gaps, so that the k-th picture, sweep, pose and time belong
together for readers that count files (PandaSet's devkit) as for those that read their names.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from lightsim.core.scenario import Scenario
from lightsim.datasets.files import read_times_ns
from lightsim.datasets.pandaset.cameras import numbered_files
from lightsim.datasets.pandaset.log import SIMULATED_NAME
from lightsim.datasets.pandaset.rig import read_rig
from lightsim.datasets.pandaset.sweeps import ScanTiming, SweepSource, measure_timing
from lightsim.datasets.reader import check_layout
from lightsim.datasets.safe_pickle import read_table
from lightsim.errors import InputError
from lightsim.pipeline.workspace import Workspace
from lightsim.progress import Progress
from lightsim.simulation.written_boxes import BoxEditor
from lightsim.simulation.written_lists import ListWriter, WrittenFrames
from lightsim.simulation.written_sweeps import SweepEditor
from lightsim.store.artefact import json_ready, read_json, write_json
from lightsim.store.images import read_srgb8, write_jpeg
from lightsim.store.pandaset_tables import write_table
from lightsim.version import __version__

_JPEG_QUALITY = 95
_SUFFIX = ".pkl.gz"


@dataclass(frozen=True, eq=False)
class LogWriter:
    """Writes one simulated log.

    Args:
        recorded: the log as it was, in the frames that are asked for.
        scenario: made from it by edits; the same object where there are none.
    """

    workspace: Workspace
    recorded: Scenario
    scenario: Scenario
    progress: Progress

    def write(self, folder: Path) -> None:
        """Fill a new folder with all but pictures and mark."""
        ListWriter(self.workspace, self.recorded, self.scenario, self._frames).write(folder)
        self._write_sweeps(folder)
        self._write_boxes(folder)

    def write_mark(self, folder: Path, made_of: Mapping[str, Any]) -> None:
        """simulated.json."""
        scenario = self.scenario
        stems = zip(self._frames.stems.values(), self._frames.recorded_stems.values(), strict=True)
        mark = {
            "simulated_by": f"LightSim {__version__}",
            "recording": self.workspace.recorded_log.name,
            "scenario": scenario.name,
            "edits": scenario.edits,
            "recorded_frames": dict(stems),
            "jpeg_quality": _JPEG_QUALITY,
            "notes": scenario.notes,
            **made_of,
        }
        write_json(folder / SIMULATED_NAME, mark)

    def write_pictures(self, folder: Path, frames: Path) -> None:
        """camera/<name>/NN.jpg: the recorded bytes where the picture is the recorded one, else of
        JPEG quality 95 with full chroma."""
        source = self._source / "camera"
        kept = [f for f in self.scenario.frames if int(f.stem) in self._frames.stems]
        for frame in self.progress.track(kept, "write pictures", len(kept)):
            path = folder / "camera" / frame.camera_name / self._file(frame.stem, ".jpg")
            path.parent.mkdir(parents=True, exist_ok=True)
            made = read_srgb8(frames / "frames" / frame.camera_name / f"{frame.stem}.png")
            own = source / frame.camera_name / f"{frame.stem}.jpg"
            shown = read_srgb8(own)
            if made.shape == shown.shape and np.array_equal(made, shown):
                shutil.copyfile(own, path)
            else:
                write_jpeg(path, made, quality=_JPEG_QUALITY)

    def _write_sweeps(self, folder: Path) -> None:
        """lidar/NN.pkl.gz and annotations/semseg/NN.pkl.gz."""
        editor = SweepEditor(self.workspace, self.recorded, self.scenario, self.progress)
        sweeps = [s for s in self.workspace.log.sweeps if int(s.stem) in self._frames.stems]
        classes = self._source / "annotations" / "semseg"
        for lazy in self.progress.track(sweeps, "write sweeps", len(sweeps)):
            name, own = self._file(lazy.stem, _SUFFIX), f"{lazy.stem}{_SUFFIX}"
            made = editor.edited(lazy)
            if made is None:
                _copy(self._source / "lidar" / own, folder / "lidar" / name)
                _copy(classes / own, folder / "annotations" / "semseg" / name)
                continue
            write_table(folder / "lidar" / name, made.columns, "index")
            if (classes / own).is_file():
                column = {"class": made.semantic_class}
                write_table(folder / "annotations" / "semseg" / name, column)
        _copy(classes / "classes.json", folder / "annotations" / "semseg" / "classes.json")

    def _write_boxes(self, folder: Path) -> None:
        """annotations/cuboids/NN.pkl.gz; boxes are of a sweep's time, so without times there are
        none."""
        clock = self._source / "lidar" / "timestamps.json"
        if not clock.is_file():
            return
        times_ns = read_times_ns(clock)
        paths = numbered_files(self._source / "annotations" / "cuboids", _SUFFIX)
        tables = {n: read_table(path, ("uuid",)) for n, path in paths.items()}
        path = self.workspace.alignment.path
        editor = BoxEditor.between(
            self.recorded, self.scenario, list(tables.values()), self._timing, path
        )
        for number, stem in self._frames.stems.items():
            target = folder / "annotations" / "cuboids" / f"{stem}{_SUFFIX}"
            made = editor.edited(tables.get(number), int(times_ns[number]))
            if made is not None:
                write_table(target, made)
            elif number in paths:
                _copy(paths[number], target)

    @cached_property
    def _source(self) -> Path:
        return Path(self.workspace.reading.source)

    @cached_property
    def _frames(self) -> WrittenFrames:
        return WrittenFrames.of(self.scenario, [s.stem for s in self.workspace.log.sweeps])

    def _file(self, recorded_stem: str, suffix: str) -> str:
        return f"{self._frames.stems[int(recorded_stem)]}{suffix}"

    @cached_property
    def _timing(self) -> ScanTiming:
        log = self.workspace.recorded_log
        if not log.sweeps:
            return ScanTiming.instantaneous()
        lazy = log.sweeps[0]
        path = self._source / "lidar" / f"{lazy.stem}{_SUFFIX}"
        rig = read_rig(self._source)
        return measure_timing(SweepSource(path, None, lazy.stem, lazy.time_ns, log.ego, rig))


def write_logs(
    workspace: Workspace,
    scenarios: tuple[Scenario, Scenario],
    folders: Mapping[str, Path],
    target: Path,
    *,
    is_overwriting: bool,
    progress: Progress,
) -> list[Path]:
    """Write the simulated log of each sky; finished ones of the same frames are kept.

    Args:
        scenarios: the log as it was, and as it is now.
        folders: WORK/scenarios/NAME of each sky, by the sky's name.
        target: DIR; of several skies DIR/<sky>.

    Returns:
        The logs' folders, in the order of the skies.

    Raises:
        InputError: the recording is not in PandaSet's layout, or DIR holds something else.
    """
    if check_layout(workspace.reading) != "pandaset":
        raise InputError(
            "logs are written in PandaSet's layout only",
            where="--write-log",
            expected="a recording in that layout",
        )
    if len(folders) > 1 and (target / SIMULATED_NAME).exists():
        raise InputError(
            "a folder holds one log, or a log of each sky",
            where=target,
            got=f"one log there, {len(folders)} skies asked for",
            remedy="Choose another --write-log.",
        )
    writer = LogWriter(workspace, *scenarios, progress)
    logs = [target if len(folders) == 1 else target / name for name in folders]
    first: Path | None = None
    for (name, folder), log in zip(folders.items(), logs, strict=True):
        made_of = {"sky": name, "frames_key": read_json(folder / "artefact.json")["key"]}
        if not _is_made(log, made_of, is_overwriting=is_overwriting):
            partial = log.with_name(f".{log.name}.partial")
            shutil.rmtree(partial, ignore_errors=True)
            log.parent.mkdir(parents=True, exist_ok=True)
            if first is None:
                partial.mkdir()
                writer.write(partial)
            else:
                # Only the pictures depend on the sky.
                others = shutil.ignore_patterns("*.jpg", SIMULATED_NAME)
                shutil.copytree(first, partial, ignore=others)
            writer.write_pictures(partial, folder)
            writer.write_mark(partial, made_of)
            if log.exists():
                shutil.rmtree(log)
            partial.rename(log)
        first = first or log
    return logs


def _is_made(log: Path, made_of: Mapping[str, Any], *, is_overwriting: bool) -> bool:
    """Whether a log is there already; what is no log of ours is never replaced."""
    if not log.exists() or (log.is_dir() and not any(log.iterdir())):
        return False
    mark = log / SIMULATED_NAME
    if not mark.is_file():
        raise InputError(
            "something else stands where the log is to be written",
            where=log,
            expected="no folder, an empty one or a log that was written before",
            remedy="Choose another --write-log.",
        )
    found = read_json(mark)
    if all(found.get(key) == value for key, value in json_ready(made_of).items()):
        return True
    if not is_overwriting:
        raise InputError(
            "the folder holds the log of another scenario",
            where=log,
            got=f"scenario {found.get('scenario')}, sky {found.get('sky')}",
            remedy="Choose another --write-log, or give --overwrite.",
        )
    return False


def _copy(own: Path, target: Path) -> None:
    if own.is_file():
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(own, target)
