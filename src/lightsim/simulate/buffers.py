"""`lightsim render`: buffers of the twin as EXR files, for any number of skies and processes.

A frame is traced once for all its skies, and every picture is written before the next is made, so
memory does not grow with frames or skies. A file that is there is complete, so a run that was
stopped goes on where it was, and shards may write into one folder.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from lightsim.core.buffers import GBuffers
from lightsim.core.camera import PinholeCamera
from lightsim.core.checks import check_image_scale, check_seed
from lightsim.core.scenario import Scenario
from lightsim.core.sensors import CameraFrame
from lightsim.errors import InputError
from lightsim.lighting.target_sky import FORMS
from lightsim.pipeline.workspace import Workspace
from lightsim.progress import Progress
from lightsim.render.renderers import Renderer, RendererChoice, TracedFrame, make_renderer
from lightsim.scenario.replay import replay
from lightsim.simulate.relight import select_frames
from lightsim.simulate.shard import Shard
from lightsim.simulate.skies import SkyChoice, resolve_sky
from lightsim.store.artefact import hash_names, json_ready, read_json, write_json
from lightsim.store.atomic import sweep_partials
from lightsim.store.exr import read_mark, write_exr
from lightsim.store.lock import LOCK_NAME, locked

GEOMETRY = ("depth", "position", "normal", "albedo", "actor", "ao")
"""The same under every sky: written once."""
LIGHT = ("shaded", "unshadowed", "shadow", "image")
"""Written for each sky."""
_RECORD = "render.json"
_SKY_RECORD = "sky.json"
_ACTORS = "actors.json"
_SCHEMA = 4


@dataclass(frozen=True)
class RenderOptions:
    """What `lightsim render` is asked for.

    Args:
        what: names among GEOMETRY and LIGHT.
        skies: of the light buffers.
        cameras: empty for all.
        frames: START:STOP[:STEP], empty for all.
        image_scale: factor on the log's image size; None for that of the build.
        renderer: how light is computed, and by what rays.
        shard: which part of the frames this process renders.
        seed: of the sampling of rays.
        is_stale_allowed: go on where the recording has changed since the build.
    """

    what: tuple[str, ...]
    skies: tuple[SkyChoice, ...]
    cameras: tuple[str, ...] = ()
    frames: str = ""
    image_scale: float | None = None
    renderer: RendererChoice = field(default_factory=RendererChoice)
    shard: Shard = field(default_factory=Shard)
    seed: int = 0
    is_stale_allowed: bool = False

    def __post_init__(self) -> None:
        check_seed(self.seed)
        if self.image_scale is not None:
            check_image_scale(self.image_scale)
        unknown = set(self.what) - {*GEOMETRY, *LIGHT}
        if unknown or not self.what:
            raise InputError(
                "unknown buffers" if unknown else "no buffers are named",
                where="--what",
                got=", ".join(sorted(unknown)) or None,
                expected=f"some of {', '.join((*GEOMETRY, *LIGHT))}",
            )
        if self.needs_light and not self.skies:
            raise InputError(
                "light buffers need a sky", where="--sky", expected=f"an HDR file, {FORMS}"
            )

    @property
    def needs_light(self) -> bool:
        return bool(set(self.what) & set(LIGHT))

    @property
    def sky_by_name(self) -> dict[str, SkyChoice]:
        """The skies by the names of their folders; none where no light is asked for.

        Raises:
            InputError: two skies have one name, or a name is that of a buffer.
        """
        named: dict[str, SkyChoice] = {}
        taken: dict[str, str] = {what: f"the buffer {what}" for what in (*GEOMETRY, *LIGHT)}
        for sky in self.skies if self.needs_light else ():
            name = sky.name
            if name.casefold() in taken:
                raise InputError(
                    "two skies would be written to one folder",
                    where=f"--sky {sky.sky}",
                    got=f"the name {name}, which {taken[name.casefold()]} has",
                    remedy="Give each sky once; rename or link one of two files of one name.",
                )
            taken[name.casefold()] = sky.sky
            named[name] = sky
        return named


@dataclass(frozen=True)
class Layout:
    """Where the files go: OUT/<what>, and OUT/<sky>/<what> for light under several skies.

    Args:
        out: folder.
        what: buffers.
        skies: names; a single one has no folder of its own.
        mark: of this run's settings, by which its files are known from others.
    """

    out: Path
    what: tuple[str, ...]
    skies: tuple[str, ...]
    mark: str = ""

    def sky_folder(self, sky: str) -> Path:
        return self.out if len(self.skies) == 1 else self.out / sky

    def geometry(self, frame: CameraFrame) -> dict[str, Path]:
        """Missing files of buffers that all skies share.

        Raises:
            InputError: a file that another program or other settings made is in a place.
        """
        return self._missing(self.out, GEOMETRY, frame)

    def light(self, frame: CameraFrame, sky: str) -> dict[str, Path]:
        """Missing files of one sky; raises as `geometry`."""
        return self._missing(self.sky_folder(sky), LIGHT, frame)

    def is_done(self, frame: CameraFrame) -> bool:
        return not self.geometry(frame) and not any(self.light(frame, s) for s in self.skies)

    def _missing(self, folder: Path, kind: tuple[str, ...], frame: CameraFrame) -> dict[str, Path]:
        named = {
            what: folder / what / frame.camera_name / f"{frame.stem}.exr"
            for what in self.what
            if what in kind
        }
        return {what: path for what, path in named.items() if not self._is_finished(path)}

    def _is_finished(self, path: Path) -> bool:
        if not path.exists():
            return False
        if read_mark(path) != self.mark:
            raise InputError(
                "a file that this run did not make, or that was damaged, is in its place",
                where=path,
                remedy="Move it away, or choose another --out.",
            )
        return True


@dataclass(frozen=True)
class RenderSummary:
    """What a run did.

    Args:
        frames: of this shard.
        rendered: those that were not complete before.
    """

    frames: int
    rendered: int


def render(work: Path, out: Path, options: RenderOptions, progress: Progress) -> RenderSummary:
    """Write OUT/<what>/<camera>/<frame>.exr, light under several skies to OUT/<sky>/<what>/...;
    files that are there already are kept.

    Depth is inf, other buffers 0 where there is no surface; `actor` is the number that
    OUT/actors.json tells, the same in all frames, -1 background, -2 none. Light is irradiance over
    pi, `image` the radiance that the camera sees. The ray table averages light and image over the
    pixel's samples (light over those that meet a surface); all else belongs to the pixel's centre.
    The shards of a run may share OUT; their union is the same as one run, byte for byte, on equal
    machines.

    Raises:
        ArtefactError: the twin has not been built.
        InputError: a sky, camera or frame range is wrong, or OUT holds files of other settings.
    """
    workspace = Workspace(work, is_stale_allowed=options.is_stale_allowed)
    workspace.need("twin")
    with locked(work / LOCK_NAME, is_shared=True):
        return _render(workspace, out, options, progress)


def _render(
    workspace: Workspace, out: Path, options: RenderOptions, progress: Progress
) -> RenderSummary:
    scale = options.image_scale or workspace.reading.image_scale
    log = workspace.log_at(scale)
    frames = select_frames(log, options.cameras, options.frames)
    mine = options.shard.of(frames)
    skies = options.sky_by_name
    settings = _settings(workspace, options, scale)
    layout = Layout(out, options.what, tuple(skies), hash_names(settings))
    # First of all: other settings are told better than by the first file that they made.
    for path, made_from in _claims(layout, settings, skies).items():
        _check_claim(path, made_from)
    pending = [frame for frame in mine if not layout.is_done(frame)]
    if not pending:
        _claim(layout, settings, skies)
    else:
        twin = workspace.twin
        renderer = make_renderer(
            options.renderer,
            twin.assets.background,
            workspace.shadow_casters,
            options.seed,
            has_images="image" in options.what,
        )
        # Not before: a renderer that is not installed must leave no claim behind.
        _claim(layout, settings, skies)
        prepared = _prepare_skies(layout, skies, renderer, workspace)
        scenario = replay(twin, "render", frames)
        if "actor" in options.what:
            write_json(out / _ACTORS, _actor_table(scenario))
        write_frames(layout, renderer, scenario, log.cameras, pending, prepared, progress)
    return RenderSummary(len(mine), len(pending))


def _settings(workspace: Workspace, options: RenderOptions, image_scale: float) -> dict[str, Any]:
    """What decides the pictures, but for the skies."""
    return {
        "schema": _SCHEMA,
        "twin": workspace.record("twin")["key"],
        "image_scale": image_scale,
        "seed": options.seed,
        **options.renderer.settings,
    }


def _claim(layout: Layout, settings: Mapping[str, Any], skies: Mapping[str, SkyChoice]) -> None:
    """Record the settings in OUT, or refuse an OUT whose files were made with others.

    One run after the other: of two with other settings that start at once, the second is refused.
    """
    layout.out.mkdir(parents=True, exist_ok=True)
    with locked(layout.out / LOCK_NAME, is_waiting=True):
        sweep_partials(layout.out)
        for path, made_from in _claims(layout, settings, skies).items():
            _check_claim(path, made_from)
            if not path.exists():
                path.parent.mkdir(parents=True, exist_ok=True)
                write_json(path, made_from)


def _claims(
    layout: Layout, settings: Mapping[str, Any], skies: Mapping[str, SkyChoice]
) -> dict[Path, dict[str, Any]]:
    of_skies = {layout.sky_folder(n) / _SKY_RECORD: sky.made_from for n, sky in skies.items()}
    return {layout.out / _RECORD: json_ready(settings), **of_skies}


def _check_claim(path: Path, made_from: Mapping[str, Any]) -> None:
    if not path.exists():
        return
    found = read_json(path)
    if not isinstance(found, dict):
        raise InputError("the record is damaged", where=path, remedy="Choose another --out.")
    differing = [key for key in made_from if found.get(key) != made_from[key]]
    if differing:
        raise InputError(
            "the folder holds pictures of other settings",
            where=path,
            got=", ".join(f"{key} = {found.get(key)}" for key in differing),
            expected=", ".join(f"{key} = {made_from[key]}" for key in differing),
            remedy="Choose another --out, or delete this one.",
        )


def _actor_table(scenario: Scenario) -> list[dict[str, Any]]:
    """What the numbers of `actor` mean."""
    return [
        {
            "number": scenario.number_by_actor[track.actor_id],
            "actor_id": track.actor_id,
            "kind": track.kind,
            "label": track.label,
        }
        for track in scenario.tracks
    ]


def _prepare_skies(
    layout: Layout, skies: Mapping[str, SkyChoice], renderer: Renderer, workspace: Workspace
) -> dict[str, Any]:
    prepared: dict[str, Any] = {}
    for name, sky in skies.items():
        target = resolve_sky(sky, workspace)
        write_json(layout.sky_folder(name) / _SKY_RECORD, {**sky.made_from, "facts": target.facts})
        prepared[name] = renderer.prepare(target.dome)
    return prepared


def write_frames(
    layout: Layout,
    renderer: Renderer,
    scenario: Scenario,
    camera_by_name: Mapping[str, PinholeCamera],
    frames: Sequence[CameraFrame],
    prepared: Mapping[str, Any],
    progress: Progress,
) -> None:
    """Trace each frame once and write what is missing of it, one picture at a time.

    Args:
        prepared: what `renderer.prepare` made of each sky of the layout.
    """
    needs_tracing = "ao" in layout.what or bool(prepared)
    for frame in progress.track(frames, "render", len(frames)):
        camera = camera_by_name[frame.camera_name]
        if not needs_tracing:
            buffers = renderer.geometry(scenario, frame, camera)
            _write(layout.geometry(frame), _geometry(buffers), layout.mark)
            continue
        traced = renderer.trace(scenario, frame, camera)
        for name, sky in prepared.items():
            missing = layout.light(frame, name)
            if missing:
                _write(missing, _light(traced, sky, missing), layout.mark)
        _write(layout.geometry(frame), _geometry(traced.buffers), layout.mark)


def _write(
    paths: Mapping[str, Path], pictures: Mapping[str, Float32[np.ndarray, "h w *c"]], mark: str
) -> None:
    for what, path in paths.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        write_exr(path, pictures[what], mark=mark)


def _geometry(buffers: GBuffers) -> dict[str, Float32[np.ndarray, "h w *c"]]:
    return {
        "depth": buffers.depth_z_m,
        "position": buffers.position_world,
        "normal": buffers.normal_world,
        "albedo": buffers.base_colour,
        "ao": buffers.ambient_occlusion,
        "actor": buffers.actor_index.astype(np.float32),
    }


def _light(
    traced: TracedFrame, sky: Any, what: Collection[str]
) -> dict[str, Float32[np.ndarray, "h w *c"]]:
    pictures: dict[str, Float32[np.ndarray, "h w *c"]] = {}
    if "image" in what:
        pictures["image"] = traced.image(sky)
    if set(what) - {"image"}:
        light = traced.light(sky)
        pictures |= {
            "shaded": light.shaded,
            "unshadowed": light.unshadowed,
            "shadow": light.ratio,
        }
    return pictures
