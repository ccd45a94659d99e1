"""`--write-log`: the simulated log in PandaSet's layout, like a recorded log.

Data that no edit changes is the recording's: files are copied, and rows and list entries are taken
over. Files are numbered from 00 without gaps. Thus the k-th image, sweep, pose and time belong
together, both for readers that count files (PandaSet's devkit) and for readers that use file names.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from lightsim.build.sources import simulation_sources
from lightsim.build.workspace import Workspace
from lightsim.core.scenario import Scenario, ScenarioFrame
from lightsim.core.version import __version__
from lightsim.datasets.files import is_gzip, read_packed, read_times_ns
from lightsim.datasets.pandaset.log import SIMULATED_NAME
from lightsim.datasets.pandaset.numbered import PICTURES, TABLES, numbered_files
from lightsim.datasets.pandaset.places import BOXES, CLASSES, SWEEPS
from lightsim.datasets.pandaset.rig import read_rig
from lightsim.datasets.pandaset.sweeps import ScanTiming, SweepSource, measure_timing
from lightsim.datasets.reader import check_layout
from lightsim.datasets.safe_pickle import MAX_BYTES, names_in, parse_table, read_table
from lightsim.errors import ArtefactError, InputError
from lightsim.export.pandaset.boxes import BoxEditor
from lightsim.export.pandaset.lists import ListWriter, WrittenFrames
from lightsim.export.pandaset.sweeps import SweepEditor
from lightsim.export.place import check_place
from lightsim.progress import Progress
from lightsim.store.artefact import RECORD_NAME, hash_names, read_json, write_json
from lightsim.store.images import read_srgb8, write_jpeg
from lightsim.store.pandaset_tables import write_packed, write_table
from lightsim.store.table_pickle import PORTABLE_NAMES

# Quality of written JPEGs, with full chroma. Chosen; sensitivity not measured.
_JPEG_QUALITY = 95
_SUFFIX = ".pkl.gz"
_JPEG_MAGIC = b"\xff\xd8\xff"


@dataclass(frozen=True, eq=False)
class LogWriter:
    """Writer of one simulated log.

    Args:
        workspace: of the recording.
        recorded: the log without edits, in the requested frames.
        scenario: made from it by edits; the same object if there are none.
        progress: shows images and sweeps.
    """

    workspace: Workspace
    recorded: Scenario
    scenario: Scenario
    progress: Progress

    def write(self, folder: Path) -> None:
        """Fill a new folder with everything except images and simulated.json."""
        ListWriter(self.workspace, self.recorded, self.scenario, self._frames).write(folder)
        self._write_sweeps(folder)
        self._write_boxes(folder)

    def write_mark(self, folder: Path, made_of: Mapping[str, Any]) -> None:
        """Write simulated.json."""
        scenario = self.scenario
        # The recorded stem of each new one, for a comparison with the recording.
        stems = zip(self._frames.stems.values(), self._frames.recorded_stems.values(), strict=True)
        mark = {
            "simulated_by": f"LightSim {__version__}",
            "recording": self.workspace.recorded_log.name,
            "scenario": scenario.name,
            "edits": scenario.edits,
            "recorded_frames": dict(stems),
            "jpeg_quality": _JPEG_QUALITY,
            "notes": scenario.notes,
            "code": _code(),
            **made_of,
        }
        write_json(folder / SIMULATED_NAME, mark)

    def write_pictures(self, folder: Path, frames: Path) -> None:
        """Write camera/<name>/NN.jpg.

        An unchanged recorded JPEG is copied; other images are JPEGs of quality 95 with full chroma.
        """
        source = self._source / "camera"
        recorded = {name: numbered_files(source / name, PICTURES) for name in self._cameras}
        files = self.picture_files
        for name, frame in self.progress.track(files, "write pictures", len(files)):
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            # Simulated frames are lossless PNG, so an unchanged frame is identical to its JPEG's
            # pixels.
            made = read_srgb8(frames / "frames" / frame.camera_name / f"{frame.stem}.png")
            own = recorded[frame.camera_name].paths[int(frame.stem)]
            shown = read_srgb8(own)
            is_jpeg = own.read_bytes()[: len(_JPEG_MAGIC)] == _JPEG_MAGIC
            if is_jpeg and made.shape == shown.shape and np.array_equal(made, shown):
                shutil.copyfile(own, path)
            else:
                write_jpeg(path, made, quality=_JPEG_QUALITY)

    @property
    def picture_files(self) -> list[tuple[str, ScenarioFrame]]:
        """File of each written picture, relative to the log's folder, with its frame."""
        return [
            (f"camera/{frame.camera_name}/{self._file(frame.stem, '.jpg')}", frame)
            for frame in self.scenario.frames
            if int(frame.stem) in self._frames.stems
        ]

    @property
    def _cameras(self) -> set[str]:
        return {frame.camera_name for frame in self.scenario.frames}

    def _write_sweeps(self, folder: Path) -> None:
        """Write lidar/NN.pkl.gz and annotations/semseg/NN.pkl.gz."""
        editor = SweepEditor(self.workspace, self.recorded, self.scenario, self.progress)
        sweeps = [s for s in self.workspace.log.sweeps if int(s.stem) in self._frames.stems]
        recorded, classes = self._tables(SWEEPS), self._tables(CLASSES)
        for lazy in self.progress.track(sweeps, "write sweeps", len(sweeps)):
            number, name = int(lazy.stem), self._file(lazy.stem, _SUFFIX)
            made = editor.edited(lazy)
            if made is None:
                # An unchanged sweep is copied with its point classes.
                copy_table(recorded[number], folder / SWEEPS / name, "index")
                if number in classes:
                    copy_table(classes[number], folder / CLASSES / name)
                continue
            write_table(folder / SWEEPS / name, made.columns, "index")
            if number in classes:
                write_table(folder / CLASSES / name, {"class": made.semantic_class})
        _copy(self._source / CLASSES / "classes.json", folder / CLASSES / "classes.json")

    def _write_boxes(self, folder: Path) -> None:
        """Write annotations/cuboids/NN.pkl.gz; nothing without sweep times, for which boxes are
        valid."""
        clock = self._source / SWEEPS / "timestamps.json"
        if not clock.is_file():
            return
        times_ns = read_times_ns(clock)
        paths = self._tables(BOXES)
        tables = {n: read_table(path, ("uuid",)) for n, path in paths.items()}
        path = self.workspace.alignment.path
        editor = BoxEditor.between(
            self.recorded, self.scenario, list(tables.values()), self._timing, path
        )
        for number, stem in self._frames.stems.items():
            target = folder / BOXES / f"{stem}{_SUFFIX}"
            made = editor.edited(tables.get(number), int(times_ns[number]))
            if made is not None:
                write_table(target, made)
            elif number in paths:
                copy_table(paths[number], target)

    def _tables(self, part: str) -> Mapping[int, Path]:
        return numbered_files(self._source / part, TABLES).paths

    @cached_property
    def _source(self) -> Path:
        return Path(self.workspace.reading.source)

    @cached_property
    def _frames(self) -> WrittenFrames:
        return _written_frames(self.workspace, self.scenario)

    def _file(self, recorded_stem: str, suffix: str) -> str:
        return f"{self._frames.stems[int(recorded_stem)]}{suffix}"

    @cached_property
    def _timing(self) -> ScanTiming:
        # Scan times are estimated from one recorded sweep, since they are a property of the LiDAR.
        log = self.workspace.recorded_log
        if not log.sweeps:
            return ScanTiming.instantaneous()
        lazy = log.sweeps[0]
        path = self._tables(SWEEPS)[int(lazy.stem)]
        rig = read_rig(self._source)
        return measure_timing(SweepSource(path, None, lazy.stem, lazy.time_ns, log.ego, rig))


