"""Training of the relighting network on frames whose error is known."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from lightsim import cli
from lightsim.errors import InputError
from lightsim.relighting.network.channels import DOME_ROWS, LIGHT, SCENE
from lightsim.relighting.network.features import Batch, level, linear_of, modelled, srgb_of
from lightsim.relighting.network.model import RelitNet
from lightsim.relighting.network.paper_model import PaperNet, PaperNetConfig
from lightsim.relighting.network.stored import network_for, network_of
from lightsim.store.weights import WEIGHTS_FOLDER, read_record, read_weights
from lightsim_lab.training.options import RelightTrainingOptions
from lightsim_lab.training.relight import RelightTrainConfig, ablated, paper, paper_loss
from lightsim_lab.training.relight_cache import (
    RelightSample,
    RelightTargetSample,
    read_sample,
    write_sample,
)
from lightsim_lab.training.relight_data import RelightData, RelightDataConfig
from lightsim_lab.training.relight_losses import Perceptual, colour_loss, edge_loss, norm_loss
from lightsim_lab.training.relight_pairs import (
    RelightBatch,
    Views,
    exposed,
    rendered_pair,
    with_exact_estimate,
)
from lightsim_lab.training.run_relight import train

ROWS, COLUMNS = 32, 48
ERROR = np.array([1.3, 0.8, 1.1], np.float32)[:, None, None]
"""What the truth has of the physical estimate: a network can learn no simpler thing."""


def made_sample(rng: np.random.Generator) -> RelightSample:
    def plane(channels: int, most: float = 1.0) -> np.ndarray:
        return rng.uniform(0, most, (channels, ROWS, COLUMNS)).astype(np.float32)

    sky = {
        "dome": np.ones((3, DOME_ROWS, 2 * DOME_ROWS), np.float32),
    }
    light = {name: plane(channels) for name, channels in LIGHT.items()}
    scene = {name: plane(channels) for name, channels in SCENE.items()}
    scene |= {f"source_{k}": v for k, v in {**light, **sky}.items()}
    zeros = np.zeros((1, ROWS, COLUMNS), np.float32)
    scene |= {"matte": zeros, "clipped": zeros, "valid": zeros + 1}
    # Pixels of 8 x 8, as a picture has parts.
    physical = 0.02 + 0.5 * plane(3)[:, ::8, ::8].repeat(8, 1).repeat(8, 2)
    target = {f"target_{k}": v for k, v in {**light, **sky}.items()}
    # Under the recorded light a network has nothing to mend.
    target |= {"target_shaded": 1.5 * light["shaded"]}
    target |= {"target_physical": physical, "target_sky": plane(3)}
    truth = srgb_of(torch.from_numpy(physical * ERROR)).clamp(0, 1).numpy()
    return RelightSample(
        scene, {"low_sun": RelightTargetSample(target, np.rint(255 * truth).astype(np.uint8))}
    )


@pytest.fixture(scope="module")
def streets(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two streets of two frames each."""
    folder, rng = tmp_path_factory.mktemp("relight"), np.random.default_rng(3)
    for street in ("1", "2"):
        (folder / street).mkdir()
        for k in range(2):
            write_sample(folder / street / f"front_camera_{k:02d}.npz", made_sample(rng))
    return folder


def test_samples_come_back(streets: Path, rng: np.random.Generator) -> None:
    sample = made_sample(rng)
    path = streets / "one.npz"
    write_sample(path, sample)
    again = read_sample(path)
    path.unlink()
    for name, value in sample.scene.items():
        np.testing.assert_allclose(again.scene[name], value, rtol=1e-3, atol=1e-3)
    target, wanted = again.targets["low_sun"], sample.targets["low_sun"]
    assert target.truth is not None
    assert wanted.truth is not None
    assert np.array_equal(target.truth, wanted.truth)
    assert set(target.planes) == set(wanted.planes)


def test_a_draw_is_the_same_every_time_and_another_is_not(streets: Path) -> None:
    data = RelightData([streets / "1"], RelightDataConfig(crop_px=(16, 24)))
    one, same, other = (data.batch(draw, 5) for draw in (3, 3, 4))
    assert torch.equal(one.truth, same.truth)
    assert not torch.equal(one.truth, other.truth)
    assert one.truth.shape == (8, 3, 16, 24)
    assert one.planes["target_dome"].shape[-2:] == (DOME_ROWS, 2 * DOME_ROWS)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")
