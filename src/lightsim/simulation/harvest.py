"""Reconstructed actors of a log: a page with their observed fraction, and export to the library."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from lightsim.build.workspace import Workspace
from lightsim.core.actors import ActorTrack
from lightsim.core.log import DrivingLog
from lightsim.core.mesh import Provenance, TriMesh
from lightsim.core.sensors import CameraFrame
from lightsim.core.twin import ActorAsset
from lightsim.scenario.asset_library import AssetInfo, AssetLibrary
from lightsim.scenario.models import centred
from lightsim.view.report import Figure, Section, Table, write_report

_PAGE = "actors.html"
# Characters of an actor's id in an asset's name: enough to distinguish the actors of a log.
_ID_CHARACTERS = 8
# Margin of a crop, as a fraction of the actor's extent.
_MARGIN = 0.25
# Minimum size of a crop's shorter side, in pixels: smaller actors are not recognisable.
_SMALLEST_PX = 8


@dataclass(frozen=True, eq=False)
class ActorSummary:
    """One actor of a log.

    Args:
        track: poses and times.
        asset: mesh; None if the actor was not reconstructed.
        observed: fraction of the surface that sensors observed.
        nearest_m: smallest distance from the ego vehicle, in metres.
        best: frame with the largest box, and this box: left, top, right, bottom, in pixels.
    """

    track: ActorTrack
    asset: ActorAsset | None
    observed: float
    nearest_m: float
    best: tuple[CameraFrame, tuple[int, int, int, int]] | None


def observed_fraction(mesh: TriMesh) -> float:
    """Return the observed fraction of a mesh: the fraction of its area with measured or mirrored
    shape, weighted by the confidence of the colours."""
    area = mesh.face_areas_m2()
    if not area.sum() > 0:
        return 0.0
    is_shape = mesh.has_provenance(Provenance.MEASURED, Provenance.MIRRORED)
    # A mesh without confidence counts as fully certain.
    colour = np.ones(len(area))
    if mesh.confidence is not None:
        colour = mesh.confidence[mesh.faces].mean(axis=1).astype(np.float64)
    return float((area * is_shape * colour).sum() / area.sum())


def summarise_actors(log: DrivingLog, assets: dict[str, ActorAsset]) -> list[ActorSummary]:
    """Return all actors of a log, sorted by the size of their largest box in a picture."""
    found = []
    for track in log.actors:
        asset = assets.get(track.actor_id)
        seen = 0.0 if asset is None else observed_fraction(asset.mesh)
        times_ns = track.trajectory.times_ns
        # A box may exist longer than the ego trajectory.
        there = [t for t in times_ns.tolist() if log.ego.covers(t)]
        gaps = [
            np.linalg.norm((track.trajectory.at(t).translation_m - log.ego.at(t).translation_m)[:2])
            for t in there
        ]
        nearest_m = float(min(gaps)) if gaps else float("inf")
        found.append(ActorSummary(track, asset, seen, nearest_m, _best_view(log, track)))
    return sorted(found, key=lambda s: 0 if s.best is None else -_area(s.best[1]))


def _area(box: tuple[int, int, int, int]) -> int:
    return (box[2] - box[0]) * (box[3] - box[1])


def _best_view(
    log: DrivingLog, track: ActorTrack
) -> tuple[CameraFrame, tuple[int, int, int, int]] | None:
    """Return the frame in which the actor's whole box is visible and largest, and the box."""
    best = None
    corners = np.stack(np.meshgrid(*[[-0.5, 0.5]] * 3), axis=-1).reshape(-1, 3) * track.size_lwh_m
    for frame in log.frames:
        if not track.is_present(frame.time_ns):
            continue
        camera = log.cameras[frame.camera_name]
        points = track.world_from_actor(frame.time_ns).apply(corners)
        # A box that is cut by the picture's border would show only a part of the actor.
        uv, is_inside = frame.project(camera, points)
        if not is_inside.all():
            continue
        low, high = np.floor(uv.min(axis=0)), np.ceil(uv.max(axis=0))
        box = (int(low[0]), int(low[1]), int(high[0]), int(high[1]))
        if best is None or _area(box) > _area(best[1]):
            best = (frame, box)
    return best


