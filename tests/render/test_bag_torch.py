"""The table sums in torch against numba."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rendering_scenes import box, camera, look_at, plane, sun_sky

from lightsim.core.scenario import Scenario
from lightsim.render.gbuffers import render_gbuffers
from lightsim.render.scene import make_static_scene, place
from lightsim.render.transport.kernels import point_light
from lightsim.render.transport.light import light
from lightsim.render.transport.matrix import exact, trace_transport
from lightsim.render.transport.matrix_torch import TorchTransport


@pytest.mark.parametrize(
    "device",
    ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)],
)
def test_sums_equal_those_of_numba(rng: np.random.Generator, device: str) -> None:
    import torch

    if device == "cuda" and not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    points, rays, cells, faces = 500, 33, 90 * 180, 200
    sky_cells = rng.integers(0, cells, (points, rays)).astype(np.uint16)
    face_rows = rng.integers(-1, faces, (points, rays)).astype(np.int32)
    face_rows[rng.uniform(size=face_rows.shape) < 0.5] = -1
    on_device = TorchTransport(sky_cells, face_rows, cells, device)
    for _ in range(2):
        sky = rng.gamma(1.0, 1.0, (cells, 3)).astype(np.float32)
        radiosity = rng.uniform(0, 1, (faces, 3)).astype(np.float32)
        expected = np.empty((points, 9), np.float32)
        point_light(sky_cells, face_rows, sky, radiosity, expected)
        np.testing.assert_allclose(
            on_device.point_light(sky, radiosity), expected, rtol=1e-5, atol=1e-6
        )


def test_points_that_meet_no_face_need_no_radiosity() -> None:
    sky = np.ones((8, 3), np.float32)
    open_rows = np.full((3, 4), -1, np.int32)
    on_device = TorchTransport(np.zeros((3, 4), np.uint16), open_rows, 8, "cpu")
    light = on_device.point_light(sky, np.zeros((0, 3), np.float32))
    np.testing.assert_allclose(light, np.tile([1, 1, 1, 0, 0, 0, 1, 1, 1], (3, 1)))


def test_the_ray_table_uses_it_where_its_config_names_a_device() -> None:
    meshes = [plane(8.0, 9), box([2, 1, 1], [1, 2, 2])]
    static = make_static_scene(meshes)
    scene = place(static, Scenario("test", (), ()), 0)
    view = camera()
    buffers = render_gbuffers(scene, view, look_at([0, -6, 4], [0, 0, 0.5]))
    images = []
    for device in ("cpu", "cpu:0"):
        config = replace(exact(), device=device)
        table = trace_transport(scene, buffers, config)
        assert (table.points.on_device is None) == (device == "cpu")
        images.append(light(table, scene, buffers, sun_sky(1.0, 40.0, 0.3), config).shaded)
    np.testing.assert_allclose(images[0], images[1], rtol=1e-4, atol=1e-5)
