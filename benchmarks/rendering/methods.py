"""The renderers under comparison, behind one face: prepare a frame once, then light it."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from lightsim.build.workspace import Workspace
from lightsim.core.camera import PinholeCamera
from lightsim.core.dome import SkyDome
from lightsim.core.frames import RigidTransform
from lightsim.render.denoise import denoise
from lightsim.render.gbuffers import render_gbuffers
from lightsim.render.reference.cycles import Cycles
from lightsim.render.reference.path_tracer import PathTracer
from lightsim.render.reference.renderer import Shot
from lightsim.render.scene import FrameScene, StaticScene, make_static_scene, place
from lightsim.render.transport.light import light
from lightsim.render.transport.matrix import TransportConfig, static_face_table, trace_transport
from lightsim.render.transport.samples import render_samples
from lightsim.render.transport.sky import prepare_sky
from lightsim.scenario.replay import replay

Array = np.ndarray[Any, Any]


class Frames:
    """Neighbouring frames of one camera of a finished build, without smooth normals."""

    def __init__(self, work: Path, camera_name: str, width_px: int) -> None:
        workspace = Workspace(work)
        twin = workspace.twin
        frames = [f for f in workspace.log.frames if f.camera_name == camera_name]
        self.frames = frames[len(frames) // 2 :]
        self._scenario = replay(twin, "benchmark", tuple(frames))
        camera = workspace.log.cameras[camera_name]
        self.camera: PinholeCamera = camera.scaled(width_px / camera.width_px)
        inferred = workspace.unobserved_occluders
        start = time.perf_counter()
        static = make_static_scene(
            [twin.assets.background], [inferred] if len(inferred.faces) else []
        )
        self.static_seconds = time.perf_counter() - start
        self.static: StaticScene = replace(static, normals=flat(static.normals))
        self.dome: SkyDome = twin.sky.dome

    def scene(self, number: int = 0) -> FrameScene:
        scene = place(self.static, self._scenario, self.frames[number].time_ns)
        return replace(scene, actor_normals=flat(scene.actor_normals))

    def view(self, number: int = 0) -> RigidTransform:
        """Without rolling shutter, which Cycles cannot have."""
        return self.frames[number].world_from_camera

    def skies(self, count: int) -> list[SkyDome]:
        """The twin's own sky turned in steps of 15 degrees."""
        return [self.dome.rotated(15.0 * k) for k in range(count)]


def flat(normals: Sequence[Array]) -> tuple[Array, ...]:
    """No smooth normals: faces keep their own. Renderers differ in what they do with light that
    comes from below a face but above its smooth normal; that is not to be compared here."""
    return tuple(np.zeros_like(normal) for normal in normals)


@dataclass
class Cost:
    """Seconds and processor seconds of a block, of this process and of another's."""

    other_pid: int | None = None
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    peak_mb: float = 0.0
    _start: tuple[float, float] = field(default=(0.0, 0.0))

    def _cpu(self) -> float:
        own = time.process_time()
        if self.other_pid is None:
            return own
        fields = Path(f"/proc/{self.other_pid}/stat").read_text().rpartition(")")[2].split()
        return own + (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def __enter__(self) -> Cost:
        _forget_peak("self")
        if self.other_pid is not None:
            _forget_peak(str(self.other_pid))
        self._start = (time.perf_counter(), self._cpu())
        return self

    def __exit__(self, *_: object) -> None:
        self.seconds += time.perf_counter() - self._start[0]
        self.cpu_seconds += self._cpu() - self._start[1]
        pid = "self" if self.other_pid is None else str(self.other_pid)
        self.peak_mb = max(self.peak_mb, _peak_mb(pid))


def _forget_peak(pid: str) -> None:
    Path(f"/proc/{pid}/clear_refs").write_text("5")


def _peak_mb(pid: str) -> float:
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 1024


@dataclass
class Result:
    """One method on one frame and sky: irradiance / pi at pixel centres, or the image."""

    picture: Array
    once: Cost
    each: Cost


class TableMethod:
    """The light transport matrix; `once` is all that further skies do not pay."""

    def __init__(self, config: TransportConfig) -> None:
        self.config = config
        self._faces: tuple[StaticScene, Any] | None = None

    def run(self, frames: Frames, skies: Sequence[SkyDome], number: int = 0) -> Result:
        config = self.config
        scene = frames.scene(number)
        cells = [prepare_sky(sky) for sky in skies]
        with Cost() as once:
            buffers = render_gbuffers(scene, frames.camera, frames.view(number))
            if self._faces is None or self._faces[0] is not frames.static:
                self._faces = (frames.static, static_face_table(scene, config))
            samples = None
            if config.pixel_samples > 1:
                samples = render_samples(scene, frames.camera, frames.view(number), buffers, config)
            table = trace_transport(scene, buffers, config, 0, self._faces[1], samples)
        with Cost() as each:
            lights = [light(table, scene, buffers, cell, config) for cell in cells]
        lit = lights[-1]
        picture = lit.shaded if lit.diffuse is None else lit.diffuse
        return Result(picture, once, each)


class ShotMethod:
    """Mitsuba or Cycles; `once` is the scene's conversion and a first picture of one path."""

    def __init__(self, tracer: PathTracer | Cycles, shot: Shot) -> None:
        self.tracer = tracer
        self.shot = shot

    def run(self, frames: Frames, skies: Sequence[SkyDome], number: int = 0) -> Result:
        scene, view = frames.scene(number), frames.view(number)
        pid = self.tracer.pid if isinstance(self.tracer, Cycles) else None
        small = replace(self.shot, samples=1)
        with Cost(pid) as once:
            self.tracer.render_shots(scene, frames.camera, view, [small], 1)
        with Cost(pid) as each:
            pictures = [
                self.tracer.render_shots(
                    scene, frames.camera, view, [replace(self.shot, dome=sky)], 5
                )[0]
                for sky in skies
            ]
        return Result(pictures[-1], once, each)


def denoised(result: Result, base_colour: Array, normal: Array) -> Result:
    """The result through Open Image Denoise, whose time each sky pays."""
    with Cost() as cost:
        picture = denoise(result.picture, base_colour, normal)
    each = replace(
        result.each,
        seconds=result.each.seconds + cost.seconds,
        cpu_seconds=result.each.cpu_seconds + cost.cpu_seconds,
    )
    return Result(picture, result.once, each)
