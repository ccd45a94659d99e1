"""Base colour times light is what the cameras see: closed forms, and a street path traced."""

from __future__ import annotations

import json

import numpy as np
import pytest

from lightsim.core.mesh import concatenate_meshes
from lightsim.core.scenario import Scenario, ScenarioFrame
from lightsim.core.sensors import CameraFrame
from lightsim.errors import InputError
from lightsim.render.frame_renderer import FrameRenderer
from lightsim.render.reference.path_tracer import PathTracer
from lightsim.render.reference.renderer import Shot, Surfaces
from lightsim.render.transport.matrix import TransportConfig
from lightsim_lab.metrics.closure import measure_closure, surface_classes
from render.rendering_scenes import box, camera, look_at, plane, sun_sky


def test_perfect_light_closes_and_a_known_error_is_reported(rng: np.random.Generator) -> None:
    light, colour = rng.uniform(0.1, 2.0, (2, 3000, 3))
    seen = light * colour
    seen[:3] = 0.0
    is_bright = light.mean(axis=1) > 1.0
    classes = {"all": np.ones(3000, bool), "bright": is_bright, "none": np.zeros(3000, bool)}
    report = measure_closure(light * colour, seen, classes)
    assert [row.surface for row in report.rows] == ["all", "bright"]
    for row in report.rows:
        values = (row.median, row.percentile_10, row.percentile_90, *row.median_rgb)
        np.testing.assert_allclose(values, 1.0, rtol=1e-12)
    light[is_bright] *= np.array([1.3, 1.3, 1.0])
    bright = measure_closure(light * colour, seen, classes).rows[1]
    assert bright.median_rgb == pytest.approx((1.3, 1.3, 1.0))
    assert 1.2 < bright.percentile_10 < bright.median < bright.percentile_90 < 1.3
    assert bright.count == is_bright[3:].sum()
    assert json.loads(report.to_json())["rows"][1]["count"] == bright.count
    assert f"| bright | {bright.count} | 1.000 |" in report.to_table()


def test_classes_of_surface_and_what_cannot_be_compared() -> None:
    normals = np.array([[0, 0, 1.0], [0, 0, 1], [1, 0, 0], [0, 1, 0], [0.6, 0, 0.8]])
    found = surface_classes(normals, np.array([1.0, 0.0, 1.0, 0.0, 1.0]))
    members = {name: np.flatnonzero(is_member).tolist() for name, is_member in found.items()}
    assert members == {
        "all": [0, 1, 2, 3, 4],
        "ground, lit": [0],
        "ground, shadowed": [1],
        "facades, lit": [2],
        "facades, shadowed": [3],
    }
    one = np.ones((5, 3))
    with pytest.raises(InputError, match="no surface sample"):
        measure_closure(one, 0 * one, found)


@pytest.mark.slow
@pytest.mark.parametrize("surfaces", ["diffuse", "principled"])
def test_a_street_with_true_sky_geometry_and_base_colour_closes(surfaces: Surfaces) -> None:
    """Light of the twin's renderer, pictures of an independent path tracer; one bounce. Rough
    surfaces of the Principled model, of whose light a Lambert model misses up to a third."""
    houses = [
        box((9.0 * k, side * 7.0, 3.0 + k % 2), (8.0, 6.0, 6.0 + 2 * (k % 2)), albedo)
        for k in range(-2, 3)
        for side, albedo in ((-1, (0.55, 0.4, 0.3)), (1, (0.5, 0.52, 0.6)))
    ]
    street = concatenate_meshes([plane(40.0, 80, (0.2, 0.21, 0.22)), *houses])
    sky = sun_sky(np.radians(60.0), 50.0, 0.4)
    view, lens = look_at((-14.0, -1.0, 1.6), (0.0, 0.8, 1.9)), camera(64, 40, 40.0)

    def no_image() -> np.ndarray:
        raise AssertionError("nothing was recorded")

    frame = CameraFrame("test", "00", 0, view, no_image)
    config = TransportConfig(sky_rays=128)
    renderer = FrameRenderer(street, plane(cells=0), config, 0)
    scenario = Scenario("street", (ScenarioFrame.of(frame, "rendered"),), ())
    traced = renderer.trace(scenario, frame, lens)
    buffers, light = traced.buffers, traced.light(sky)
    predicted = buffers.base_colour * light.shaded
    if surfaces == "principled":
        predicted += light.reflected
    shot = Shot(sky, 96, 1, surfaces, is_antialiased=False)
    (seen,) = PathTracer("scalar_rgb").render_shots(
        renderer.scene(scenario, 0), lens, view, [shot], 0
    )
    surface = buffers.has_surface
    report = measure_closure(
        predicted[surface],
        seen[surface],
        surface_classes(buffers.normal_world[surface], light.sun_visibility[surface]),
    )
    assert {row.surface for row in report.rows} == {
        "all", "ground, lit", "ground, shadowed", "facades, lit", "facades, shadowed",
    }  # fmt: skip
    # Mitsuba's diffuse lobe of rough surfaces is brighter than Lambert's (Burley 2012).
    closed, tolerance = (1.0, 0.02) if surfaces == "diffuse" else (0.93, 0.08)
    for row in report.rows:
        assert row.count > 50, row
        medians = (row.median, *row.median_rgb)
        np.testing.assert_allclose(medians, closed, atol=tolerance, err_msg=str(row))
