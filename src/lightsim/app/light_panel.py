"""Controls of the sky: kind, sun, day and hour, sky files, exposure."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lightsim.app.server import MAX_UPLOAD_BYTES
from lightsim.app.suns import (
    MIN_ELEVATION_DEG,
    sun_of,
    turbidity_of,
    with_dragged_sun,
)
from lightsim.app.widgets import on_user_event, within
from lightsim.core.checks import MAX_EXPOSURE_EV
from lightsim.core.sky_choice import SkyChoice
from lightsim.core.solar import SolarPosition
from lightsim.errors import InputError
from lightsim.simulation.skies import parse_sky
from lightsim.store.images import read_sky
from lightsim.store.names import safe_file_name

if TYPE_CHECKING:
    from lightsim.app.state import ViewState
    from lightsim.app.viewer_base import ViewerBase

# Kinds of skies in the list.
RECORDED, CLEAR, TIME, FILE = "recorded sky", "clear sky", "day and hour", "sky file"
# Label of the recorded value at a slider.
_NOTCH = "recorded"
_SUFFIXES = (".hdr", ".exr")
# Largest turbidity of the model of clear skies (`clear_sky.TURBIDITY_RANGE`).
_MAX_TURBIDITY = 10.0
# Largest factor on the sun that the slider offers. Chosen.
_MAX_SUN_FACTOR = 3.0
# Largest exposure that the slider offers, in stops. Chosen.
_EV = min(5.0, MAX_EXPOSURE_EV)


class LightPanel:
    """The tab "Light"."""

    def __init__(self, viewer: ViewerBase) -> None:
        self._viewer = viewer
        self._geo = viewer.workspace.log.geo
        self._skies = viewer.folder / "skies"
        gui, icon = viewer.server.gui, viewer.icon
        has_place = self._geo is not None and self._geo.place is not None
        kinds = (RECORDED, CLEAR, *((TIME,) if has_place else ()), FILE)
        self._kind = gui.add_dropdown("Sky", kinds)
        recorded = sun_of(SkyChoice("source"), self._geo, viewer.workspace.sky)
        azimuths, elevations = (), ()
        if recorded is not None:
            azimuths = ((round(recorded.azimuth_deg, 1), _NOTCH),)
            elevations = ((round(recorded.elevation_deg, 1), _NOTCH),)
        self._azimuth = gui.add_slider(
            "Azimuth", 0.0, 360.0, 0.5, 180.0, marks=azimuths, hint="From true north"
        )
        self._elevation = gui.add_slider(
            "Elevation", MIN_ELEVATION_DEG, 90.0, 0.5, 45.0, marks=elevations
        )
        self._turbidity = gui.add_slider("Turbidity", 1.0, _MAX_TURBIDITY, 0.1, 3.0)
        now = self._recorded_time()
        self._hours_east = 0 if not has_place else round(self._place_deg() / 15.0)
        local = now + timedelta(hours=self._hours_east)
        self._date = gui.add_text("Date", f"{local:%Y-%m-%d}", hint="YEAR-MONTH-DAY")
        zone = f"UTC{self._hours_east:+d}"
        hour = round(local.hour + local.minute / 60, 2)
        has_time = self._geo is not None and self._geo.clock is not None
        marks = ((hour, _NOTCH),) if has_time else ()
        self._hour = gui.add_slider("Hour", 0.0, 23.95, 0.05, hour, marks=marks, hint=zone)
        self._file = gui.add_dropdown("File", self._files() or ("",))
        self._upload = gui.add_upload_button(
            "Upload a sky (.hdr, .exr)", mime_type=".hdr,.exr", icon=icon.UPLOAD
        )
        self._yaw = gui.add_slider("Turn the sky", -180.0, 180.0, 1.0, 0.0)
        self._factor = gui.add_slider("Strength of the sun", 0.0, _MAX_SUN_FACTOR, 0.05, 1.0)
        self._exposure = gui.add_slider("Exposure (stops)", -_EV, _EV, 0.1, 0.0)
        self._recorded = gui.add_button("Back to the recorded light", icon=icon.HISTORY)
        self._connect()

    def show(self, state: ViewState) -> None:
        """Set the controls to a state."""
        sky = state.sky
        kind = self._kind_of(sky)
        self._kind.value = kind
        sun = sun_of(sky, self._geo, self._viewer.workspace.sky)
        if sun is not None:
            self._azimuth.value = round(sun.azimuth_deg, 1)
            self._elevation.value = max(round(sun.elevation_deg, 1), MIN_ELEVATION_DEG)
        self._turbidity.value = turbidity_of(sky)
        if kind == TIME:
            self._show_time(sky)
        path = parse_sky(sky).path
        if path is not None:
            self._add_file(str(path))
            self._file.value = str(path)
        self._yaw.value, self._factor.value = sky.yaw_deg, min(sky.sun_factor, _MAX_SUN_FACTOR)
        self._exposure.value = state.exposure_ev
        self._show_controls_of(kind)

    def _show_controls_of(self, kind: str) -> None:
        self._turbidity.visible = kind == CLEAR
        self._date.visible = self._hour.visible = kind == TIME
        self._file.visible = self._yaw.visible = kind == FILE

    def drag_sun(self, sun: SolarPosition, drag: str) -> None:
        """Move the sun to the position to which a user has dragged it."""
        state = self._viewer.state
        sky = with_dragged_sun(state.sky, sun, turbidity_of(state.sky))
        self._viewer.change(replace(state, sky=sky), drag)

    def _connect(self) -> None:
        on_user_event(self._kind, lambda _: self._kind_set())
        for slider, name in ((self._azimuth, "azimuth"), (self._elevation, "elevation")):
            on_user_event(slider, lambda _, name=name: self._sun_set(name))
        on_user_event(self._turbidity, lambda _: self._sun_set("turbidity"))
        on_user_event(self._hour, lambda _: self._time_set("hour"))
        on_user_event(self._date, lambda _: self._time_set("date"))
        on_user_event(self._file, lambda _: self._set(self._of_kind(FILE)))
        on_user_event(self._upload, self._uploaded)
        on_user_event(self._yaw, lambda _: self._edit("yaw", yaw_deg=within(self._yaw)))
        on_user_event(self._factor, lambda _: self._edit("factor", sun_factor=within(self._factor)))
        on_user_event(self._exposure, lambda _: self._exposed())
        on_user_event(self._recorded, lambda _: self._set(SkyChoice("source")))

    def _set(self, sky: SkyChoice, control: str = "") -> None:
        viewer = self._viewer
        drag = viewer.drags.name(control) if control else ""
        viewer.change(replace(viewer.state, sky=sky), drag)

    def _kind_set(self) -> None:
        kind = self._kind.value
        # Controls are shown even if it is night at the chosen hour, to allow another choice.
        self._show_controls_of(kind)
        self._set(self._of_kind(kind))

    def _edit(self, control: str, **change: Any) -> None:
        self._set(replace(self._viewer.state.sky, **change), control)

    def _exposed(self) -> None:
        viewer = self._viewer
        state = replace(viewer.state, exposure_ev=within(self._exposure))
        viewer.change(state, viewer.drags.name("exposure"))

    def _sun_set(self, control: str) -> None:
        sky = with_dragged_sun(self._viewer.state.sky, self._sun(), within(self._turbidity))
        self._set(sky, control)

    def _time_set(self, control: str) -> None:
        self._set(SkyChoice(self._time_words()), control)

    def _kind_of(self, sky: SkyChoice) -> str:
        request = parse_sky(sky)
        if request.path is not None:
            return FILE
        if request.time_ns is not None:
            return TIME
        return RECORDED if request.sun is None else CLEAR

    def _of_kind(self, kind: str) -> SkyChoice:
        """Return the sky after the user has chosen another kind.

        Raises:
            InputError: the date is wrong, or no file has been uploaded.
        """
        if kind == CLEAR:
            return with_dragged_sun(SkyChoice("source"), self._sun(), within(self._turbidity))
        if kind == TIME:
            return SkyChoice(self._time_words())
        if kind == FILE:
            if not self._file.value:
                raise InputError("there is no sky file yet", remedy="Upload one.")
            return SkyChoice(self._file.value)
        return SkyChoice("source")

    def _sun(self) -> SolarPosition:
        return SolarPosition(within(self._azimuth), within(self._elevation))

    def _place_deg(self) -> float:
        assert self._geo is not None
        assert self._geo.place is not None
        return self._geo.place.longitude_deg

    def _recorded_time(self) -> datetime:
        """Return the UTC time of the first picture; noon of a day in June if it is unknown."""
        clock = None if self._geo is None else self._geo.clock
        if clock is None:
            return datetime(2026, 6, 21, 12, tzinfo=UTC)
        first_ns = self._viewer.workspace.log.frames[0].time_ns + clock.utc_minus_log_ns
        return datetime.fromtimestamp(first_ns / 1e9, UTC)

    def _time_words(self) -> str:
        try:
            day = datetime.strptime(self._date.value.strip(), "%Y-%m-%d").replace(tzinfo=UTC)
            moment = day + timedelta(hours=within(self._hour) - self._hours_east)
        except (ValueError, OverflowError) as error:
            raise InputError(
                "the date cannot be read", where="Date", got=self._date.value, expected="2026-06-21"
            ) from error
        return f"time:{moment.replace(tzinfo=None).isoformat(timespec='seconds')}Z"

    def _show_time(self, sky: SkyChoice) -> None:
        time_ns = parse_sky(sky).time_ns
        assert time_ns is not None
        local = datetime.fromtimestamp(time_ns / 1e9, UTC) + timedelta(hours=self._hours_east)
        self._date.value = f"{local:%Y-%m-%d}"
        self._hour.value = round(local.hour + local.minute / 60 + local.second / 3600, 2)

    def _files(self) -> tuple[str, ...]:
        """Return the paths of the uploaded skies."""
        if not self._skies.is_dir():
            return ()
        return tuple(str(p) for p in sorted(self._skies.iterdir()) if p.suffix in _SUFFIXES)

    def _add_file(self, path: str) -> None:
        """Add a file to the dropdown."""
        options = tuple(option for option in self._file.options if option)
        if path not in options:
            self._file.options = (*options, path)

    def _uploaded(self, event: Any) -> None:
        """Store an uploaded sky in WORK/view/skies, if it is one, and show it."""
        upload = event.target.value
        path = stored_sky(self._skies, upload.name, upload.content)
        self._set(SkyChoice(str(path)))


def stored_sky(folder: Path, name: str, content: bytes) -> Path:
    """Store an uploaded sky file under a harmless name and return its path.

    Raises:
        InputError: it is too large, no .hdr or .exr file, or not readable as a sky.
    """
    suffix = Path(name).suffix.lower()
    if suffix not in _SUFFIXES or len(content) > MAX_UPLOAD_BYTES:
        raise InputError(
            "the upload is not a sky file of a usable size",
            where=name[:80],
            got=f"{len(content) / 2**20:.1f} MB",
            expected=f".hdr or .exr, at most {MAX_UPLOAD_BYTES // 2**20} MB",
        )
    folder.mkdir(parents=True, exist_ok=True)
    path = _unused(folder / f"{safe_file_name(Path(name).stem)}{suffix}", content)
    partial = folder / f".upload{suffix}"
    partial.write_bytes(content)
    try:
        read_sky(partial, "", is_logged=False)
    except InputError as error:
        partial.unlink()
        raise InputError(
            error.what,
            where=name[:80],
            got=error.got,
            expected=error.expected,
            remedy=error.remedy,
        ) from error
    return partial.replace(path).resolve()


def _unused(path: Path, content: bytes) -> Path:
    """Return a path for a file: with a number if a file of the name has another content, because
    prepared skies are kept by their paths."""
    number, found = 1, path
    while found.exists() and found.read_bytes() != content:
        number += 1
        found = path.with_stem(f"{path.stem}-{number}")
    return found
