"""Error against time of the renderers on a finished build; prints Markdown, asserts nothing.

    python benchmarks/rendering/compare.py WORK --camera front_camera --width 480 --cache DIR
        [--reference 1024] [--rays 16 64 256] [--samples 4 16 64] [--repeats 1] [--antialiased]
        [--no-cycles] [--no-denoise] [--skies 1 5 23]

Surfaces are diffuse, light bounces once (Mitsuba max_depth 3, Cycles max_bounces 1), and the sun is
a disc. Without --antialiased every method looks at pixel centres and pictures are base colour x
irradiance / pi. Faces are flat (see `methods.flat`). The reference (Mitsuba) is kept in --cache in
two halves, whose difference tells its own error; a later run with more --reference adds to it.
"""

from __future__ import annotations

import argparse
import os
import platform
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent))

from methods import Frames, Result, ShotMethod, TableMethod, denoised

from lightsim.core.mesh import TriMesh
from lightsim.errors import MissingDependencyError
from lightsim.render.gbuffers import render_gbuffers
from lightsim.render.reference.cycles import Cycles
from lightsim.render.reference.path_tracer import PathTracer
from lightsim.render.reference.renderer import Shot
from lightsim.render.transport.light import light
from lightsim.render.transport.matrix import (
    TransportConfig,
    exact,
    static_face_table,
    trace_transport,
)
from lightsim.render.transport.sky import prepare_sky

Array = np.ndarray[Any, Any]
_PASS = 64


def print_line(line: str = "") -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def main() -> None:
    options = parse()
    frames = Frames(options.work, options.camera, options.width)
    tracer = PathTracer()
    shot = Shot(frames.dome, _PASS, 1, "white", is_antialiased=False)
    if options.antialiased:
        shot = replace(shot, surfaces="diffuse", is_antialiased=True)
    describe(frames, tracer, options)
    buffers = render_gbuffers(frames.scene(), frames.camera, frames.view())
    judge = Judge(frames, tracer, shot, buffers, options)
    cycles = None if options.no_cycles else find_cycles()
    try:
        quality(frames, judge, methods_of(tracer, cycles, shot, options), options)
    finally:
        if cycles is not None:
            cycles.close()
    split(frames, options)


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description="Error against time of the renderers on a finished build."
    )
    parser.add_argument("work", type=Path)
    parser.add_argument("--camera", default="front_camera")
    parser.add_argument("--width", type=int, default=480)
    parser.add_argument("--cache", type=Path, required=True)
    parser.add_argument("--reference", type=int, default=1024)
    parser.add_argument("--rays", type=int, nargs="*", default=[16, 64, 256])
    parser.add_argument("--samples", type=int, nargs="*", default=[4, 16, 64])
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument("--skies", type=int, nargs="*", default=[1, 5, 23])
    for flag in ("antialiased", "no-cycles", "no-denoise"):
        parser.add_argument(f"--{flag}", action="store_true")
    return parser.parse_args()


def find_cycles() -> Cycles | None:
    try:
        return Cycles()
    except MissingDependencyError as error:
        print_line(f"Cycles is left out: {error}")
        return None


def triangles(meshes: tuple[TriMesh, ...]) -> str:
    return f"{sum(len(mesh.faces) for mesh in meshes) / 1e3:.0f} k"


def describe(frames: Frames, tracer: PathTracer, options: argparse.Namespace) -> None:
    scene = frames.scene()
    print_line(f"## {options.work.name}, {frames.camera.width_px}x{frames.camera.height_px}")
    print_line(
        f"{triangles(frames.static.meshes)} static and {triangles(scene.actors)} actor triangles, "
        f"camera {options.camera}; Mitsuba {tracer.variant}; {os.cpu_count()} cores, "
        f"{platform.machine()}, load {os.getloadavg()[0]:.1f}; static scene "
        f"{frames.static_seconds:.1f} s."
    )
    print_line()