def crop(summary: ActorSummary) -> UInt8[np.ndarray, "h w 3"] | None:
    """Return the part of the best picture around an actor. None if no picture shows the whole box,
    or if the box is too small there."""
    if summary.best is None:
        return None
    frame, (left, top, right, bottom) = summary.best
    if min(right - left, bottom - top) < _SMALLEST_PX:
        return None
    wider, higher = round(_MARGIN * (right - left)), round(_MARGIN * (bottom - top))
    rows = slice(max(0, top - higher), bottom + higher)
    return frame.load_srgb8()[rows, max(0, left - wider) : right + wider]


def write_actors_page(work: Path) -> tuple[Path, list[list[str | float | int]]]:
    """Write WORK/actors.html: a table of the actors that edits can name, and a picture of each.

    Returns:
        Path of the page, and the rows of the table, with the columns of COLUMNS.

    Raises:
        ArtefactError: the twin has not been built.
    """
    workspace = Workspace(work)
    workspace.need("twin")
    summaries = summarise_actors(workspace.log, dict(workspace.twin.assets.actors))
    start_ns = min(frame.time_ns for frame in workspace.log.frames)
    rows = [table_row(summary, start_ns) for summary in summaries]
    figures = [
        Figure(f"{s.track.actor_id}: {s.track.label}, {s.best[0].camera_name} {s.best[0].stem}", p)
        for s in summaries
        if s.best is not None and (p := crop(s)) is not None
    ]
    text = "SCENARIO.json refers to actors by id; times are relative to the first picture."
    sections = [
        Section("Actors", text, tables=[Table(COLUMNS, rows)]),
        Section("Pictures", figures=figures),
    ]
    write_report(work / _PAGE, "Actors", sections, subtitle=f"lightsim actors, {work.name}")
    return work / _PAGE, rows


COLUMNS = ("id", "kind", "motion", "from s", "to s", "nearest m", "seen %", "shape")


def table_row(summary: ActorSummary, start_ns: int) -> list[str | float | int]:
    """Return the row of one actor, with the columns of COLUMNS."""
    track = summary.track
    ends = (track.trajectory.start_ns, track.trajectory.end_ns)
    return [
        track.actor_id,
        str(track.kind),
        "moving" if track.is_moving else "parked",
        *(round((t - start_ns) / 1e9, 2) for t in ends),
        round(summary.nearest_m, 1),
        round(100 * summary.observed),
        "none" if summary.asset is None else f"{len(summary.asset.mesh.faces)} faces",
    ]


def harvest(
    work: Path, library: AssetLibrary, prefix: str, least_seen: float, *, is_replacing: bool
) -> list[AssetInfo]:
    """Store the well observed actors of a twin in a library: geometry and base colour, without the
    light of their log.

    Args:
        work: work folder.
        library: receives the assets.
        prefix: of the assets' names.
        least_seen: smallest observed fraction.
        is_replacing: assets of the same name are replaced.

    Raises:
        ArtefactError: the twin has not been built.
        InputError: a name is in use.
    """
    workspace = Workspace(work)
    workspace.need("twin")
    scored = [(observed_fraction(a.mesh), a) for a in workspace.twin.assets.actors.values()]
    found = []
    for seen, asset in sorted(scored, key=lambda pair: -pair[0]):
        # Actors are sorted: all further ones have a smaller observed fraction.
        if seen < least_seen:
            break
        name = f"{prefix}-{asset.kind.replace(' ', '-')}-{asset.actor_id[:_ID_CHARACTERS]}"
        free = ActorAsset(name, asset.kind, centred(asset.mesh), asset.label)
        origin = f"harvested from {work.resolve().name}"
        found.append(library.add(name, free, origin, seen, is_replacing=is_replacing))
    return found