def test_batches_made_on_the_device_are_those_of_the_processor(streets: Path) -> None:
    config = RelightDataConfig(crop_px=(16, 24), identity_fraction=0.2, true_twin_fraction=0.3)
    data = RelightData([streets / "1"], config)
    resident = data.on(torch.device("cuda"))
    assert resident.device.type == "cuda"
    one, same = data.batch(3, 5), resident.batch(3, 5).on(torch.device("cpu"))
    torch.testing.assert_close(same.truth, one.truth, atol=2e-3, rtol=0)
    for name, value in one.planes.items():
        torch.testing.assert_close(same.planes[name], value, atol=2e-3, rtol=2e-3)


def test_a_crop_knows_how_bright_its_whole_frame_is(streets: Path) -> None:
    still = {"exposure_ev": (0.0, 0.0), "paint_ev": (0.0, 0.0), "light_error_ev": 0.0}
    config = RelightDataConfig(
        crop_px=(16, 24), identity_fraction=0.0, true_twin_fraction=0.0, **still
    )
    data = RelightData([streets / "1"], config)
    whole = torch.cat([level(data.whole(k, "low_sun").planes) for k in range(len(data))]).ravel()
    batch = data.batch(0, 0)
    stored = batch.planes["target_level"].ravel()
    away = (stored[:, None] - whole).abs().amin(dim=1)
    torch.testing.assert_close(away, torch.zeros_like(away), atol=1e-6, rtol=0)
    assert (stored - level(batch.planes).ravel()).abs().max() > 1e-3


def test_the_identity_asks_for_the_source(streets: Path) -> None:
    config = RelightDataConfig(identity_fraction=1.0, true_twin_fraction=0.0, light_error_ev=0.0)
    batch = RelightData([streets / "1"], config).batch(0, 0)
    assert torch.equal(batch.truth, batch.planes["source"])
    shown = srgb_of(batch.planes["target_physical"]).clamp(0, 1)
    torch.testing.assert_close(shown, batch.truth)
    for name in LIGHT:
        assert torch.equal(batch.planes[f"target_{name}"], batch.planes[f"source_{name}"])


def test_light_and_paint_may_be_any_and_the_picture_stays_their_sum(streets: Path) -> None:
    """Sources that are base colour times light, plus mirrors: still so in another exposure, with
    other paint; the sky behind has no paint, and truth and estimate change alike."""
    one = RelightData([streets / "1"], RelightDataConfig()).whole(0, "low_sun")
    planes = one.planes | {"matte": torch.zeros_like(one.planes["matte"])}
    planes["matte"][..., :8] = 1.0
    planes["source"] = srgb_of(modelled(planes, "source") / 4)
    planes |= {"source_shaded": planes["source_shaded"] / 4}
    planes |= {"source_reflected": planes["source_reflected"] / 4}
    base_colour_factor = np.array([0.5, 0.8, 1.1])
    made = exposed(RelightBatch(planes, one.truth, one.weight), 0.7, base_colour_factor)
    colour_factor = torch.from_numpy(base_colour_factor.astype(np.float32))[:, None, None]
    shown = linear_of(made.planes["source"])
    torch.testing.assert_close(shown[..., 8:], modelled(made.planes, "source")[..., 8:])
    before = linear_of(planes["source"])
    torch.testing.assert_close(shown[..., :8], 0.7 * before[..., :8])
    for after, was in ((made.truth, one.truth), (made.planes["source"], planes["source"])):
        change = (linear_of(after) / linear_of(was))[..., 8:]
        torch.testing.assert_close(
            change, (0.7 * colour_factor).expand_as(change), rtol=1e-3, atol=1e-3
        )


def test_losses_are_what_they_say() -> None:
    torch.manual_seed(0)
    one = torch.rand(1, 3, 64, 64)
    ones = torch.ones(1, 1, 64, 64)

    def rms(error: float) -> Any:
        """A root mean square beyond a code's noise, whose gradient is finite at 0."""
        return pytest.approx(np.hypot(error, 1 / 255) - 1 / 255, abs=1e-6)

    assert float(colour_loss(one + 0.1, one, ones)) == rms(0.1)
    assert float(edge_loss(one + 0.1, one, ones)) == rms(0.0)
    ramp = torch.linspace(0, 6.3, 64).expand(1, 3, 64, 64)
    # A slope of a tenth across, none along.
    assert float(edge_loss(ramp, torch.zeros_like(ramp), ones)) == rms(0.1 / np.sqrt(2))
    weight = ones.clone()
    weight[..., :32] = 0
    assert float(colour_loss(one + 0.1 * (1 - weight), one, weight)) == rms(0.0)


