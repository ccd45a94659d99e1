"""Whether pictures agree with each other: between cameras, and from frame to frame, through the
exact geometry and motion of the twin."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np

from lightsim.build.workspace import Workspace
from lightsim.core.colour import linear_from_srgb8
from lightsim.core.sensors import CameraFrame
from lightsim.progress import Progress
from lightsim.render.frame_renderer import FrameRenderer
from lightsim.render.transport.matrix import TransportConfig
from lightsim.scenario.replay import replay
from lightsim.store.images import read_srgb8
from lightsim_lab.metrics.consistency import (
    ConsistencyRow,
    View,
    match,
    picture_differences,
)
from lightsim_lab.metrics.folders import pair_folders

_FEWEST = 200
"""Fewer matching pixels tell nothing."""
RECORDED = "recorded"
"""The method whose warp error the others' are divided by."""


@dataclass(frozen=True, eq=False)
class _Seen:
    """The geometry of one frame, its camera's gain, and the files that show it."""

    view: View
    gain: np.ndarray
    files: Mapping[str, Path]

    def by(self, method: str) -> View:
        """What a method shows."""
        picture = linear_from_srgb8(read_srgb8(self.files[method]))
        return replace(self.view, radiance=picture / self.gain)


@dataclass
class _Sums:
    count: int = 0
    points: int = 0
    delta_e: float = 0.0
    absolute: float = 0.0


def picture_consistency(
    workspace: Workspace, condition: str, folders: Mapping[str, Path], progress: Progress
) -> tuple[ConsistencyRow, ...]:
    """Colour differences of what two cameras see at one time, and of what one camera sees in
    successive frames (of those that there are).

    Cameras' own gains are taken out. Pictures have the size of the build.

    Args:
        folders: of frames (<camera>/<frame>.png), by method; "recorded" is what others' warp
            errors are compared with.

    Raises:
        InputError: a folder is missing, or they share no frame.
    """
    sums: dict[tuple[str, str], _Sums] = {}
    before: dict[str, _Seen] = {}
    by_stem: dict[str, list[tuple[str, dict[str, Path]]]] = {}
    for camera, stem, files in pair_folders(folders):
        by_stem.setdefault(stem, []).append((camera, files))
    looking = _Looking(workspace)
    for stem, cameras in progress.track(sorted(by_stem.items()), "compare views", len(by_stem)):
        seen = [looking.seen(camera, stem, files) for camera, files in cameras]
        for one, other in combinations(seen, 2):
            _add(sums, "cameras", one, other)
        for now in seen:
            last = before.get(now.view.camera.name)
            if last is not None:
                _add(sums, "frames", last, now)
            before[now.view.camera.name] = now
    return _rows(condition, sums)


class _Looking:
    """What frames of the twin show."""

    def __init__(self, workspace: Workspace) -> None:
        self._log, twin = workspace.log, workspace.twin
        assets = twin.assets
        self._gains = assets.camera_gains
        self._renderer = FrameRenderer(assets.background, workspace.inferred, TransportConfig(), 0)
        self._scenario = replay(twin, "consistency", self._log.frames)

    def seen(self, camera_name: str, stem: str, files: Mapping[str, Path]) -> _Seen:
        frame: CameraFrame = next(f for f in self._log.frames_of(camera_name) if f.stem == stem)
        camera, scenario = self._log.cameras[camera_name], self._scenario
        buffers = self._renderer.geometry(scenario, frame, camera)
        poses = {
            scenario.number_by_actor[p.track.actor_id]: p.world_from_actor(frame.time_ns)
            for p in scenario.placements_at(frame.time_ns)
        }
        view = View(frame, camera, buffers, buffers.base_colour, poses)
        return _Seen(view, self._gains[camera_name], files)


def _add(sums: dict[tuple[str, str], _Sums], pairs: str, one: _Seen, other: _Seen) -> None:
    matches = match(one.view, other.view, one.view.buffers.has_surface)
    if len(matches.pixel) < _FEWEST:
        return
    for method in one.files:
        delta_e, absolute = picture_differences(one.by(method), other.by(method), matches)
        total = sums.setdefault((method, pairs), _Sums())
        total.count += 1
        total.points += len(matches.pixel)
        total.delta_e += delta_e
        total.absolute += absolute


def _rows(condition: str, sums: Mapping[tuple[str, str], _Sums]) -> tuple[ConsistencyRow, ...]:
    rows = []
    for (method, pairs), total in sums.items():
        warp = total.absolute / total.points
        recorded = sums.get((RECORDED, pairs), _Sums())
        # Every method has the same points; pictures that never change have no error to compare.
        relative = total.absolute / recorded.absolute if recorded.absolute else float("nan")
        delta_e = total.delta_e / total.points
        rows.append(
            ConsistencyRow(
                condition, method, pairs, total.count, total.points, delta_e, warp, relative
            )
        )
    return tuple(rows)
