"""Memory of a large frame, in a process of its own."""

from __future__ import annotations

from pathlib import Path

import pytest

from limits import run_limited

_SCRIPT = """
sys.path.insert(0, sys.argv[1])
import rendering_scenes as scenes
from lightsim.render.gbuffers import render_gbuffers
from lightsim.render.transport.light import light
from lightsim.render.transport.samples import render_samples
from lightsim.render.scene import make_static_scene, without_actors
from lightsim.render.transport.matrix import TransportConfig, trace_transport

scene = without_actors(make_static_scene([scenes.plane(80.0, 60), scenes.sphere((0, 0, 1), 1.0)]))
lens, view = scenes.camera(1920, 1080, 1000.0), scenes.look_at((0, -9, 5), (0, 0, -3))
config = TransportConfig(sky_rays=64, pixel_samples=4)
buffers = render_gbuffers(scene, lens, view)
samples = render_samples(scene, lens, view, buffers, config)
table = trace_transport(scene, buffers, config, samples=samples)
out = light(table, scene, buffers, scenes.sun_sky(1.0, 40.0, 0.3), config)
assert buffers.has_surface.mean() > 0.9
"""


@pytest.mark.slow
def test_a_full_hd_frame_with_64_rays_stays_within_two_gigabytes():
    finished = run_limited(_SCRIPT, Path(__file__).parent, cpu_s=500, memory_mb=12_000, wall_s=600)
    assert 100 < finished.peak_mb < 2e9 / 2**20
