"""Weights of one's own for the lighting networks: both forms work, and others are refused."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from tests.lighting.test_sky_networks import clear_picture, seen_by_cameras

from lightsim import cli
from lightsim.core.solar import angle_between_deg, direction_enu
from lightsim.core.twin import Panorama
from lightsim.errors import InputError
from lightsim.lighting.panorama.inpaint_network import InpaintGenerator
from lightsim.lighting.sky.image_sky import panorama_from_image
from lightsim.lighting.sky.network import SkyNetwork, SkyNetworkConfig, tensors_of
from lightsim.lighting.sky.paper_network import PAPER_KIND, PaperSkyConfig, PaperSkyNetwork
from lightsim.lighting.sky.predict import completed_panorama, decoded_dome, predict_sky
from lightsim.lighting.weights import LightingWeights
from lightsim.networks.stored import stored_tensors
from lightsim.store.images import write_png
from lightsim.store.weights import WEIGHTS_FOLDER, WeightsRecord, write_weights

HEIGHT_PX = 64
RECORD = WeightsRecord("a network", "lightsim train", "none", "0", 0, 0, "none", "test", "0")


@pytest.fixture(scope="module")
def panorama() -> Panorama:
    return panorama_from_image(clear_picture(20.0, 25.0), seen_by_cameras(), HEIGHT_PX)


@pytest.fixture(scope="module")
def published(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Untrained weights of the published sky network."""
    path = tmp_path_factory.mktemp("weights") / "sky.safetensors"
    config = PaperSkyConfig((8, 8, 8, 8), (8, 8, 8, 8))
    network = PaperSkyNetwork(config, seed=4)
    write_weights(path, stored_tensors(network, config, PAPER_KIND), RECORD)
    return path


def test_the_published_network_reads_the_completed_panorama(
    panorama: Panorama, published: Path, tmp_path: Path
) -> None:
    weights = LightingWeights(published)
    weights.check()
    prediction = predict_sky(panorama, weights)
    assert prediction.sun_direction[2] > 0
    assert np.linalg.norm(prediction.sun_direction) == pytest.approx(1, abs=1e-5)
    # Other weights of the completion change its input; those of our network do not.
    other = tmp_path / "inpaint.safetensors"
    generator = InpaintGenerator(4, HEIGHT_PX, (1, 2), is_residual=False)
    write_weights(other, generator.state_dict(), RECORD)
    own = LightingWeights(published, other)
    own.check()
    painted, shipped = (completed_panorama(panorama, one)[0] for one in (own, weights))
    seen = panorama.is_seen
    assert np.array_equal(painted[seen], shipped[seen])
    assert np.abs(painted - shipped)[~seen].mean() > 0.01
    assert not np.array_equal(predict_sky(panorama, own).latent, prediction.latent)
    ours = LightingWeights(inpaint=other)
    assert np.array_equal(predict_sky(panorama, ours).latent, predict_sky(panorama).latent)


def test_the_published_network_decodes_another_dome(panorama: Panorama, published: Path) -> None:
    towards = direction_enu(60.0, 30.0)
    domes = [
        decoded_dome(panorama, weights, sun_direction=towards)
        for weights in (LightingWeights(published), LightingWeights())
    ]
    assert all(np.isfinite(dome.radiance).all() for dome in domes)
    above = slice(HEIGHT_PX // 2)
    assert not np.allclose(domes[0].radiance[above], domes[1].radiance[above], rtol=0.1)


def test_a_sun_below_the_horizon_is_raised_to_it(panorama: Panorama, tmp_path: Path) -> None:
    """The published encoder may point anywhere, and the dome has no lower half."""
    config = PaperSkyConfig((8, 8, 8, 8), (8, 8, 8, 8))
    network = PaperSkyNetwork(config)
    tensors = stored_tensors(network, config, PAPER_KIND)
    last = "direction_encoder.head.2"
    tensors[f"{last}.weight"].zero_()
    bias = tensors[f"{last}.bias"]
    bias.copy_(bias.new_tensor([3.0, 0.0, -4.0]))
    path = tmp_path / "sky.safetensors"
    write_weights(path, tensors, RECORD)
    found = predict_sky(panorama, LightingWeights(path)).sun_direction.astype(np.float64)
    low = math.radians(1.0)
    assert angle_between_deg(found, np.array([math.cos(low), 0.0, math.sin(low)])) < 0.01


def test_other_weights_are_refused_in_one_line(tmp_path: Path, published: Path) -> None:
    relight = WEIGHTS_FOLDER / "relight-paper.safetensors"
    inpaint = WEIGHTS_FOLDER / "inpaint-small.safetensors"
    small = tmp_path / "small.safetensors"
    network = SkyNetwork(SkyNetworkConfig())
    tensors = tensors_of(network)
    # Tensors of another size than the stored settings say.
    name = next(name for name, value in tensors.items() if value.ndim == 4)
    write_weights(small, {**tensors, name: tensors[name][:, :1]}, RECORD)
    text = tmp_path / "text.safetensors"
    text.write_text("not weights")
    for wrong in (
        LightingWeights(relight),
        LightingWeights(inpaint),
        LightingWeights(small),
        LightingWeights(text),
        LightingWeights(tmp_path / "missing"),
        LightingWeights(inpaint=published),
        LightingWeights(inpaint=relight),
    ):
        with pytest.raises(InputError) as found:
            wrong.check()
        message = str(found.value)
        own = next(w for w in (wrong.sky, wrong.inpaint) if isinstance(w, Path))
        assert message.startswith(str(own))
        assert "\n" not in message
        assert len(message) < 500 + len(str(own))
    LightingWeights(inpaint=inpaint).check()
    LightingWeights(WEIGHTS_FOLDER / "sky-small.safetensors").check()


def test_the_sky_of_a_picture_by_weights_of_ones_own(
    tmp_path: Path, published: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    picture = tmp_path / "panorama.png"
    write_png(picture, clear_picture(20.0, 25.0))
    suns = []
    for name, more in (("ours", ()), ("published", ("--weights", str(published)))):
        cli.main(["sky", "estimate", str(picture), "--out", str(tmp_path / name), *more])
        suns.append(json.loads((tmp_path / name / "sun.json").read_text()))
    assert suns[0] != suns[1]
    wrong = ("--weights", str(WEIGHTS_FOLDER / "inpaint-small.safetensors"))
    with pytest.raises(SystemExit):
        cli.main(["sky", "estimate", str(picture), "--out", str(tmp_path / "x"), *wrong])
    assert "not those of a sky network" in capsys.readouterr().err
