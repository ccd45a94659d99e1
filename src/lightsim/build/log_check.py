"""Check of a recording before a build: contents, gaps and their cost, as a page with overlays."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Int64, UInt8
from PIL import Image, ImageDraw

from lightsim.build.options import BuildOptions
from lightsim.build.suitability import check_suitable, ego_path_m, light_notes, standing_cost
from lightsim.core.log import DrivingLog
from lightsim.core.reading import LogReading
from lightsim.core.sensors import CameraFrame, LazySweep, LidarSweep
from lightsim.errors import InputError
from lightsim.view.log_overlay import Overlay, draw_overlay
from lightsim.view.report import Card, Figure, Section, Table, write_report

PAGE_NAME = "check.html"
# Width of the overlays, in pixels: two fit side by side on a page.
_WIDTH_PX = 960
# Returns of a sweep below which surfaces are reconstructed coarsely: 32 beams have some 30,000,
# PandaSet's two LiDARs 170,000.
_SPARSE_RETURNS = 50_000
# Largest usual time from a picture to the nearest sweep: half a turn at 10 Hz.
_GAP_S = 0.06


@dataclass(frozen=True)
class Finding:
    """Missing part of a recording and its consequence; a build is impossible if `is_fatal`."""

    what: str
    cost: str
    is_fatal: bool = False


@dataclass(frozen=True, eq=False)
class LogCheck:
    """Result of a check.

    Args:
        overlays: one picture of each camera, from the middle of the log.
        returns: median number of LiDAR returns of the sweeps that were read.
    """

    log: DrivingLog
    findings: tuple[Finding, ...]
    overlays: tuple[Overlay, ...]
    returns: int | None

    @property
    def fatal(self) -> tuple[Finding, ...]:
        """Findings with which a build cannot work."""
        return tuple(finding for finding in self.findings if finding.is_fatal)


def check_log(log: DrivingLog, reading: LogReading) -> LogCheck:
    """Return what a log has and lacks; reads one picture of each camera and few sweeps."""
    frames = [_middle(log.frames_of(name)) for name in log.cameras]
    sweeps: dict[str, LidarSweep] = {}
    overlays = [_overlay(log, frame, sweeps) for frame in frames]
    returns = [len(sweep.points_world) for sweep in sweeps.values()]
    median = int(np.median(returns)) if returns else None
    findings = (*_fatal(log, reading), *_costs(log, overlays, median))
    return LogCheck(log, findings, tuple(overlays), median)


def write_check(folder: Path, check: LogCheck, reading: LogReading) -> Path:
    """Write the page of a check and return its path."""
    log = check.log
    verdict = "no" if check.fatal else "yes"
    first, last = log.frames[0].time_ns, log.frames[-1].time_ns
    cards = (
        Card("Can it be built?", verdict, check.fatal[0].what if check.fatal else ""),
        Card("Duration", f"{(last - first) * 1e-9:.1f} s", f"{len(log.stems)} frames"),
        Card("Ego path", f"{ego_path_m(log):.0f} m", ""),
        Card("Cameras", str(len(log.cameras)), f"{len(log.frames)} pictures"),
        Card("LiDAR sweeps", str(len(log.sweeps)),
             "" if check.returns is None else f"{check.returns:,} returns each"),
        Card("Labelled actors", str(len(log.actors)),
             f"{sum(a.is_moving for a in log.actors)} moving"),
    )  # fmt: skip
    gaps = Table(
        ("Missing or unusual", "Cost"),
        [(f.what, f.cost) for f in check.findings] or [("nothing", "")],
    )
    legend = (
        "LiDAR returns are coloured by depth, near red to far blue. Boxes are green, their front "
        "face pink. The orange ring is the sun. A yellow line leads from the foot of each box to "
        "the shadow of its top: real shadows must lie along it, if time, place and north are right."
    )
    sections = [
        Section("What is missing, and what it costs", tables=[gaps]),
        Section("LiDAR and boxes on the pictures", legend,
                figures=[Figure(_caption(o), o.image) for o in check.overlays]),
        Section("Sensors over time", figures=[Figure("One mark for each picture and sweep.",
                                                     _timeline(log), is_wide=True)]),
        Section("Cameras", tables=[_camera_table(log)]),
        Section("Place, time and sun", tables=[_place_table(log)]),
        Section("Actors", tables=[_actor_table(log)]),
        Section("Notes of the reader", "\n\n".join(log.notes) or "None."),
    ]  # fmt: skip
    path = folder / PAGE_NAME
    write_report(path, f"Check of {log.name}", sections, subtitle=reading.source, cards=cards)
    return path


def _middle(frames: Sequence[CameraFrame]) -> CameraFrame:
    return frames[len(frames) // 2]


def _overlay(log: DrivingLog, frame: CameraFrame, sweeps: dict[str, LidarSweep]) -> Overlay:
    lazy = _nearest(log.sweeps, frame.time_ns)
    if lazy is not None and lazy.stem not in sweeps:
        sweeps[lazy.stem] = lazy.load()
    sweep = None if lazy is None else sweeps[lazy.stem]
    return draw_overlay(log, frame, sweep, _WIDTH_PX)


def _nearest(sweeps: Sequence[LazySweep], time_ns: int) -> LazySweep | None:
    return min(sweeps, key=lambda sweep: abs(sweep.time_ns - time_ns), default=None)


def _fatal(log: DrivingLog, reading: LogReading) -> list[Finding]:
    """Return the reason for which a build would stop at once."""
    try:
        check_suitable(log, BuildOptions(reading=reading), ("fields", "sky"))
    except InputError as error:
        return [Finding(error.what, error.remedy or "it cannot be built", is_fatal=True)]
    return []


def _costs(log: DrivingLog, overlays: Sequence[Overlay], returns: int | None) -> list[Finding]:
    geo = log.geo
    frame = _middle(log.frames)
    sun = None if geo is None else geo.sun_at(frame.time_ns)
    is_towards = geo is not None and geo.direction_at(frame.time_ns) is not None
    gaps_s = [abs(o.sweep_gap_s) for o in overlays if o.sweep_gap_s is not None]
    empty = [o.camera_name for o in overlays if o.returns == 0 and o.sweep_gap_s is not None]
    standing = standing_cost(log)
    found = [
        (not log.actors, "no labelled boxes",
         "moving cars are smeared over the background and cannot be removed or moved"),
        (not log.semantic_names, "no point classes", "materials are inferred from shapes"),
        (sun is None, "the position of the sun is unknown",
         "it is found from shadows and sky, to some degrees under a clear sun; give --sun, or "
         "--place and --utc"),
        (sun is not None and not is_towards, "north is unknown",
         "the sun's azimuth is found from shadows and sky; give --heading-deg"),
        (len(log.cameras) == 1, "one camera", "the sky dome is observed in one direction only"),
        (standing is not None, *(standing or ("", ""))),
        (returns is not None and returns < _SPARSE_RETURNS,
         f"{returns:,} returns in a sweep" if returns is not None else "",
         "few beams: distant surfaces and thin objects are coarse"),
        (bool(gaps_s) and max(gaps_s) > _GAP_S,
         f"pictures are up to {max(gaps_s, default=0.0):.2f} s from the nearest sweep",
         "moving actors are scanned at another time than they are pictured"),
        (bool(empty), f"no LiDAR return in {', '.join(empty)}",
         "these cameras see inferred surfaces only, or their pose is wrong"),
    ]  # fmt: skip
    dark = [Finding(note, "light is modelled by day only") for note in light_notes(log)]
    return [Finding(what, cost) for is_there, what, cost in found if is_there] + dark


def _caption(overlay: Overlay) -> str:
    gap = "" if overlay.sweep_gap_s is None else f", sweep {overlay.sweep_gap_s * 1e3:+.0f} ms"
    return (
        f"{overlay.camera_name}, frame {overlay.stem}: {overlay.returns:,} returns, "
        f"{overlay.boxes} boxes{gap}"
    )


def _camera_table(log: DrivingLog) -> Table:
    rows = []
    for name, camera in log.cameras.items():
        frames = log.frames_of(name)
        times = np.array([frame.time_ns for frame in frames])
        rate = float(1e9 / np.median(np.diff(times))) if len(times) > 1 else None
        view_deg = float(np.degrees(2 * np.arctan(camera.width_px / camera.fx / 2)))
        shutter = frames[0].shutter
        readout = 0.0 if shutter is None else shutter.readout_s or shutter.readout_across_s
        size = f"{camera.width_px}x{camera.height_px}"
        rate_text = "-" if rate is None else f"{rate:.1f}"
        cells = (f"{view_deg:.0f}", len(frames), rate_text, f"{readout * 1e3:.0f}")
        rows.append((name, size, *cells))
    columns = ("Camera", "Size used, px", "View, degrees", "Pictures", "Per second", "Readout, ms")
    return Table(columns, rows)


def _place_table(log: DrivingLog) -> Table:
    geo = log.geo
    rows: list[tuple[str, str, str]] = []
    place, clock = (None, None) if geo is None else (geo.place, geo.clock)
    rows.append(
        ("Place", "unknown", "")
        if place is None
        else ("Place", f"{place.latitude_deg:.5f}, {place.longitude_deg:.5f}", place.origin)
    )
    frame = _middle(log.frames)
    utc = None if clock is None else np.datetime64(frame.time_ns + clock.utc_minus_log_ns, "ns")
    rows.append(
        (
            "Time of the middle (UTC)",
            "unknown" if utc is None else str(utc)[:19],
            "" if clock is None else clock.origin,
        )
    )
    heading = None if geo is None else geo.heading_deg
    rows.append(
        (
            "Azimuth of world +x",
            "unknown" if heading is None else f"{heading:.2f} degrees",
            "" if geo is None else geo.heading_origin,
        )
    )
    sun = None if geo is None else geo.sun_at(frame.time_ns)
    known = (
        "unknown"
        if sun is None
        else (f"azimuth {sun.azimuth_deg:.1f}, elevation {sun.elevation_deg:.1f} degrees")
    )
    rows.append(("Sun", known, "given" if geo is not None and geo.given_sun else ""))
    return Table(("", "Value", "Source"), rows)  # fmt: skip


def _actor_table(log: DrivingLog) -> Table:
    counts: Mapping[str, int] = Counter(str(actor.kind) for actor in log.actors)
    moving: Mapping[str, int] = Counter(str(a.kind) for a in log.actors if a.is_moving)
    rows = [(kind, n, moving.get(kind, 0)) for kind, n in sorted(counts.items())]
    return Table(("Kind", "Actors", "Moving"), rows or [("none", 0, 0)])


def _timeline(log: DrivingLog) -> UInt8[np.ndarray, "h w 3"]:
    """Return a chart with one row for each sensor and one mark for each picture and sweep."""
    rows: list[tuple[str, Int64[np.ndarray, " n"]]] = [
        (name, np.array([frame.time_ns for frame in log.frames_of(name)])) for name in log.cameras
    ]
    rows.append(("LiDAR", np.array([sweep.time_ns for sweep in log.sweeps], dtype=np.int64)))
    labels = sorted({t for actor in log.actors for t in actor.trajectory.times_ns.tolist()})
    rows.append(("boxes", np.array(labels, dtype=np.int64)))
    start = min(int(times.min()) for _, times in rows if len(times))
    span = max(int(times.max()) for _, times in rows if len(times)) - start
    left, width, high = 170, 1200, 22
    chart = Image.new("RGB", (left + width + 20, high * len(rows) + 30), (255, 255, 255))
    pen = ImageDraw.Draw(chart)
    for i, (name, times) in enumerate(rows):
        y = 6 + i * high
        pen.text((8, y + 4), name[:26], fill=(60, 60, 60))
        pen.line((left, y + high - 3, left + width, y + high - 3), fill=(225, 225, 225))
        for x in np.unique(left + (times - start) * width // max(span, 1)).tolist():
            pen.line((x, y + 2, x, y + high - 4), fill=(30, 90, 180))
    pen.text((left, high * len(rows) + 10), "0 s", fill=(60, 60, 60))
    pen.text((left + width - 40, high * len(rows) + 10), f"{span * 1e-9:.1f} s", fill=(60, 60, 60))
    return np.asarray(chart)