def _written_frames(workspace: Workspace, scenario: Scenario) -> WrittenFrames:
    return WrittenFrames.of(scenario, [sweep.stem for sweep in workspace.log.sweeps])


def log_folders(
    workspace: Workspace, recorded: Scenario, target: Path, skies: Sequence[str]
) -> dict[str, Path]:
    """Return the folder of each sky's simulated log: DIR, or DIR/<sky> with several skies.

    Called before frames are rendered, which takes long, so that errors come early.

    Raises:
        InputError: the recording is not in PandaSet's layout, no frame can be written, or DIR
            cannot be used.
        ArtefactError: DIR's parent cannot be created.
    """
    if check_layout(workspace.reading) != "pandaset":
        raise InputError(
            "the recording is not in PandaSet's layout, the only one in which logs are written",
            where="--write-log",
            expected="a recording in that layout",
            remedy="Omit --write-log.",
        )
    _written_frames(workspace, recorded)
    # Links are resolved: the folder itself is replaced, never a link to it.
    target = Path(os.path.realpath(target))
    if len(skies) > 1 and (target / SIMULATED_NAME).exists():
        raise InputError(
            "the folder contains a log, so it cannot contain a log of each sky",
            where=target,
            got=f"one log in the folder, {len(skies)} requested skies",
            remedy="Choose another --write-log.",
        )
    logs = {sky: target if len(skies) == 1 else target / sky for sky in skies}
    taken = Path(workspace.reading.source), workspace.root / "scenarios"
    for log in logs.values():
        check_place(log, taken, "--write-log")
        _mark_of(log)
    return logs