class Judge:
    """The reference picture, and errors against it."""

    def __init__(
        self, frames: Frames, tracer: PathTracer, shot: Shot, buffers: Any, options: Any
    ) -> None:
        self.buffers = buffers
        self.base = np.clip(buffers.base_colour, 0.01, 1.0)
        self.is_image = options.antialiased
        self.seen = buffers.has_surface
        halves = self._reference(frames, tracer, shot, options)
        both = [self._radiance(half) for half in halves]
        self.reference = (both[0] + both[1]) / 2
        self.exposure = 0.9 / float(np.percentile(self.reference[self.seen], 95))
        relative, _, tone = self.errors(halves[0], both[1])
        print_line(
            f"Reference: {options.reference} paths a pixel; its own error is about relMSE "
            f"{relative / 4:.5f}, tonemapped RMSE {tone / 2:.4f}."
        )
        print_line()

    def _reference(self, frames: Frames, tracer: PathTracer, shot: Shot, options: Any) -> Array:
        kind = "area" if options.antialiased else "centre"
        name = f"{options.work.name}-{options.camera}-{options.width}-{kind}.npz"
        path = options.cache / name
        options.cache.mkdir(parents=True, exist_ok=True)
        size = (2, frames.camera.height_px, frames.camera.width_px, 3)
        sums, count = np.zeros(size), 0
        if path.exists():
            with np.load(path) as found:
                sums, count = found["sums"], int(found["count"])
        scene, view = frames.scene(), frames.view()
        # Halves of equal size, and both there, or their difference tells nothing.
        while count * _PASS < options.reference or count < 2 or count % 2:
            one = replace(shot, samples=_PASS)
            (picture,) = tracer.render_shots(scene, frames.camera, view, [one], 1000 + count)
            sums[count % 2] += picture
            count += 1
            np.savez(path, sums=sums, count=count)
        return np.stack([sums[0] / (count - count // 2), sums[1] / (count // 2)])

    def _radiance(self, picture: Array) -> Array:
        return picture if self.is_image else picture * self.base

    def errors(self, picture: Array, reference: Array | None = None) -> tuple[float, float, float]:
        """relMSE, the same without the worst hundredth of the pixels, and RMSE of sRGB values."""
        truth = self.reference if reference is None else reference
        x = self.exposure * self._radiance(picture)[self.seen]
        r = self.exposure * truth[self.seen]
        tone = np.sqrt(np.mean((srgb(x) - srgb(r)) ** 2))
        relative = np.sort(np.mean((x - r) ** 2 / (r**2 + 1e-2), axis=-1))
        most = relative[: int(0.99 * len(relative))]
        return float(relative.mean()), float(most.mean()), float(tone)

    def mean_ratio(self, picture: Array) -> float:
        return float(self._radiance(picture)[self.seen].mean() / self.reference[self.seen].mean())


def srgb(linear: Array) -> Array:
    x = np.clip(linear, 0, 1)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)


def methods_of(
    tracer: PathTracer, cycles: Cycles | None, shot: Shot, options: argparse.Namespace
) -> dict[str, TableMethod | ShotMethod]:
    points = 4 if options.antialiased else 1
    plain = TransportConfig(glossy_rays=0, pixel_samples=points)
    found: dict[str, TableMethod | ShotMethod] = {}
    for rays in options.rays:
        found[f"table N={rays}"] = TableMethod(replace(plain, sky_rays=rays))
    for rays in options.rays:
        every = replace(exact(), glossy_rays=0, pixel_samples=points, sky_rays=rays)
        found[f"table N={rays}, every pixel"] = TableMethod(every)
    for samples in options.samples:
        found[f"Mitsuba {samples}"] = ShotMethod(tracer, replace(shot, samples=samples))
    if cycles is not None:
        for samples in options.samples:
            found[f"Cycles {samples}"] = ShotMethod(cycles, replace(shot, samples=samples))
    return found


def quality(
    frames: Frames,
    judge: Judge,
    methods: dict[str, TableMethod | ShotMethod],
    options: argparse.Namespace,
) -> None:
    """All methods in turn, `repeats` times over; the quickest of each counts."""
    # Compiled loops and Mitsuba's kernels are made before anything is timed.
    warm = {type(m).__name__ + str(getattr(m, "tracer", "")): m for m in methods.values()}
    for method in warm.values():
        method.run(frames, [frames.dome])
    results: dict[str, list[Result]] = {}
    for _ in range(options.repeats):
        for name, method in methods.items():
            results.setdefault(name, []).append(method.run(frames, [frames.dome]))
    counts = options.skies
    head = " | ".join(f"{n} skies" for n in counts)
    print_line(
        "Processor seconds, which a busy machine disturbs less than the clock (in brackets)."
    )
    print_line()
    print_line(
        f"| method | mean | relMSE | best 99 % | sRGB RMSE | once | each sky | {head} | peak MB |"
    )
    print_line("|" + " --- |" * (8 + len(counts)))
    white = np.ones_like(judge.base)
    for name, runs in results.items():
        best = min(runs, key=lambda run: run.once.cpu_seconds + run.each.cpu_seconds)
        print_line(row(name, best, judge, counts))
        if not (options.no_denoise or options.antialiased):
            clean = denoised(best, white, judge.buffers.normal_world)
            print_line(row(f"{name} + OIDN", clean, judge, counts))
    print_line()


def row(name: str, result: Result, judge: Judge, counts: list[int]) -> str:
    relative, most, tone = judge.errors(result.picture)
    once, each = result.once, result.each
    totals = " | ".join(f"{once.cpu_seconds + n * each.cpu_seconds:.1f}" for n in counts)
    costs = " | ".join(f"{c.cpu_seconds:.2f} ({c.seconds:.2f})" for c in (once, each))
    quality = f"{judge.mean_ratio(result.picture):.4f} | {relative:.5f} | {most:.5f} | {tone:.4f}"
    return f"| {name} | {quality} | {costs} | {totals} | {max(once.peak_mb, each.peak_mb):.0f} |"


def split(frames: Frames, options: argparse.Namespace) -> None:
    """Where the light transport matrix's time goes, and further frames with all skies."""
    config = TransportConfig(glossy_rays=0)
    most = max(options.skies)
    cells = [prepare_sky(sky) for sky in frames.skies(most)]
    dark = [replace(cell, sun=None) for cell in cells]
    faces = static_face_table(frames.scene(), config)
    print_line(
        f"| light transport matrix, N={config.sky_rays} | place + BVH | primary | trace | sums "
        "| sun rays |"
    )
    print_line("|" + " --- |" * 6)
    for number in range(min(4, len(frames.frames))):
        marks = [time.process_time()]
        scene = frames.scene(number)
        marks.append(time.process_time())
        buffers = render_gbuffers(scene, frames.camera, frames.view(number))
        marks.append(time.process_time())
        table = trace_transport(scene, buffers, config, 0, faces)
        for skies in (dark, cells):
            marks.append(time.process_time())
            for cell in skies:
                light(table, scene, buffers, cell, config)
        marks.append(time.process_time())
        spent = np.diff(marks)
        spent[4] -= spent[3]
        print_line(
            f"| frame {number + 1}, CPU s | " + " | ".join(f"{value:.2f}" for value in spent) + " |"
        )
    print_line()
    print_line(f"Sums and sun rays are those of {most} skies.")


if __name__ == "__main__":
    main()
