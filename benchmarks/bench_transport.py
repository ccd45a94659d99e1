"""Time of each rendering step on a made-up street; prints a table, asserts nothing.

    python benchmarks/bench_transport.py [--width 960] [--height 540] [--rays 32] [--mitsuba]

`--mitsuba` adds Mitsuba's path tracer (16 samples, the scalar variant, which needs no LLVM).
"""

from __future__ import annotations

import argparse
import resource
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "render"))

import rendering_scenes as scenes

from lightsim.core.mesh import TriMesh, concatenate_meshes
from lightsim.render.gbuffers import render_gbuffers
from lightsim.render.scene import make_static_scene, without_actors
from lightsim.render.transport.light import light
from lightsim.render.transport.matrix import (
    TransportConfig,
    exact,
    static_face_table,
    trace_transport,
)
from lightsim.render.transport.sky import prepare_sky


def street() -> TriMesh:
    """A finely meshed road, 40 spheres and 24 house blocks: 1.5 M triangles."""
    meshes = [scenes.plane(80, 600, 0.4)]
    meshes += [scenes.sphere((-70 + 3.6 * k, 6 * (-1) ** k, 1), 1.0, 5) for k in range(40)]
    for side in (-1, 1):
        for k in range(12):
            height = 12 + 2 * (k % 4)
            centre = (-70 + 12 * k, 14 * side, height / 2)
            meshes.append(scenes.box(centre, (11, 8, height)))
    return concatenate_meshes(meshes)


def timed(name: str, action: Callable[[], Any]) -> Any:
    start = time.perf_counter()
    result = action()
    sys.stdout.write(f"{name:<44s} {time.perf_counter() - start:8.2f} s\n")
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--width", type=int, default=960)
    parser.add_argument("--height", type=int, default=540)
    parser.add_argument("--rays", type=int, default=32)
    parser.add_argument("--mitsuba", action="store_true")
    options = parser.parse_args()
    mesh = street()
    sys.stdout.write(f"{len(mesh.faces) / 1e6:.2f} M triangles\n")
    scene = without_actors(timed("static scene (once a log)", lambda: make_static_scene([mesh])))
    camera = scenes.camera(options.width, options.height, 0.52 * options.width)
    view = scenes.look_at((-60, 0, 2), (0, 1, 1.5))
    sky = scenes.sun_sky(1.0, 40.0, 0.3, 512)
    render_gbuffers(scene, scenes.camera(), view)
    buffers = timed("geometry buffers", lambda: render_gbuffers(scene, camera, view))
    for name, config in (
        ("every 2nd pixel", TransportConfig(sky_rays=options.rays)),
        ("every pixel", replace(exact(), sky_rays=options.rays)),
    ):
        small = render_gbuffers(scene, scenes.camera(), view)
        warm = trace_transport(scene, small, config)
        light(warm, scene, small, sky, config)
        cells = timed(f"{name}: sky (once a sky)", lambda c=config: prepare_sky(sky))
        faces = static_face_table(scene, config)
        for order in ("first frame", "next frame"):
            table = timed(
                f"{name}: trace, {order}",
                lambda c=config, f=faces: trace_transport(scene, buffers, c, face_table=f),
            )
        timed(
            f"{name}: light, each sky",
            lambda t=table, s=cells, c=config: light(t, scene, buffers, s, c),
        )
    if options.mitsuba:
        path_trace(mesh, sky, camera, view)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    sys.stdout.write(f"peak memory {peak:.0f} MB\n")


def path_trace(mesh: TriMesh, sky: Any, camera: Any, view: Any) -> None:
    from lightsim.render.reference.path_tracer import PathTracer
    from lightsim.render.reference.renderer import Shot

    scene, tracer = without_actors(make_static_scene([mesh])), PathTracer("scalar_rgb")
    shots = [Shot(sky, 16, 1, "diffuse")]
    timed(
        "Mitsuba scalar path, 16 samples, each sky",
        lambda: tracer.render_shots(scene, camera, view, shots, 0),
    )


if __name__ == "__main__":
    main()
