"""`--write-log`: the simulated log in PandaSet's own layout, as if it had been recorded.

What no edit touches is the recording itself: files are copied, rows and list entries taken over.
Files are numbered from 00 without gaps, so that the k-th picture, sweep, pose and time belong
together for readers that count files (PandaSet's devkit) as for those that read their names.
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
from lightsim.core.scenario import Scenario
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
from lightsim.progress import Progress
from lightsim.store.artefact import RECORD_NAME, hash_names, read_json, write_json
from lightsim.store.atomic import unwritable
from lightsim.store.images import read_srgb8, write_jpeg
from lightsim.store.pandaset_tables import write_packed, write_table
from lightsim.store.table_pickle import PORTABLE_NAMES

_JPEG_QUALITY = 95
_SUFFIX = ".pkl.gz"
_JPEG_MAGIC = b"\xff\xd8\xff"


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
            "code": _code(),
            **made_of,
        }
        write_json(folder / SIMULATED_NAME, mark)

    def write_pictures(self, folder: Path, frames: Path) -> None:
        """camera/<name>/NN.jpg: the recorded bytes where the picture is the recorded JPEG, else of
        JPEG quality 95 with full chroma."""
        source = self._source / "camera"
        recorded = {name: numbered_files(source / name, PICTURES) for name in self._cameras}
        kept = [f for f in self.scenario.frames if int(f.stem) in self._frames.stems]
        for frame in self.progress.track(kept, "write pictures", len(kept)):
            path = folder / "camera" / frame.camera_name / self._file(frame.stem, ".jpg")
            path.parent.mkdir(parents=True, exist_ok=True)
            made = read_srgb8(frames / "frames" / frame.camera_name / f"{frame.stem}.png")
            own = recorded[frame.camera_name].paths[int(frame.stem)]
            shown = read_srgb8(own)
            is_jpeg = own.read_bytes()[: len(_JPEG_MAGIC)] == _JPEG_MAGIC
            if is_jpeg and made.shape == shown.shape and np.array_equal(made, shown):
                shutil.copyfile(own, path)
            else:
                write_jpeg(path, made, quality=_JPEG_QUALITY)

    @property
    def _cameras(self) -> set[str]:
        return {frame.camera_name for frame in self.scenario.frames}

    def _write_sweeps(self, folder: Path) -> None:
        """lidar/NN.pkl.gz and annotations/semseg/NN.pkl.gz."""
        editor = SweepEditor(self.workspace, self.recorded, self.scenario, self.progress)
        sweeps = [s for s in self.workspace.log.sweeps if int(s.stem) in self._frames.stems]
        recorded, classes = self._tables(SWEEPS), self._tables(CLASSES)
        for lazy in self.progress.track(sweeps, "write sweeps", len(sweeps)):
            number, name = int(lazy.stem), self._file(lazy.stem, _SUFFIX)
            made = editor.edited(lazy)
            if made is None:
                copy_table(recorded[number], folder / SWEEPS / name, "index")
                if number in classes:
                    copy_table(classes[number], folder / CLASSES / name)
                continue
            write_table(folder / SWEEPS / name, made.columns, "index")
            if number in classes:
                write_table(folder / CLASSES / name, {"class": made.semantic_class})
        _copy(self._source / CLASSES / "classes.json", folder / CLASSES / "classes.json")

    def _write_boxes(self, folder: Path) -> None:
        """annotations/cuboids/NN.pkl.gz; boxes are of a sweep's time, so without times there are
        none."""
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
    """Where the simulated log of each sky goes: DIR, of several skies DIR/<sky>. Asked before
    frames are made, which takes long.

    Raises:
        InputError: the recording is not in PandaSet's layout, no frame can be written, or DIR
            cannot be taken.
        ArtefactError: DIR's parent cannot be made.
    """
    if check_layout(workspace.reading) != "pandaset":
        raise InputError(
            "logs are written in PandaSet's layout only",
            where="--write-log",
            expected="a recording in that layout",
            remedy="Leave --write-log out.",
        )
    _written_frames(workspace, recorded)
    # The folder itself is replaced, never a link to it.
    target = Path(os.path.realpath(target))
    if len(skies) > 1 and (target / SIMULATED_NAME).exists():
        raise InputError(
            "a folder holds one log, or a log of each sky",
            where=target,
            got=f"one log there, {len(skies)} skies asked for",
            remedy="Choose another --write-log.",
        )
    logs = {sky: target if len(skies) == 1 else target / sky for sky in skies}
    taken = Path(workspace.reading.source), workspace.root / "scenarios"
    for log in logs.values():
        _check_place(log, [path.resolve() for path in taken])
    return logs


def _check_place(log: Path, taken: Sequence[Path]) -> None:
    """A log stands in no folder whose files are counted: a recording's, an artefact's."""
    around = [p for p in (log, *log.parents) if p in taken or (p / RECORD_NAME).is_file()]
    if around:
        raise InputError(
            "the log would stand among files that are not its own",
            where=log,
            expected=f"a folder outside of {around[0]}",
            remedy="Choose another --write-log.",
        )
    _mark_of(log)
    try:
        log.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise unwritable(log, error) from error


def write_logs(
    writer: LogWriter, logs: Mapping[str, Path], frames: Sequence[Path], *, is_overwriting: bool
) -> None:
    """Write the simulated log of each sky; finished ones of the same frames are kept.

    Args:
        logs: from `log_folders`.
        frames: WORK/scenarios/NAME of each sky.

    Raises:
        InputError: a folder holds the log of another scenario.
    """
    first: Path | None = None
    for (sky, log), folder in zip(logs.items(), frames, strict=True):
        made_of = {"sky": sky, "frames_key": read_json(folder / RECORD_NAME)["key"]}
        if not _is_made(log, made_of, is_overwriting=is_overwriting):
            _write_log(writer, log, folder, made_of, first)
        first = first or log


def _write_log(
    writer: LogWriter, log: Path, frames: Path, made_of: Mapping[str, Any], other: Path | None
) -> None:
    """A log that appears whole or not at all; only its pictures differ from that of another sky."""
    partial = log.with_name(f".{log.name}.partial")
    if partial.exists():
        shutil.rmtree(partial)
    if other is None:
        partial.mkdir()
        writer.write(partial)
    else:
        shutil.copytree(other, partial, ignore=shutil.ignore_patterns("*.jpg", SIMULATED_NAME))
    writer.write_pictures(partial, frames)
    writer.write_mark(partial, made_of)
    if log.exists():
        shutil.rmtree(log)
    partial.rename(log)


def _is_made(log: Path, made_of: Mapping[str, Any], *, is_overwriting: bool) -> bool:
    """Whether a log is there already, as it would be written now."""
    mark = _mark_of(log)
    if mark is None:
        return False
    is_same = all(mark.get(key) == value for key, value in made_of.items())
    if not (is_same or is_overwriting):
        raise InputError(
            "the folder holds the log of another scenario, or of other frames",
            where=log,
            got=f"scenario {mark.get('scenario')}, sky {mark.get('sky')}",
            remedy="Choose another --write-log, or give --overwrite.",
        )
    return is_same and mark.get("code") == _code()


def _code() -> str:
    """Return the hash of the source code that writes logs; a log of other code is made anew."""
    return hash_names(simulation_sources(__name__))


def _mark_of(log: Path) -> Mapping[str, Any] | None:
    """simulated.json of a log that stands there; None where nothing does.

    Raises:
        InputError: something else stands there, which is never replaced.
    """
    try:
        if not log.exists() or (log.is_dir() and not any(log.iterdir())):
            return None
        mark = read_json(log / SIMULATED_NAME)
    except (OSError, ArtefactError):
        mark = None
    if not isinstance(mark, dict) or "frames_key" not in mark:
        raise InputError(
            "something else stands where the log is to be written",
            where=log,
            expected="no folder, an empty one or a log that was written before",
            remedy="Choose another --write-log.",
        )
    return mark


def copy_table(own: Path, target: Path, index_name: str | None = None) -> None:
    """Write a recorded table as NN.pkl.gz: its own bytes where pandas 1.0 can load them, else anew.

    Args:
        index_name: of the rows of a table that is written anew.

    Raises:
        InputError: it cannot be read.
    """
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
