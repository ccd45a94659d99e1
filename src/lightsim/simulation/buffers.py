"""`lightsim render`: buffers of the twin as EXR files, for any number of skies and processes.

A frame is traced once for all skies, and every picture is written before the next is made, so
memory does not grow with frames or skies. An existing file is complete, so an interrupted run
continues at the first missing file, and several processes can write to one folder.
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
from lightsim.core.log import DrivingLog
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
from lightsim.simulation.claims import image_scale_of
from lightsim.simulation.options import GEOMETRY, LIGHT, RenderOptions
from lightsim.simulation.picture_images import PictureImages, picture_settings, shown_by_pictures
from lightsim.simulation.relight import select_frames
from lightsim.simulation.scene_luminance import SceneLuminance
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
    """Paths of the files: OUT/<what>, and OUT/<sky>/<what> for light under several skies.

    Args:
        out: root folder.
        what: names of the buffers.
        skies: names of the skies; a single sky has no separate folder.
        mark: hash of the settings, which identifies files of this run.
    """

    out: Path
    what: tuple[str, ...]
    skies: tuple[str, ...]
    mark: str = ""

    def sky_folder(self, sky: str) -> Path:
        """Return OUT/<sky>, or OUT itself for a single sky."""
        return self.out if len(self.skies) == 1 else self.out / sky

    def geometry(self, frame: CameraFrame) -> dict[str, Path]:
        """Return the missing files of buffers that do not depend on the sky.

        Raises:
            InputError: a path has a file of another program or of other settings.
        """
        return self._missing(self.out, GEOMETRY, frame)

    def light(self, frame: CameraFrame, sky: str) -> dict[str, Path]:
        """Return the missing files of one sky; raises as `geometry`."""
        return self._missing(self.sky_folder(sky), LIGHT, frame)

    def is_done(self, frame: CameraFrame) -> bool:
        """Return True if no file of the frame is missing under any sky; raises as `geometry`."""
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
        # The mark in the header identifies the settings: the folder may have files of other runs.
        if read_mark(path) != self.mark:
            raise InputError(
                "a file that this run did not make, or that was damaged, is in its place",
                where=path,
                remedy="Move it away, or choose another --out.",
            )
        return True


@dataclass(frozen=True)
class RenderSummary:
    """Result of a run.

    Args:
        frames: number of selected frames.
        rendered: number of frames that were incomplete before the run.
    """

    frames: int
    rendered: int


def render(work: Path, out: Path, options: RenderOptions, progress: Progress) -> RenderSummary:
    """Write OUT/<what>/<camera>/<frame>.exr, for light under several skies OUT/<sky>/<what>/...

    Existing files are not rewritten. scenario.json beside <what> has cameras, poses and boxes of
    the frames of the last run.

    Without a surface depth is inf and other buffers are 0. `actor` is the number in scenario.json,
    the same in all frames; -1 is background, -2 no surface. Light is irradiance / pi and `image`
    is radiance, in scene units; `image` is made from the log's pictures by default
    (`PictureImages`), else from the twin. The light transport matrix averages light and the twin's
    image over the samples of a pixel (light over samples that meet a surface); all other buffers
    are values at the pixel's centre.
    Runs of different frames may write to one OUT at a time; on equal machines their union is byte
    for byte the result of a single run.

    Raises:
        ArtefactError: the twin has not been built.
        InputError: a sky, camera or frame range is wrong, or OUT has files of other settings.
    """
    workspace = Workspace(work, is_stale_allowed=options.allow_stale)
    workspace.need("twin")
    with locked(work / LOCK_NAME, is_shared=True):
        return _render(workspace, out, options, progress)


def _render(
    workspace: Workspace, out: Path, options: RenderOptions, progress: Progress
) -> RenderSummary:
    scale = image_scale_of(workspace, options)
    log = workspace.log_at(scale)
    frames = select_frames(log, options.cameras, options.frames)
    skies = options.sky_by_name if options.needs_light else {}
    settings = _settings(workspace, options, scale)
    layout = Layout(out, options.what, tuple(skies), hash_names(settings))
    # Settings are compared first: their error message is clearer than that of a single file.
    for path, made_from in _claims(layout, settings, skies).items():
        _check_claim(path, made_from)
    pending = [k for k, frame in enumerate(frames) if not layout.is_done(frame)]
    if not pending:
        _claim(layout, settings, skies)
    else:
        scenario = _scenario(workspace, log, frames, options)
        renderer = make_renderer(
            options.renderer,
            workspace.twin.assets.background,
            workspace.unobserved_occluders,
            options.seed,
            has_images="image" in options.what and not options.has_pictures,
            recorded_sun=workspace.sky.dome.sun,
            roofs=workspace.uncertain_roofs,
        )
        # OUT is claimed after the renderer is made: if that fails, OUT must remain unclaimed.
        _claim(layout, settings, skies)
        # With skies, scenario.json is written for each of them, with its facts.
        if not skies:
            write_scenario(out, scenario)
        seen = SceneLuminance(workspace, _shared(renderer, options))
        targets = _resolve_skies(layout, skies, workspace, scenario, seen)
        prepared = {n: renderer.prepare(sky.dome, sky.behind) for n, sky in targets.items()}
        pictures = None
        if options.has_pictures:
            pictures = PictureImages(workspace, log, scenario, options, targets, seen.renderer)
        chosen = [scenario.frames[k] for k in pending]
        cameras = log.cameras
        write_frames(layout, renderer, scenario, cameras, chosen, prepared, progress, pictures)
    return RenderSummary(len(frames), len(pending))


def _scenario(
    workspace: Workspace,
    log: DrivingLog,
    frames: Sequence[CameraFrame],
    options: RenderOptions,
) -> Scenario:
    """Return the log in the selected frames, from the selected positions of the cameras."""
    twin = replace(workspace.twin, log=log)
    scenario = replay(twin, "render", frames, seed=options.seed)
    if options.ego_offset is not None:
        return driven_beside(scenario, options.ego_offset)
    if options.has_pictures:
        return shown_by_pictures(scenario, workspace.held_out)
    return scenario


def _shared(renderer: Renderer, options: RenderOptions) -> FrameRenderer | None:
    """Return the renderer if relighting can reuse its static scene: relighting always casts rays
    with Embree."""
    is_embree = resolve_backend(options.renderer.backend) == "embree"
    return renderer if isinstance(renderer, FrameRenderer) and is_embree else None


def _settings(workspace: Workspace, options: RenderOptions, image_scale: float) -> dict[str, Any]:
    """Return the settings that determine the pictures, except the skies.

    The settings of `image` are included even if only other buffers are selected, because buffers
    of several runs in one folder have the same settings.
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
    """Record the settings in OUT, or refuse an OUT with files of other settings.

    A lock serialises claims: of two simultaneous runs with different settings, the second fails.
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
    # A change of code may cause all other differences, so only it is reported.
    if "sources" in differing:
        was = found["sources"] if isinstance(found.get("sources"), dict) else {}
        raise InputError(
            "the folder contains pictures of another version of LightSim's code",
            where=path,
            got=describe_source_change(was, made_from["sources"]) if was else "no record of it",
            remedy=remedy,
        )
    if differing:
        raise InputError(
            "the folder contains pictures with other settings",
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
    seen: SceneLuminance,
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
    """Trace each frame once and write its missing files, one picture at a time.

    Args:
        layout: paths of the files.
        renderer: of all buffers, except `image` if `pictures` is given.
        scenario: with the actors.
        camera_by_name: cameras at the scale of the pictures.
        frames: to write.
        prepared: result of `renderer.prepare` for each sky of the layout.
        progress: reports finished frames.
        pictures: source of `image`; None: the renderer.
    """
    traced_for = {"ao", *LIGHT} if pictures is None else {"ao", *LIGHT} - {"image"}
    # Geometry buffers require only camera rays, which is much faster.
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
    """Write the missing `image` files of a frame under all skies."""
    paths = {name: layout.light(frame, name).get("image") for name in skies}
    lacking = {name: path for name, path in paths.items() if path is not None}
    # All skies at once: relighting traces a frame once per call.
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
