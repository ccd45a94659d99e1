"""Frames a second under a moving sun, on a device and by the host; prints Markdown.

    python benchmarks/rendering/live.py WORK [--device cpu|cuda] [--width 960 1920] [--suns 24]
        [--camera front_camera] [--rays 32] [--step 2] [--threads N]

One frame of a finished build at pixel centres, faces flat, the twin's own sky with a sun that goes
from the world's +x to -x, 60 degrees high in the middle. On a device: `render.transport.live`, rays
by Mitsuba (OptiX or LLVM), sums by torch. By the host: `render.transport.light`, rays by Embree,
sums by numba. Both make the radiance of all pixels; it stays on the device there. Medians over all
suns but the first, which compiles.
"""

from __future__ import annotations

import argparse
import os
import platform
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent))

import numba
import torch
from methods import Frames

from lightsim.core.dome import Sun
from lightsim.render.casters.mitsuba import MitsubaBackend
from lightsim.render.gbuffers import render_gbuffers
from lightsim.render.transport.light import light
from lightsim.render.transport.live import LiveFrame
from lightsim.render.transport.matrix import TransportConfig, static_face_table, trace_transport
from lightsim.render.transport.sky import EnvironmentCells, prepare_sky


def say(line: str = "") -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def main() -> None:
    options = parse()
    use_threads(options.threads)
    backend: MitsubaBackend = "cuda" if options.device == "cuda" else "llvm"
    name = torch.cuda.get_device_name() if backend == "cuda" else "LLVM on the processor"
    say(
        f"{options.work.name}, {options.camera}, N={options.rays}, one pixel in"
        f" {options.step}x{options.step} traced, {options.suns} suns; device: {name};"
        f" host: {platform.machine()}, {options.threads} threads of {os.cpu_count()}"
    )
    for width in options.width:
        measure(options, width, backend)


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("work", type=Path)
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--camera", default="front_camera")
    parser.add_argument("--width", type=int, nargs="+", default=[960, 1920])
    parser.add_argument("--suns", type=int, default=24)
    parser.add_argument("--rays", type=int, default=32)
    parser.add_argument("--step", type=int, default=2)
    parser.add_argument("--threads", type=int, default=os.cpu_count())
    return parser.parse_args()


def use_threads(count: int) -> None:
    import drjit

    torch.set_num_threads(count)
    numba.set_num_threads(min(count, numba.get_num_threads()))
    drjit.set_thread_count(count)


def arc(sun: Sun, count: int) -> list[Sun]:
    """The sun from +x to -x, 60 degrees high in the middle."""
    suns = []
    for turn in np.linspace(0.1, np.pi - 0.1, count):
        height = np.radians(60.0)
        towards = [np.cos(turn), -np.sin(turn) * np.cos(height), np.sin(turn) * np.sin(height)]
        suns.append(replace(sun, direction_world=np.array(towards)))
    return suns


@dataclass
class Clock:
    """Medians over calls but the first: wall clock, and processor time of this process."""

    wall_ms: float
    processor_ms: float

    def row(self, name: str, *, is_frame: bool = False) -> str:
        rates = [f"{1e3 / ms:.1f}" if is_frame else "" for ms in (self.wall_ms, self.processor_ms)]
        return (
            f"| {name} | {self.wall_ms:.1f} | {self.processor_ms:.1f} | {rates[0]} | {rates[1]} |"
        )