class _Ramp(PaperNet):
    """Network that returns tenths of 1 to 9 as 3 x 3 pixels, whatever it receives."""

    def forward(self, batch: Batch) -> torch.Tensor:
        tenths = torch.arange(1.0, 10.0).reshape(1, 1, 3, 3) / 10
        return tenths.expand(len(batch["source"]), 3, 3, 3)


class _Quarter(Perceptual):
    """LPIPS of a quarter for each picture."""

    def forward(self, made: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
        assert len(made) == len(truth) == 2
        return torch.tensor(0.25)


def test_the_papers_loss_has_the_published_terms_and_weights() -> None:
    """A ramp against black: values .1 to .9; the Sobel operator gives .8 across and 2.4 down."""
    black = torch.zeros(2, 3, 3, 3)
    batch = RelightBatch({"source": black}, black, torch.ones(2, 1, 3, 3))
    config = paper(RelightTrainConfig(data=RelightDataConfig(batch=2)))
    total, terms = paper_loss(_Ramp(PaperNetConfig()), batch, _Quarter(), config)
    # The sum of the squares of 1 to 9 is 285.
    assert float(terms["colour"]) == pytest.approx(np.sqrt(2.85 / 9), abs=1e-6)
    assert float(terms["edges"]) == pytest.approx(np.sqrt((0.8**2 + 2.4**2) / 2), abs=1e-6)
    assert float(total) == pytest.approx(0.5627314 + 1 * 0.25 + 400 * 1.7888544, abs=1e-3)
    # One pixel less: the mean is over those that count, and there is no edge where it was.
    weight = batch.weight.clone()
    weight[..., 2, 2] = 0
    _, terms = paper_loss(
        _Ramp(PaperNetConfig()), replace(batch, weight=weight), _Quarter(), config
    )
    assert float(terms["colour"]) == pytest.approx(np.sqrt(2.04 / 8), abs=1e-6)
    assert float(terms["edges"]) == pytest.approx(np.sqrt((0.1**2 + 1.5**2) / 2), abs=1e-6)


def test_a_picture_without_an_error_has_a_finite_gradient() -> None:
    made = torch.full((1, 3, 4, 4), 0.5, requires_grad=True)
    norm_loss(made, made.detach(), torch.ones(1, 1, 4, 4)).backward()
    assert made.grad is not None
    assert torch.equal(made.grad, torch.zeros_like(made))


def test_the_papers_pairs_are_lit_by_skies_of_random_intensity(streets: Path) -> None:
    whole = paper(RelightTrainConfig())
    config = whole.data
    assert (config.sim_sim_fraction, config.sim_real_fraction) == (0.45, 0.45)
    assert (config.identity_fraction, config.true_twin_fraction) == (0.1, 0.0)
    # Whatever is left out, no pair has a true picture.
    for part in ("sim-real", "identity"):
        assert ablated(whole, (part,)).data.true_fraction == 0.0
    config = replace(config, sim_sim_fraction=1.0, sim_real_fraction=0.0, identity_fraction=0.0)
    config = replace(config, batch=64)
    data = RelightData([streets / "1"], config)
    batch = data.batch(0, 0)
    # The samples' domes are white, so that they show the factor.
    factors = {w: batch.planes[f"{w}_dome"].mean((1, 2, 3)) for w in ("source", "target")}
    for which, factor in factors.items():
        assert factor.min() >= 0.5 - 1e-3
        assert factor.max() <= 2.0 + 1e-3
        shaded = batch.planes[f"{which}_shaded"].amax((1, 2, 3))
        # The light of the samples is at most 1, under target skies 1.5.
        assert ((shaded / factor - 1.25).abs() < 0.26).all()
    assert len(factors["target"].unique()) > 4
    assert not torch.equal(factors["source"], factors["target"])


def test_options_of_the_losses_are_checked(streets: Path, tmp_path: Path) -> None:
    command = RelightTrainingOptions(data=streets, out=tmp_path, streets=("1",))
    wrong = {
        "epe": replace(command, crops=2, network="epe"),
        "--crops": replace(command, crops=0),
        "--crop-px": replace(command, crop_px=8),
    }
    for message, given in wrong.items():
        with pytest.raises(InputError, match=message):
            train(given)
    words = ["train", "relight", "--data", str(streets), "--out", str(tmp_path), "--steps", "1"]
    cli.main([*words, "--streets", "1", "--crops", "2", "--crop-px", "32"])
    line = json.loads((tmp_path / "metrics.jsonl").read_text().splitlines()[0])
    assert {"colour", "edges"} <= set(line)


def test_the_perceptual_loss_is_the_measure() -> None:
    from lightsim_lab.metrics.lpips import lpips

    rng = np.random.default_rng(0)
    one, other = (rng.uniform(size=(64, 80, 3)).astype(np.float32) for _ in range(2))
    tensors = [torch.from_numpy(x).permute(2, 0, 1)[None] for x in (one, other)]
    assert float(Perceptual()(*tensors)) == pytest.approx(lpips(one, other), abs=1e-5)


def test_the_command_learns_a_known_error_and_says_so(streets: Path, tmp_path: Path) -> None:
    """A false factor on every channel is most of the error, and goes."""
    words = ["train", "relight", "--data", str(streets), "--out", str(tmp_path), "--device", "cpu"]
    cli.main([*words, "--steps", "32", "--crops", "1", "--validation", "2", "--licence", "test"])
    scores = json.loads((tmp_path / "scores.json").read_text())
    row = scores["low_sun"]
    assert row["network"]["psnr_db"] > row["physical"]["psnr_db"] + 3
    weights = tmp_path / "weights.safetensors"
    assert read_record(weights).streets == {"training": ["1"], "validation": ["2"]}
    assert network_of(read_weights(weights)).config.widths


def test_training_goes_on_from_weights_of_its_own_network_alone(
    streets: Path, tmp_path: Path
) -> None:
    words = ["train", "relight", "--data", str(streets), "--streets"]
    cli.main([*words, "1", "--steps", "3", "--out", str(tmp_path / "a")])
    first = tmp_path / "a" / "weights.safetensors"
    cli.main([*words, "2", "--steps", "1", "--out", str(tmp_path / "b"), "--start", str(first)])
    # What the first weights learned from, these have learned from.
    record = read_record(tmp_path / "b" / "weights.safetensors")
    assert record.streets == {"training": ["1", "2"], "validation": []}
    made, before = (read_weights(tmp_path / k / "weights.safetensors") for k in ("b", "a"))
    # One step of the warm-up moves little; random weights would be anywhere.
    name = "stem.1.weight"
    assert (made[name] - before[name]).abs().max() < 0.01 * before[name].abs().max()
    command = RelightTrainingOptions(
        data=streets, out=tmp_path / "c", streets=("1",), network="paper", start=first
    )
    with pytest.raises(InputError, match="another network"):
        train(command)
    # Before anything is trained.
    seen = replace(command, network="network", streets=("2",), validation=("1",))
    with pytest.raises(InputError, match="trained on validation streets"):
        train(seen)
    assert not list((tmp_path / "c").glob("*.safetensors"))


def test_training_goes_on_from_either_network_of_a_mean(streets: Path, tmp_path: Path) -> None:
    shipped = network_for(RelitNet, None)
    command = RelightTrainingOptions(
        data=streets,
        out=tmp_path,
        streets=("1",),
        steps=1,
        preset="full",
        crops=1,
        crop_px=32,
        start=WEIGHTS_FOLDER / "relight-network.safetensors",
    )
    train(command)
    full = network_for(RelitNet, tmp_path / "weights.safetensors")
    (partner,) = shipped.partners
    assert full.config == shipped.config.partners[0]
    before = partner.state_dict()["stem.1.weight"]
    moved = (full.state_dict()["stem.1.weight"] - before).abs().max()
    assert moved < 0.01 * before.abs().max()


def views_of(sample: RelightSample) -> Views:
    scene = {name: torch.from_numpy(value)[None] for name, value in sample.scene.items()}
    return Views(
        scene,
        {
            sky: {name: torch.from_numpy(value)[None] for name, value in target.planes.items()}
            for sky, target in sample.targets.items()
        },
    )


def test_rendered_pairs_show_the_twin_under_both_skies(
    streets: Path, rng: np.random.Generator
) -> None:
    sample = made_sample(rng)
    views = views_of(sample)
    real = rendered_pair(views, "low_sun", None)
    assert torch.equal(real.truth[0], torch.from_numpy(sample.scene["source"]))
    target = torch.from_numpy(sample.targets["low_sun"].planes["target_ratio"])[None]
    assert torch.equal(real.planes["source_ratio"], target)
    there = rendered_pair(views, None, "low_sun", is_real=False)
    back = rendered_pair(views, "low_sun", None, is_real=False)
    assert torch.equal(there.truth, back.planes["source"])
    assert torch.equal(there.planes["source"], back.truth)
    data = RelightData(
        [streets / "1"], RelightDataConfig(sim_real_fraction=0.5, sim_sim_fraction=0.5)
    )
    assert "target_physical" not in data.batch(0, 0).planes


def test_a_true_twin_leaves_nothing_to_mend(rng: np.random.Generator) -> None:
    """Estimate and picture agree, and so do both tales of which sun is seen."""
    sample = made_sample(rng)
    unknown = np.where(sample.scene["found"] < 0.5, -1, sample.scene["found"])
    sample = RelightSample({**sample.scene, "found": unknown}, sample.targets)
    one = with_exact_estimate(rendered_pair(views_of(sample), None, "low_sun", is_real=False))
    shown = srgb_of(one.planes["target_physical"]).clamp(0, 1)
    torch.testing.assert_close(shown, one.truth)
    is_known = torch.from_numpy(unknown >= 0)[None]
    assert torch.equal(one.planes["found"][is_known], one.planes["source_sun"][is_known])
    assert (one.planes["found"][~is_known] == -1).all()


def test_the_documented_commands_train_both_networks(streets: Path, tmp_path: Path) -> None:
    text = (Path(__file__).parents[3] / "docs" / "guides" / "training.md").read_text()
    lines = [line for line in text.splitlines() if line.startswith("lightsim train relight")]
    for line, kind in zip(lines, (RelitNet, PaperNet), strict=True):
        given = (
            line.replace("DATA", str(streets)).replace("RUNS", str(tmp_path)).replace("203", "2")
        )
        cli.main([*given.split()[1:], "--steps", "1", "--without", "identity", "shadow-maps"])
        weights = Path(given.split()[given.split().index("--out") + 1]) / "weights.safetensors"
        network = network_of(read_weights(weights))
        assert isinstance(network, kind)
        assert network.config.unseen == ("shadow-maps",)
        assert "--without identity shadow-maps" in read_record(weights).command
        if kind is PaperNet:
            # The paper's weights: appendix, "Learning details".
            terms = json.loads((weights.parent / "metrics.jsonl").read_text())
            total = terms["colour"] + 400 * terms["edges"] + terms["lpips"]
            assert terms["loss"] == pytest.approx(total, rel=1e-5)


def test_pairs_of_all_kinds_stand_in_one_batch(streets: Path, tmp_path: Path) -> None:
    """A quarter each, so that some batch of eight begins with each kind."""
    config = RelightDataConfig(
        identity_fraction=0.25,
        sim_real_fraction=0.25,
        sim_sim_fraction=0.25,
        true_twin_fraction=0.25,
    )
    data = RelightData([streets / "1"], config)
    for draw in range(8):
        batch = data.batch(draw, 0)
        assert len(batch.truth) == 8
        assert all(len(value) == 8 for value in batch.planes.values())
    words = ["train", "relight", "--data", str(streets), "--steps", "2"]
    cli.main([*words, "--out", str(tmp_path / "a"), "--without", "truth", "physical"])
    cli.main([*words, "--out", str(tmp_path / "b"), "--network", "paper"])
    command = RelightTrainingOptions(data=streets, out=tmp_path, without=("truth",))
    with pytest.raises(InputError, match="no physical estimate"):
        train(command)


def test_samples_without_truth_train_the_paper_and_are_refused_elsewhere(tmp_path: Path) -> None:
    sample = made_sample(np.random.default_rng(1))
    unknown = {k: RelightTargetSample(v.planes, None) for k, v in sample.targets.items()}
    (tmp_path / "002").mkdir()
    write_sample(tmp_path / "002" / "front_camera_00.npz", RelightSample(sample.scene, unknown))
    words = ["train", "relight", "--data", str(tmp_path), "--streets", "002", "--steps", "1"]
    with pytest.raises(InputError, match="no true pictures"):
        cli.main([*words, "--out", str(tmp_path / "ours"), "--verbose"])
    for name, more in (("paper", ()), ("without", ("--without", "identity"))):
        cli.main([*words, "--out", str(tmp_path / name), "--network", "paper", *more])
        record = read_record(tmp_path / name / "weights.safetensors")
        assert "logs 002, without truth" in record.training_data


def test_a_street_on_both_sides_is_refused(streets: Path, tmp_path: Path) -> None:
    both = RelightTrainingOptions(data=streets, out=tmp_path, streets=("1",), validation=("1",))
    missing = RelightTrainingOptions(data=streets, out=tmp_path, streets=("7",))
    for given in (both, missing):
        with pytest.raises(InputError, match="street"):
            train(given)