def write_logs(
    writer: LogWriter, logs: Mapping[str, Path], frames: Sequence[Path], *, is_overwriting: bool
) -> None:
    """Write the simulated log of each sky; complete logs of the same frames are skipped.

    Args:
        logs: from `log_folders`.
        frames: WORK/scenarios/NAME of each sky.
        is_overwriting: replace logs of other scenarios.

    Raises:
        InputError: a folder contains the log of another scenario.
    """
    first: Path | None = None
    for (sky, log), folder in zip(logs.items(), frames, strict=True):
        made_of = {"sky": sky, "frames_key": read_json(folder / RECORD_NAME)["key"]}
        if not _is_made(log, made_of, is_overwriting=is_overwriting):
            _write_log(writer, log, folder, made_of, first)
        # The first log, new or already complete, is the source of the others.
        first = first or log


def _write_log(
    writer: LogWriter, log: Path, frames: Path, made_of: Mapping[str, Any], other: Path | None
) -> None:
    """Write a log atomically; logs of further skies are copies of the first with other images."""
    partial = log.with_name(f".{log.name}.partial")
    # Left by an interrupted run.
    if partial.exists():
        shutil.rmtree(partial)
    if other is None:
        partial.mkdir()
        writer.write(partial)
    else:
        # Sweeps and boxes do not depend on the sky.
        shutil.copytree(other, partial, ignore=shutil.ignore_patterns("*.jpg", SIMULATED_NAME))
    writer.write_pictures(partial, frames)
    writer.write_mark(partial, made_of)
    if log.exists():
        shutil.rmtree(log)
    partial.rename(log)


def _is_made(log: Path, made_of: Mapping[str, Any], *, is_overwriting: bool) -> bool:
    """Return true if the folder contains the log that would be written now."""
    mark = _mark_of(log)
    if mark is None:
        return False
    is_same = all(mark.get(key) == value for key, value in made_of.items())
    if not (is_same or is_overwriting):
        raise InputError(
            "the folder contains the log of another scenario, or of other frames",
            where=log,
            got=f"scenario {mark.get('scenario')}, sky {mark.get('sky')}",
            remedy="Choose another --write-log, or add --overwrite.",
        )
    return is_same and mark.get("code") == _code()


def _code() -> str:
    """Return the hash of the source code that writes logs; logs of other code are written anew."""
    return hash_names(simulation_sources(__name__))


def _mark_of(log: Path) -> Mapping[str, Any] | None:
    """Return simulated.json of an existing log; None if the folder is absent or empty.

    Raises:
        InputError: the folder contains anything else, which is never replaced.
    """
    try:
        if not log.exists() or (log.is_dir() and not any(log.iterdir())):
            return None
        mark = read_json(log / SIMULATED_NAME)
    except (OSError, ArtefactError):
        mark = None
    # Only folders that this module wrote may be replaced.
    if not isinstance(mark, dict) or "frames_key" not in mark:
        raise InputError(
            "the folder for the log contains other files",
            where=log,
            expected="no folder, an empty one or a log that was written before",
            remedy="Choose another --write-log.",
        )
    return mark


def copy_table(own: Path, target: Path, index_name: str | None = None) -> None:
    """Write a recorded table as NN.pkl.gz; its bytes are copied if pandas 1.0 can load them.

    Args:
        index_name: name of the index if the table is written anew.

    Raises:
        InputError: it cannot be read.
    """
    # Old pandas cannot load pickles of newer versions: the names in the pickle show which it is.
    data = read_packed(own, MAX_BYTES)
    if not names_in(data, own) <= PORTABLE_NAMES:
        write_table(target, parse_table(data, own), index_name)
    elif is_gzip(own):
        _copy(own, target)
    else:
        write_packed(target, data)


def _copy(own: Path, target: Path) -> None:
    if own.is_file():
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(own, target)
