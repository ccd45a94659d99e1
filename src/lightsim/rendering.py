"""`lightsim render`: buffers of the twin as EXR files, frame by frame."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from lightsim.core.buffers import GBuffers, ShadowBuffers
from lightsim.edit.timeline import replay
from lightsim.errors import InputError
from lightsim.progress import Progress
from lightsim.render.transport import TransportConfig
from lightsim.scenarios import select_frames
from lightsim.scene_setup import FrameRenderer
from lightsim.skies import SkyChoice, resolve_sky
from lightsim.store.images import write_exr
from lightsim.workspace import Workspace

GEOMETRY = ("depth", "position", "normal", "albedo", "actor")
LIGHT = ("ao", "shaded", "unshadowed", "shadow")


@dataclass(frozen=True)
class RenderOptions:
    """What `lightsim render` is asked for.

    Args:
        what: names among GEOMETRY and LIGHT.
        sky: of the light buffers.
        cameras: empty for all.
        frames: START:STOP[:STEP], empty for all.
        image_scale: factor on the log's image size; None for that of the build.
        seed: of the sampling of rays.
    """

    what: tuple[str, ...]
    sky: SkyChoice
    cameras: tuple[str, ...] = ()
    frames: str = ""
    image_scale: float | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        unknown = set(self.what) - {*GEOMETRY, *LIGHT}
        if unknown or not self.what:
            raise InputError(
                "unknown buffers" if unknown else "no buffers are named",
                where="--what",
                got=", ".join(sorted(unknown)) or None,
                expected=f"some of {', '.join((*GEOMETRY, *LIGHT))}",
            )


def render(work: Path, out: Path, options: RenderOptions, progress: Progress) -> None:
    """Write OUT/<what>/<camera>/<frame>.exr; frames that are there already are kept.

    Depth is inf, other buffers 0 where there is no surface; `actor` is the index among the
    actors present in the frame, -1 background, -2 none. Light is irradiance over pi.
    """
    workspace = Workspace(work)
    log = workspace.log_at(options.image_scale or workspace.reading.image_scale)
    frames = select_frames(log, options.cameras, options.frames)
    twin = workspace.twin
    scenario = replay(twin, "render", frames)
    renderer = FrameRenderer(
        twin.assets.background, workspace.shadow_casters, TransportConfig(), options.seed
    )
    needs_light = bool(set(options.what) & set(LIGHT))
    skies = [renderer.prepare(resolve_sky(options.sky, workspace).dome)] if needs_light else []
    for frame in progress.track(frames, "render", len(frames)):
        paths = {w: out / w / frame.camera_name / f"{frame.stem}.exr" for w in options.what}
        if all(path.exists() for path in paths.values()):
            continue
        camera = log.cameras[frame.camera_name]
        if needs_light:
            buffers, (light,) = renderer.render(scenario, frame, camera, skies)
        else:
            buffers, light = renderer.geometry(scenario, frame, camera), None
        for what, path in paths.items():
            path.parent.mkdir(parents=True, exist_ok=True)
            write_exr(path, _buffer(what, buffers, light))


def _buffer(
    what: str, buffers: GBuffers, light: ShadowBuffers | None
) -> Float32[np.ndarray, "h w *c"]:
    geometry = {
        "depth": buffers.depth_z_m,
        "position": buffers.position_world,
        "normal": buffers.normal_world,
        "albedo": buffers.base_colour,
        "ao": buffers.ambient_occlusion,
        "actor": buffers.actor_index.astype(np.float32),
    }
    if what in geometry:
        return geometry[what]
    assert light is not None
    return {"shaded": light.shaded, "unshadowed": light.unshadowed, "shadow": light.ratio}[what]
