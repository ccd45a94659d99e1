"""`lightsim render`: buffers of the twin as EXR files, for any number of skies and processes.

A frame is traced once for all its skies, and every picture is written before the next is made, so
memory does not grow with frames or skies. A file that is there is complete, so a run that was
stopped goes on where it was, and shards may write into one folder.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from lightsim.build.sources import simulation_sources
from lightsim.build.workspace import Workspace
from lightsim.core.buffers import GBuffers
from lightsim.core.camera import PinholeCamera
from lightsim.core.scenario import Scenario, ScenarioFrame
from lightsim.core.sensors import CameraFrame
from lightsim.core.sky_choice import SkyChoice
from lightsim.errors import InputError
from lightsim.progress import Progress
from lightsim.render.casters.choice import resolve_backend
from lightsim.render.frame_renderer import FrameRenderer
from lightsim.render.renderers import Renderer, TracedFrame, make_renderer, renderer_settings
from lightsim.scenario.apply import driven_beside
from lightsim.scenario.replay import replay
from lightsim.simulation.options import GEOMETRY, LIGHT, RenderOptions
from lightsim.simulation.picture_images import PictureImages, picture_settings, shown_by_pictures
from lightsim.simulation.relight import select_frames
from lightsim.simulation.seen_light import SeenLight
from lightsim.simulation.shard import Shard
from lightsim.simulation.skies import made_from_sky, resolve_sky
from lightsim.simulation.target_sky import TargetSky
from lightsim.store.artefact import hash_names, json_ready, read_json, write_json
from lightsim.store.atomic import sweep_partials
from lightsim.store.exr import read_mark, write_exr
from lightsim.store.lock import LOCK_NAME, locked
from lightsim.store.scenario import write_scenario
from lightsim.store.staleness import describe_source_change

_RECORD = "render.json"
_SKY_RECORD = "sky.json"


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
        """OUT/<sky>, or OUT itself for a single sky."""
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
        """Whether no file of the frame is missing under any sky; raises as `geometry`."""
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
    files that are there already are kept. scenario.json beside <what> tells cameras, poses and
    boxes of the frames that were asked for last.

    Depth is inf, other buffers 0 where there is no surface; `actor` is the number that
    scenario.json tells, the same in all frames, -1 background, -2 none. Light is irradiance over
    pi, `image` the radiance that the camera sees, in scene units: by default as the log's pictures
    show it (`PictureImages`), else as the twin does. The light transport matrix averages light and
    the twin's image over the pixel's samples (light over those that meet a surface); all else
    belongs to the pixel's centre.
    The shards of a run may share OUT; their union is the same as one run, byte for byte, on equal
    machines.

    Raises:
        ArtefactError: the twin has not been built.
        InputError: a sky, camera or frame range is wrong, or OUT holds files of other settings.
    """
    workspace = Workspace(work, is_stale_allowed=options.allow_stale)
    workspace.need("twin")
    with locked(work / LOCK_NAME, is_shared=True):
        return _render(workspace, out, options, progress)


def _render(
    workspace: Workspace, out: Path, options: RenderOptions, progress: Progress
) -> RenderSummary:
    scale = options.image_scale or workspace.reading.image_scale
    log = workspace.log_at(scale)
    frames = select_frames(log, options.cameras, options.frames)
    mine = Shard.parse(options.shard).of(range(len(frames)))
    skies = options.sky_by_name if options.needs_light else {}
    settings = _settings(workspace, options, scale)
    layout = Layout(out, options.what, tuple(skies), hash_names(settings))
    # First of all: other settings are told better than by the first file that they made.
    for path, made_from in _claims(layout, settings, skies).items():
        _check_claim(path, made_from)
    pending = [k for k in mine if not layout.is_done(frames[k])]
    if not pending:
        _claim(layout, settings, skies)
    else:
        twin = workspace.twin
        scenario = replay(replace(twin, log=log), "render", frames, seed=options.seed)
        if options.ego_offset is not None:
            scenario = driven_beside(scenario, options.ego_offset)
        elif options.has_pictures:
            scenario = shown_by_pictures(scenario, workspace.held_out)
        renderer = make_renderer(
            options.renderer,
            twin.assets.background,
            workspace.unobserved_occluders,
            options.seed,
            has_images="image" in options.what and not options.has_pictures,
            recorded_sun=workspace.sky.dome.sun,
            roofs=workspace.uncertain_roofs,
        )
        # Not before: a renderer that is not installed must leave no claim behind.
        _claim(layout, settings, skies)
        if not skies:
            write_scenario(out, scenario)
        seen = SeenLight(workspace, _shared(renderer, options))
        targets = _resolve_skies(layout, skies, workspace, scenario, seen)
        prepared = {n: renderer.prepare(sky.dome, sky.behind) for n, sky in targets.items()}
        pictures = None
        if options.has_pictures:
            pictures = PictureImages(workspace, log, scenario, options, targets, seen.renderer)
        chosen = [scenario.frames[k] for k in pending]
        cameras = log.cameras
        write_frames(layout, renderer, scenario, cameras, chosen, prepared, progress, pictures)
    return RenderSummary(len(mine), len(pending))


