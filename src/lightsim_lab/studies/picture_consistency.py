"""Consistency of pictures between cameras and between frames, by the twin's geometry and motion."""

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

# Smallest number of matching pixels of a compared pair.
_MIN_MATCHES = 200
# Method whose warp error is the divisor of relative warp errors.
RECORDED = "recorded"


@dataclass(frozen=True, eq=False)
class _FrameView:
    """Geometry of one frame, camera gain, and picture files by method."""

    view: View
    gain: np.ndarray
    files: Mapping[str, Path]

    def by(self, method: str) -> View:
        """Return the view with the picture of a method."""
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
    """Measure colour differences between cameras at one time, and between successive frames.

    Successive frames are the neighbours among the given frames of one camera. Camera gains are
    divided out. Pictures must have the size of the build.

    Args:
        folders: folders of frames (<camera>/<frame>.png) by method; relative warp errors refer to
            "recorded".

    Raises:
        InputError: a folder is missing, or the folders have no frame in common.
    """
    sums: dict[tuple[str, str], _Sums] = {}
    before: dict[str, _FrameView] = {}
    by_stem: dict[str, list[tuple[str, dict[str, Path]]]] = {}
    for camera, stem, files in pair_folders(folders):
        by_stem.setdefault(stem, []).append((camera, files))
    twin = _TwinViews(workspace)
    for stem, cameras in progress.track(sorted(by_stem.items()), "compare views", len(by_stem)):
        views = [twin.view(camera, stem, files) for camera, files in cameras]
        for one, other in combinations(views, 2):
            _add(sums, "cameras", one, other)
        for now in views:
            last = before.get(now.view.camera.name)
            if last is not None:
                _add(sums, "frames", last, now)
            before[now.view.camera.name] = now
    return _rows(condition, sums)


class _TwinViews:
    """Renderer of the twin's geometry in frames of its log."""

    def __init__(self, workspace: Workspace) -> None:
        self._log, twin = workspace.log, workspace.twin
        assets = twin.assets
        self._gains = assets.camera_gains
        self._renderer = FrameRenderer(assets.background, workspace.inferred, TransportConfig(), 0)
        self._scenario = replay(twin, "consistency", self._log.frames)

    def view(self, camera_name: str, stem: str, files: Mapping[str, Path]) -> _FrameView:
        frame: CameraFrame = next(f for f in self._log.frames_of(camera_name) if f.stem == stem)
        camera, scenario = self._log.cameras[camera_name], self._scenario
        buffers = self._renderer.geometry(scenario, frame, camera)
        poses = {
            scenario.number_by_actor[p.track.actor_id]: p.world_from_actor(frame.time_ns)
            for p in scenario.placements_at(frame.time_ns)
        }
        # Base colour is a placeholder: `by` replaces it by the picture of a method.
        view = View(frame, camera, buffers, buffers.base_colour, poses)
        return _FrameView(view, self._gains[camera_name], files)


def _add(
    sums: dict[tuple[str, str], _Sums], pairs: str, one: _FrameView, other: _FrameView
) -> None:
    matches = match(one.view, other.view, one.view.buffers.has_surface)
    if len(matches.pixel) < _MIN_MATCHES:
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
        # All methods have the same points, so sums may be divided. Constant pictures have error 0.
        relative = total.absolute / recorded.absolute if recorded.absolute else float("nan")
        delta_e = total.delta_e / total.points
        rows.append(
            ConsistencyRow(
                condition, method, pairs, total.count, total.points, delta_e, warp, relative
            )
        )
    return tuple(rows)