def measure(options: argparse.Namespace, width: int, backend: MitsubaBackend) -> None:
    frames = Frames(options.work, options.camera, width)
    config = TransportConfig(
        sky_rays=options.rays, shading_step_px=options.step, pixel_samples=1, glossy_rays=0
    )
    scene = frames.scene()
    buffers = render_gbuffers(scene, frames.camera, frames.view())
    table = trace_transport(scene, buffers, config, 0, static_face_table(scene, config))
    sky = prepare_sky(frames.dome)
    sun = sky.sun or Sun(np.array([0.0, 0.0, 1.0]), np.full(3, np.pi, np.float32))
    skies = [replace(sky, sun=moved) for moved in arc(sun, options.suns)]
    used_mb = device_mb(backend)
    start = time.perf_counter()
    live = LiveFrame(table, scene, buffers, config, backend)
    built_s = time.perf_counter() - start

    def by_host(sky: EnvironmentCells) -> Any:
        return light(table, scene, buffers, sky, config).shaded * buffers.base_colour

    # Taken twice, around the other, for what else the machine does.
    device = clock(lambda sky: live(sky).radiance, skies)
    split = parts(live, skies)
    host = clock(by_host, skies)
    again = clock(lambda sky: live(sky).radiance, skies)
    used_mb = device_mb(backend) - used_mb
    say(
        f"\n{frames.camera.width_px}x{frames.camera.height_px}: {live.rays.pixel_count} pixels with"
        f" a surface, {len(table.points.sky_cells)} traced, {live.rays.face_count} faces met."
        f" On the device after {built_s:.1f} s: {live.held_bytes / 1e6:.0f} MB"
        + (f", {used_mb:.0f} MB with rays' structure and caches." if used_mb else ".")
    )
    say(f"Mean difference of radiance from the host: {difference(live, by_host, skies):.1e}\n")
    say("| | ms | processor ms | frames per second | per processor second |")
    say("|---|---:|---:|---:|---:|")
    say(device.row("device", is_frame=True))
    say(again.row("device, again", is_frame=True))
    for name, part in split.items():
        say(part.row(f"of it {name}"))
    another = clock(lambda sky: live.sky_sums(replace(sky, radiance=sky.radiance.copy())), skies)
    say(another.row("another sky, once, besides"))
    say(host.row("host", is_frame=True))


def difference(
    live: LiveFrame, by_host: Callable[[EnvironmentCells], Any], skies: list[EnvironmentCells]
) -> float:
    """Mean absolute difference over mean, the worst of some suns."""
    worst = 0.0
    for sky in skies[:: max(1, len(skies) // 4)]:
        found, expected = live(sky).radiance.cpu().numpy(), by_host(sky)
        worst = max(worst, float(np.abs(found - expected).mean() / expected.mean()))
    return worst


def parts(live: LiveFrame, skies: Sequence[EnvironmentCells]) -> dict[str, Clock]:
    """Parts of a frame, each waited for, which a whole frame on CUDA does not do."""
    sums = live.sky_sums(skies[0])
    bounce = live.bounce(sums, skies[0].sun)
    last = live(skies[0])
    dark = [replace(sky, sun=None) for sky in skies]
    return {
        "sun rays of pixels": clock(lambda sky: live.rays.of_pixels(must(sky.sun)), skies),
        "sun rays of faces": clock(lambda sky: live.rays.of_faces(must(sky.sun)), skies),
        "sums over met faces": clock(lambda sky: live.bounce(sums, sky.sun), dark),
        "spread to pixels": clock(lambda _: live.upsampling(bounce), skies),
        "image": clock(lambda _: replace(last).radiance, skies),
    }


def must(sun: Sun | None) -> Sun:
    assert sun is not None
    return sun


def clock(run: Callable[[EnvironmentCells], Any], skies: Sequence[EnvironmentCells]) -> Clock:
    taken = []
    for sky in skies:
        start, processor = time.perf_counter(), time.process_time()
        run(sky)
        if torch.cuda.is_available():
            torch.cuda.synchronize()
        taken.append((time.perf_counter() - start, time.process_time() - processor))
    return Clock(*(1e3 * statistics.median(column) for column in zip(*taken[1:], strict=True)))


def device_mb(backend: MitsubaBackend) -> float:
    """Memory of the device in use, by whomever; 0 on the processor."""
    if backend == "llvm":
        return 0.0
    free, whole = torch.cuda.mem_get_info()
    return (whole - free) / 1e6


if __name__ == "__main__":
    main()