def _shared(renderer: Renderer, options: RenderOptions) -> FrameRenderer | None:
    """Return the renderer if relighting can share its static scene: relighting always casts rays
    with Embree."""
    is_embree = resolve_backend(options.renderer.backend) == "embree"
    return renderer if isinstance(renderer, FrameRenderer) and is_embree else None


def _settings(workspace: Workspace, options: RenderOptions, image_scale: float) -> dict[str, Any]:
    """Return what decides the pictures, except the skies.

    How `image` is relit counts even where only other buffers are asked for: buffers that are
    written one after the other into one folder have the same settings.
    """
    has_pictures = options.image_from == "pictures"
    return {
        "sources": simulation_sources(__name__),
        "twin": workspace.record("twin")["key"],
        "image_scale": image_scale,
        "seed": options.seed,
        "ego_offset_m": options.ego_offset,
        "image_from": options.image_from,
        **renderer_settings(options.renderer),
        **(picture_settings(workspace, options) if has_pictures else {}),
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
    of_skies = {layout.sky_folder(n) / _SKY_RECORD: made_from_sky(sky) for n, sky in skies.items()}
    return {layout.out / _RECORD: json_ready(settings), **of_skies}


def _check_claim(path: Path, made_from: Mapping[str, Any]) -> None:
    if not path.exists():
        return
    found = read_json(path)
    if not isinstance(found, dict):
        raise InputError("the record is damaged", where=path, remedy="Choose another --out.")
    differing = [key for key in made_from if found.get(key) != made_from[key]]
    remedy = "Choose another --out, or delete this one."
    if "sources" in differing:
        was = found["sources"] if isinstance(found.get("sources"), dict) else {}
        raise InputError(
            "the folder holds pictures that other code of LightSim made",
            where=path,
            got=describe_source_change(was, made_from["sources"]) if was else "no record of it",
            remedy=remedy,
        )
    if differing:
        raise InputError(
            "the folder holds pictures of other settings",
            where=path,
            got=", ".join(f"{key} = {found.get(key)}" for key in differing),
            expected=", ".join(f"{key} = {made_from[key]}" for key in differing),
            remedy=remedy,
        )


def _resolve_skies(
    layout: Layout,
    skies: Mapping[str, SkyChoice],
    workspace: Workspace,
    scenario: Scenario,
    seen: SeenLight,
) -> dict[str, TargetSky]:
    targets: dict[str, TargetSky] = {}
    for name, sky in skies.items():
        target = resolve_sky(sky, workspace, seen)
        folder = layout.sky_folder(name)
        write_json(folder / _SKY_RECORD, {**made_from_sky(sky), "facts": target.record})
        write_scenario(folder, replace(scenario, sky=sky), target_sky=target.record)
        targets[name] = target
    return targets


def write_frames(
    layout: Layout,
    renderer: Renderer,
    scenario: Scenario,
    camera_by_name: Mapping[str, PinholeCamera],
    frames: Sequence[ScenarioFrame],
    prepared: Mapping[str, Any],
    progress: Progress,
    pictures: PictureImages | None = None,
) -> None:
    """Trace each frame once and write what is missing of it, one picture at a time.

    Args:
        prepared: what `renderer.prepare` made of each sky of the layout.
        pictures: make `image`; None: the renderer does.
    """
    traced_for = {"ao", *LIGHT} if pictures is None else {"ao", *LIGHT} - {"image"}
    needs_tracing = bool(traced_for & set(layout.what))
    for frame in progress.track(frames, "render", len(frames)):
        camera = camera_by_name[frame.camera_name]
        if pictures is not None:
            _write_images(layout, frame, tuple(prepared), pictures)
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


def _write_images(
    layout: Layout, frame: ScenarioFrame, skies: Sequence[str], pictures: PictureImages
) -> None:
    """`image` under each sky that has none of this frame."""
    paths = {name: layout.light(frame, name).get("image") for name in skies}
    lacking = {name: path for name, path in paths.items() if path is not None}
    images = pictures.of(frame, tuple(lacking))
    for path, image in zip(lacking.values(), images, strict=True):
        _write({"image": path}, {"image": image}, layout.mark)


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
