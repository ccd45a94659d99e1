"""The example package of docs/reference/extensions.md extends LightSim as it says."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from tests.conftest import BuiltStreet
from tests.relighting import scene

from lightsim import LogReading, cli, load_log
from lightsim.cli.app import commands
from lightsim.core.extensions import registered
from lightsim.errors import InputError
from lightsim.relighting.methods import method_names, relight_by
from lightsim.relighting.physical.ratio import RatioConfig, RelightInputs
from lightsim.store.images import write_png

EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "extensions"


@pytest.mark.parametrize("name", ["reader", "method", "command"])
def test_an_example_is_short(name: str) -> None:
    lines = (EXAMPLE / "lightsim_example" / f"{name}.py").read_text().splitlines()
    assert len([line for line in lines if line.strip()]) <= 30


def test_nothing_of_the_example_is_there_before_it_is_installed() -> None:
    assert "exposure" not in method_names()


@pytest.mark.usefixtures("example_extension")
def test_the_example_reads_a_log(tmp_path: Path) -> None:
    folder = tmp_path / "drive"
    pictures = [np.full((4, 6, 3), 60 * number, np.uint8) for number in range(3)]
    frames: list[dict[str, object]] = []
    for number, picture in enumerate(pictures):
        (folder / "images").mkdir(parents=True, exist_ok=True)
        write_png(folder / "images" / f"{number:02d}.png", picture)
        # The camera looks along world +x, 1.5 m above the ground, 2 m further in each frame.
        pose = [[0, 0, 1, 2.0 * number], [-1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]]
        file, time_ns = f"images/{number:02d}.png", 10**9 + 10**8 * number
        frames.append({"file": file, "time_ns": time_ns, "pose": pose})
    camera = {"width_px": 6, "height_px": 4, "fx": 5.0, "fy": 5.0, "cx": 3.0, "cy": 2.0}
    (folder / "dashcam.json").write_text(json.dumps({"camera": camera, "frames": frames}))
    log = load_log(LogReading(source=str(folder), image_scale=1.0))
    assert (log.name, log.stems, list(log.cameras)) == ("drive", ("00", "01", "02"), ["front"])
    np.testing.assert_array_equal(log.frames[2].load_srgb8(), pictures[2])
    middle = log.ego.at(10**9 + 5 * 10**7)
    np.testing.assert_allclose(middle.translation_m, [1.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(middle.rotation, np.eye(3), atol=1e-12)


@pytest.mark.usefixtures("example_extension")
def test_the_example_relights_a_frame(rng: np.random.Generator) -> None:
    buffers = scene.geometry(rng)
    sun = scene.sun_towards(0, 40)
    source = scene.light(buffers, sun, 0.5, scene.everywhere_lit())
    target = scene.light(buffers, None, 0.5, scene.everywhere_lit())
    matte = (~buffers.has_surface).astype(np.float32)
    radiance = (buffers.base_colour * source.shaded).astype(np.float32)
    sky = np.full_like(radiance, 0.7)
    clipped = np.zeros(matte.shape, bool)
    inputs = RelightInputs(radiance, clipped, matte, buffers, source, target, sky)
    made = relight_by("exposure")(inputs, RatioConfig()).radiance
    np.testing.assert_allclose(made[matte == 1], 0.7)
    ratios = made[matte == 0] / np.maximum(radiance[matte == 0], 1e-6)
    weights = np.array([0.2126, 0.7152, 0.0722])
    before, after = ((light.shaded[matte == 0] @ weights).mean() for light in (source, target))
    np.testing.assert_allclose(ratios, after / before, rtol=1e-4)


@pytest.mark.slow
@pytest.mark.usefixtures("example_extension")
def test_the_example_adds_a_command(
    built_street: BuiltStreet, capsys: pytest.CaptureFixture[str]
) -> None:
    sun = json.loads((built_street.work / "sky" / "sun.json").read_text())
    capsys.readouterr()
    cli.main(["sun", str(built_street.work)])
    words = capsys.readouterr().out.split()
    assert float(words[1]) == sun["azimuth_deg"]
    assert float(words[3]) == pytest.approx(sun["elevation_deg"], abs=0.005)
    cli.main(["sun", str(built_street.work), "--in-world"])
    direction = [float(word) for word in capsys.readouterr().out.split()]
    np.testing.assert_allclose(direction, sun["direction_world"], atol=1e-4)


@pytest.mark.usefixtures("example_extension")
@pytest.mark.parametrize(
    ("entry", "names", "message"),
    [
        ("[lightsim.commands]\nbuild = other:Build", commands, "which LightSim has"),
        ("[lightsim.methods]\nexposure = other:M", method_names, "two packages register 'expo"),
    ],
)
def test_a_name_that_is_taken_is_refused(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    entry: str,
    names: Callable[[], object],
    message: str,
) -> None:
    info = tmp_path / "other" / "other-1.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: other\nVersion: 1\n")
    (info / "entry_points.txt").write_text(f"{entry}\n")
    monkeypatch.syspath_prepend(info.parent)
    registered.cache_clear()
    with pytest.raises(InputError, match=message):
        names()
