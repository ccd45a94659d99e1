"""Training samples of a built street: what relighting sees, beside the street's truth."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.conftest import BuiltStreet

from lightsim import cli
from lightsim.errors import InputError, LightSimError
from lightsim.progress import SilentProgress
from lightsim.relighting.network.channels import LIGHT, SCENE, TARGET
from lightsim.simulation.options import RelightOptions
from lightsim.simulation.relight import relight
from lightsim.store.images import read_srgb8
from lightsim_lab.studies.prepare_relight import prepare_relight
from lightsim_lab.studies.relight_samples import write_samples
from lightsim_lab.synthetic import shipped_street
from lightsim_lab.training.options import PrepareRelightOptions
from lightsim_lab.training.relight import RelightTrainConfig, paper
from lightsim_lab.training.relight_cache import read_sample
from lightsim_lab.training.relight_data import RelightData, RelightDataConfig

CAMERA, STEM, SKY = "front_camera", "03", "overcast"
OTHER_SKY = "low_sun"


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One view of the shipped street under two skies."""
    folder = tmp_path_factory.mktemp("truth")
    whole = shipped_street() / "truth"
    for sky in (SKY, OTHER_SKY):
        for name in (f"relit/{sky}/{CAMERA}/{STEM}.jpg", f"skies/{sky}.exr"):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(whole / name, folder / name)
    return folder


def test_samples_hold_what_relighting_makes(
    built_street: BuiltStreet, truth: Path, tmp_path: Path
) -> None:
    assert write_samples(built_street.work, truth, tmp_path, SilentProgress()) == 3
    path = tmp_path / f"{CAMERA}_{STEM}.npz"
    sample = read_sample(path)
    assert set(sample.scene) >= {*SCENE, "valid", *(f"source_{name}" for name in LIGHT)}
    target = sample.targets[SKY]
    assert set(target.planes) >= {f"target_{name}" for name in (*LIGHT, *TARGET)}
    true = read_srgb8(truth / "relit" / SKY / CAMERA / f"{STEM}.jpg")
    assert target.truth is not None
    assert np.array_equal(np.moveaxis(target.truth, 0, -1), true)
    options = RelightOptions(
        name="as-sampled",
        method="physical",
        sky=(str(truth / "skies" / f"{SKY}.exr"),),
        sky_scale="none",
        cameras=(CAMERA,),
        frames="3:4",
        image_scale=1.0,
    )
    made = relight(built_street.work, options, SilentProgress())[0]
    picture = read_srgb8(made / "frames" / CAMERA / f"{STEM}.png").astype(np.float32) / 255
    physical = np.moveaxis(target.planes["target_physical"].astype(np.float32), 0, -1)
    shown = np.where(physical <= 0.0031308, 12.92 * physical, 1.055 * physical ** (1 / 2.4) - 0.055)
    is_seen = sample.scene["valid"][0] > 0
    assert np.abs(np.clip(shown, 0, 1) - picture)[is_seen].max() < 0.004
    # The true picture of one sky is the source for the other.
    under = read_sample(tmp_path / f"{CAMERA}_{STEM}_under_{SKY}.npz")
    assert set(under.targets) == {OTHER_SKY}
    source = np.moveaxis(under.scene["source"].astype(np.float32), 0, -1)
    np.testing.assert_allclose(source, true / 255, atol=2e-3)
    for name in LIGHT:
        assert np.array_equal(under.scene[f"source_{name}"], target.planes[f"target_{name}"])
    wanted, seen = (one.targets[OTHER_SKY].truth for one in (under, sample))
    assert wanted is not None
    assert seen is not None
    assert np.array_equal(wanted, seen)
    # What is there is not made again.
    before = path.stat().st_mtime_ns
    write_samples(built_street.work, truth, tmp_path, SilentProgress())
    assert path.stat().st_mtime_ns == before
    assert RelightData([tmp_path], RelightDataConfig()).skies(0) == sorted((SKY, OTHER_SKY))


@pytest.fixture(scope="module")
def works(built_street: BuiltStreet, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two work folders of one street, whose names differ."""
    other = tmp_path_factory.mktemp("works") / "053"
    shutil.copytree(built_street.work, other)
    return built_street.work, other


def test_logs_without_truth_give_the_papers_pairs(works: tuple[Path, Path], tmp_path: Path) -> None:
    options = PrepareRelightOptions(
        tmp_path, works=works, cameras=(CAMERA,), every=100, sky_offset_deg=90.0
    )
    prepare_relight(options, SilentProgress())
    own, other = works
    (path,) = (tmp_path / own.name).glob("*.npz")
    sample = read_sample(path)
    # Its only target is the sky of the other log, turned, and nothing knows its true picture.
    (sky,) = sample.targets
    assert sky == "053_source"
    assert sample.targets[sky].truth is None
    source = sample.scene["source_dome"].astype(np.float64)
    target = sample.targets[sky].planes["target_dome"].astype(np.float64)
    # Both logs are the same street: a turn leaves the mean of each row and moves the sun.
    np.testing.assert_allclose(target.mean((0, 2)), source.mean((0, 2)), rtol=0.1)
    assert np.argmax(target.sum(0)) != np.argmax(source.sum(0))
    # A repeated command makes nothing again.
    before = path.stat().st_mtime_ns
    prepare_relight(options, SilentProgress())
    assert path.stat().st_mtime_ns == before
    config = replace(
        paper(RelightTrainConfig()).data,
        crop_px=(4000, 4000),
        batch=1,
        sim_real_fraction=1.0,
        sim_sim_fraction=0.0,
    )
    data = RelightData([tmp_path / own.name, tmp_path / other.name], config)
    assert len(data) == 2
    batch = data.batch(0, 0)
    # The recorded picture is the target, and a rendering of the twin the source.
    recorded = sample.scene["source"].astype(np.float32)
    wholes = (recorded, recorded[..., ::-1])
    assert any(np.abs(one - batch.truth[0].numpy()).max() < 1e-3 for one in wholes)
    assert np.abs(batch.planes["source"][0].numpy() - batch.truth[0].numpy()).mean() > 0.01


def test_works_must_have_twins_names_of_their_own_and_target_skies(
    works: tuple[Path, Path], tmp_path: Path
) -> None:
    wrong = {
        "no target skies": works[:1],
        "same name": (works[0], works[0]),
        "has not been made": (works[0], tmp_path),
    }
    for message, given in wrong.items():
        with pytest.raises(LightSimError, match=message):
            prepare_relight(PrepareRelightOptions(tmp_path / "x", works=given), SilentProgress())
    assert not list(tmp_path.rglob("*.npz"))


def test_skies_need_a_split(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no train/test split"):
        prepare_relight(PrepareRelightOptions(tmp_path, hdri=tmp_path), SilentProgress())


def test_streets_of_the_benchmark_teach_nobody(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="must not be used for training"):
        prepare_relight(PrepareRelightOptions(tmp_path, streets=(201, 58)), SilentProgress())


def test_the_shipped_network_relights_frames(built_street: BuiltStreet) -> None:
    words = ["relight", str(built_street.work), "--sky", "sun:120,35", "--frames", "3:4"]
    words += ["--cameras", CAMERA, "--sky-scale", "none"]
    pictures = {}
    for method in ("physical", "network"):
        name = f"by-{method}"
        cli.main([*words, "--name", name, "--method", method])
        folder = built_street.work / "scenarios" / name / "frames" / CAMERA
        pictures[method] = read_srgb8(folder / f"{STEM}.png").astype(np.float32)
    difference = np.abs(pictures["network"] - pictures["physical"])
    assert 0.1 < difference.mean() < 20
