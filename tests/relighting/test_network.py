"""The relighting network: what holds whatever its weights are."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tests.relighting.scene import everywhere_lit, sun_towards
from tests.relighting.test_ratio import make_inputs

from lightsim.core.dome import SkyDome, add_sun
from lightsim.core.frames import RigidTransform
from lightsim.errors import InputError
from lightsim.networks.stored import stored_tensors
from lightsim.relighting.methods import relight_by
from lightsim.relighting.network.channels import (
    BUFFERS,
    Planes,
    scene_planes,
    target_planes,
)
from lightsim.relighting.network.features import (
    Batch,
    downsampled,
    features,
    linear_of,
    srgb_of,
    tensors_of,
)
from lightsim.relighting.network.model import RelitNet, RelitNetConfig
from lightsim.relighting.network.paper_model import PaperNet, PaperNetConfig
from lightsim.relighting.network.relight import relit_by_network, relit_by_paper_network
from lightsim.relighting.network.stored import network_for, network_of, probe, tensors_of_network
from lightsim.relighting.network.tiles import predicted_in_tiles
from lightsim.relighting.physical.ratio import (
    CameraAndSkies,
    RatioConfig,
    RelightInputs,
    relight_physical,
)
from lightsim.simulation.options import RelightOptions
from lightsim.store.weights import (
    WEIGHTS_FOLDER,
    WeightsRecord,
    read_record,
    write_weights,
)
from lightsim_lab.training.relight_pairs import RelightBatch, exposed

SMALL = RelitNetConfig(widths=(8, 16), guide_count=2, working_columns=64)


def looking(azimuth_deg: float) -> RigidTransform:
    """A level camera (x right, y down, z forward) that looks along an azimuth from world x."""
    c, s = np.cos(np.radians(azimuth_deg)), np.sin(np.radians(azimuth_deg))
    rotation = np.array([[s, 0.0, c], [-c, 0.0, s], [0.0, -1.0, 0.0]])
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    return RigidTransform("world", "camera", matrix)


def sky_of(azimuth_deg: float) -> SkyDome:
    return add_sun(np.full((64, 128, 3), 0.3, np.float32), sun_towards(azimuth_deg, 30.0))


@pytest.fixture
def inputs(rng: np.random.Generator) -> RelightInputs:
    made = make_inputs(rng, everywhere_lit())
    gain = np.array([0.5, 0.6, 0.7], np.float32)
    camera_and_skies = CameraAndSkies(gain, looking(0.0), sky_of(150.0), sky_of(200.0))
    return replace(made, camera_and_skies=camera_and_skies)


def planes_of(inputs: RelightInputs) -> tuple[Planes, np.ndarray]:
    assert inputs.camera_and_skies is not None
    physical = relight_physical(inputs, RatioConfig())
    planes = scene_planes(inputs, inputs.camera_and_skies)
    return planes | target_planes(inputs, inputs.camera_and_skies, physical), physical


def random_network(seed: int = 0) -> RelitNet:
    """Weights that do something everywhere."""
    torch.manual_seed(seed)
    network = RelitNet(SMALL)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))
    return network.eval()


def test_an_untrained_network_is_physical_relighting(inputs: RelightInputs) -> None:
    made = relit_by_network(RelitNet(SMALL).eval(), inputs, RatioConfig()).radiance
    np.testing.assert_allclose(made, relight_physical(inputs, RatioConfig()), atol=1e-6)


def test_a_frame_under_its_own_sky_comes_back(inputs: RelightInputs) -> None:
    """However the weights were trained; and small changes of light are corrected little."""
    camera_and_skies = inputs.camera_and_skies
    assert camera_and_skies is not None
    source = camera_and_skies.source_sky
    same = replace(
        inputs, target=inputs.source, camera_and_skies=replace(camera_and_skies, target_sky=source)
    )
    planes, physical = planes_of(same)
    made = relit_by_network(random_network(), same, RatioConfig()).radiance
    np.testing.assert_allclose(made, physical, atol=1e-6)
    factor = {name: 1.3 for name in ("target_shaded", "target_reflected", "target_physical")}
    batch = tensors_of({name: factor.get(name, 1.0) * value for name, value in planes.items()})
    with torch.inference_mode():
        brighter = random_network()(batch).picture
    assert (brighter - batch["target_physical"]).abs().max() > 1e-3


def test_partners_pictures_are_averaged_and_stay_in_the_file(inputs: RelightInputs) -> None:
    first, second = random_network(0), random_network(1)
    joined = RelitNet(replace(SMALL, partners=(SMALL,))).eval()
    state = {f"partners.0.{name}": value for name, value in second.state_dict().items()}
    joined.load_state_dict(first.state_dict() | state)
    again = network_of(tensors_of_network(joined))
    assert isinstance(again, RelitNet)
    assert again.config == joined.config
    batch = tensors_of(planes_of(inputs)[0])
    with torch.inference_mode():
        one, other, mean = (network(batch) for network in (first, second, again))
    code = (srgb_of(one.picture) + srgb_of(other.picture)) / 2
    assert (one.picture - other.picture).abs().max() > 1e-3
    torch.testing.assert_close(srgb_of(mean.picture), code, atol=1e-5, rtol=1e-5)
    error = (one.log_error.exp() + other.log_error.exp()) / 2
    torch.testing.assert_close(mean.log_error.exp(), error)
    with torch.inference_mode():
        for apart, expected in zip(again.alone(), (one, other), strict=True):
            torch.testing.assert_close(apart.eval()(batch).picture, expected.picture)


def test_shipped_weights_meet_the_planes_that_they_were_trained_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Old weights under new inputs gave pictures, worse ones, and no test said so."""
    network = network_for(RelitNet, None)
    stored = read_record(WEIGHTS_FOLDER / "relight-network.safetensors").probe
    assert probe(network) == pytest.approx(stored, rel=1e-4)
    monkeypatch.setattr("lightsim.relighting.network.features._DARK", 0.03)
    assert probe(network) != pytest.approx(stored, rel=1e-3)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("method", ["network", "paper", "self-osr", "epe"])
def test_cuda_gives_the_picture_of_the_cpu(
    inputs: RelightInputs, method: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = relight_by(method)(inputs, RatioConfig()).radiance
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    expected = relight_by(method)(inputs, RatioConfig()).radiance
    # Convolutions on CUDA round their inputs to TF32.
    np.testing.assert_allclose(found, expected, rtol=5e-3, atol=5e-3 * float(expected.mean()))


def test_the_sky_stays_to_the_bit(inputs: RelightInputs) -> None:
    made = relit_by_network(random_network(), inputs, RatioConfig()).radiance
    physical = planes_of(inputs)[1]
    is_sky = inputs.sky_matte >= 1
    assert np.array_equal(made[is_sky], physical[is_sky])
    assert np.abs(made - physical)[~is_sky].max() > 1e-3


@pytest.mark.parametrize("factor", [0.25, 1.5])
def test_a_darker_or_brighter_exposure_is_corrected_alike(
    inputs: RelightInputs, factor: float
) -> None:
    """A network that saw absolute brightness mended what was brighter than the streets that it had
    learned from."""
    batch = tensors_of(planes_of(inputs)[0])
    batch["source"] = batch["source"].clamp(0, 0.7)
    one = RelightBatch(batch, batch["source"], batch["surface"])
    network = random_network()
    with torch.inference_mode():
        made = network(batch)
        other = network(exposed(one, factor).planes)
    torch.testing.assert_close(other.picture, factor * made.picture, atol=1e-5, rtol=1e-4)
    is_bounded = (made.log_error > -5.9) & (made.log_error < -0.5)
    assert is_bounded.any()
    more = other.log_error[is_bounded] - made.log_error[is_bounded]
    torch.testing.assert_close(more, torch.full_like(more, np.log(factor) / 2.4), atol=1e-4, rtol=0)


def test_the_unit_of_the_scene_does_not_matter(inputs: RelightInputs) -> None:
    """Twice the radiance and half the gain are the same picture."""
    camera_and_skies = inputs.camera_and_skies
    assert camera_and_skies is not None

    def doubled(light):
        names = ("direct_sun", "sky", "bounce", "shaded", "unshadowed")
        return replace(light, **{name: 2 * getattr(light, name) for name in names})

    twice = replace(
        inputs,
        radiance=2 * inputs.radiance,
        source=doubled(inputs.source),
        target=doubled(inputs.target),
        target_sky=2 * inputs.target_sky,
        camera_and_skies=replace(
            camera_and_skies,
            gain=camera_and_skies.gain / 2,
            source_sky=camera_and_skies.source_sky.scaled(2.0),
            target_sky=camera_and_skies.target_sky.scaled(2.0),
        ),
    )
    one, other = planes_of(inputs)[0], planes_of(twice)[0]
    for name in one:
        if not name.endswith("physical"):
            np.testing.assert_allclose(other[name], one[name], atol=2e-3, err_msg=name)


def test_turning_world_camera_and_skies_together_changes_nothing(inputs: RelightInputs) -> None:
    camera_and_skies = inputs.camera_and_skies
    assert camera_and_skies is not None
    turn = looking(90.0).rotation @ looking(0.0).rotation.T
    turned = replace(
        inputs,
        buffers=replace(
            inputs.buffers,
            normal_world=(inputs.buffers.normal_world @ turn.T).astype(np.float32),
            position_world=(inputs.buffers.position_world @ turn.T).astype(np.float32),
        ),
        camera_and_skies=replace(
            camera_and_skies,
            world_from_camera=looking(90.0),
            source_sky=camera_and_skies.source_sky.rotated(90.0),
            target_sky=camera_and_skies.target_sky.rotated(90.0),
        ),
    )
    assert turned.camera_and_skies is not None
    one = scene_planes(inputs, camera_and_skies)
    other = scene_planes(turned, turned.camera_and_skies)
    for name in one:
        np.testing.assert_allclose(other[name], one[name], atol=1e-5, err_msg=name)


def test_the_sun_stands_where_the_camera_sees_it(inputs: RelightInputs) -> None:
    """Looking along world x, a sun at azimuth 150 lies behind and to the left."""
    dome = planes_of(inputs)[0]["source_dome"].sum(0)
    column = np.unravel_index(dome.argmax(), dome.shape)[1]
    assert abs(column - (0.5 - 150.0 / 360.0) * dome.shape[1]) <= 1


def test_the_size_of_the_picture_changes_little(inputs: RelightInputs) -> None:
    """A picture four times as large, shrunk to the working size, is corrected alike."""
    planes = planes_of(inputs)[0]
    large = {
        name: value if name.endswith("_dome") else value.repeat(2, 1).repeat(2, 2)
        for name, value in planes.items()
    }
    network = random_network()
    with torch.inference_mode():
        batches = tensors_of(planes), tensors_of(large)
        working, again = (downsampled(batch, 64) for batch in batches)
        small, other = (
            network(b, w).picture for b, w in zip(batches, (working, again), strict=True)
        )
    for name, value in working.items():
        torch.testing.assert_close(again[name], value, atol=1e-5, rtol=1e-5)
    assert other.shape[-2:] == tuple(2 * n for n in small.shape[-2:])
    shrunken = torch.nn.functional.avg_pool2d(other, 2)
    assert (shrunken - small).abs().mean() < 0.02 * small.mean()


def test_weights_come_back_from_their_file_form(inputs: RelightInputs) -> None:
    batch = tensors_of(planes_of(inputs)[0])
    paper = PaperNet(PaperNetConfig(widths=(8, 16), latent=16, sky_latent=8)).eval()
    with torch.inference_mode():
        again, network = network_of(tensors_of_network(random_network())), random_network()
        torch.testing.assert_close(again(batch).picture, network(batch).picture)
        torch.testing.assert_close(network_of(tensors_of_network(paper))(batch), paper(batch))
    with pytest.raises(InputError, match="another network"):
        network_of(stored_tensors(network, SMALL, "sky"))


def test_the_papers_network_sees_what_the_paper_names(inputs: RelightInputs) -> None:
    """Picture, buffers, shadow ratios and domes, and nothing else."""
    network = PaperNet(PaperNetConfig(widths=(8, 16), latent=16, sky_latent=8)).eval()
    batch = tensors_of(planes_of(inputs)[0])
    seen = {"source", "source_ratio", "target_ratio", "source_dome", "target_dome", *BUFFERS}
    with torch.inference_mode():
        picture = network(batch)
        for name, value in batch.items():
            changed = network({**batch, name: value + 0.5})
            assert torch.equal(changed, picture) == (name not in seen), name
    made = relit_by_paper_network(network, inputs, RatioConfig()).radiance
    assert inputs.camera_and_skies is not None
    white = 1 / inputs.camera_and_skies.gain
    assert made.shape == inputs.radiance.shape
    assert (made >= 0).all()
    assert (made <= white * 1.001).all()


def test_what_an_ablation_leaves_out_is_not_seen(inputs: RelightInputs) -> None:
    batch = tensors_of(planes_of(inputs)[0])
    for part, hidden in (("buffers", "normal"), ("shadow-maps", "target_sun")):
        network = random_network()
        network.config = replace(SMALL, unseen=(part,))
        with torch.inference_mode():
            one = network(batch).picture
            other = network({**batch, hidden: batch[hidden] + 0.5}).picture
        assert torch.equal(one, other)


def test_codes_are_inverse_and_features_are_finite(inputs: RelightInputs) -> None:
    linear = torch.linspace(0, 1, 1001)
    torch.testing.assert_close(linear_of(srgb_of(linear)), linear, atol=1e-6, rtol=1e-5)
    seen = features(tensors_of(planes_of(inputs)[0]), torch.ones(1, 1, 1, 1))
    assert bool(torch.isfinite(seen).all())
    assert seen.abs().max() < 10


def test_without_camera_and_skies_it_is_refused(inputs: RelightInputs) -> None:
    with pytest.raises(InputError, match="camera and skies"):
        relit_by_network(random_network(), replace(inputs, camera_and_skies=None), RatioConfig())


def test_a_method_takes_the_weights_of_its_own_network_alone(tmp_path: Path) -> None:
    paper = PaperNet(PaperNetConfig(widths=(8, 16), latent=16, sky_latent=8))
    record = WeightsRecord("a", "b", "c", "d", 0, 1, {}, "e", "f")
    files = {}
    for method, network in (("network", random_network()), ("paper", paper)):
        files[method] = tmp_path / f"{method}.safetensors"
        write_weights(files[method], tensors_of_network(network), record)
    for method in ("network", "paper"):
        assert relight_by(method, files[method])
        other = next(file for name, file in files.items() if name != method)
        with pytest.raises(InputError, match="another network"):
            relight_by(method, other)
    with pytest.raises(InputError, match="has no weights"):
        RelightOptions(name="x", method="physical", weights=files["paper"])


def test_the_shipped_network_corrects_and_keeps_the_sky(inputs: RelightInputs) -> None:
    found = relight_by("network")(inputs, RatioConfig())
    made = found.radiance
    physical = relight_physical(inputs, RatioConfig())
    is_sky = inputs.sky_matte >= 1
    assert np.array_equal(made[is_sky], physical[is_sky])
    # Mean error of the logarithm. The scene is what the physical method assumes; streets are not.
    wanted = inputs.buffers.base_colour * inputs.target.shaded
    error = np.abs(np.log(made[~is_sky] / wanted[~is_sky])).mean()
    assert error < 0.085
    assert not np.array_equal(made, physical)
    assert found.expected_error is not None
    assert found.expected_error.shape == is_sky.shape
    assert 0 < found.expected_error.min() < found.expected_error.max() <= 1


class _Local(torch.nn.Module):
    """A network whose picture depends on each pixel alone, and on the domes."""

    def forward(self, batch: Batch) -> torch.Tensor:
        assert batch["source"].shape[-2:] == (16, 16)
        return 0.5 * batch["source"] + batch["target_dome"].mean(dim=(1, 2, 3), keepdim=True)


@pytest.mark.parametrize("size", [(16, 16), (16, 40), (33, 47)])
def test_tiles_of_a_local_network_make_the_whole_picture(size: tuple[int, int]) -> None:
    rng = torch.Generator().manual_seed(0)
    batch = {
        "source": torch.rand(1, 3, *size, generator=rng),
        "target_dome": torch.rand(1, 3, 32, 64, generator=rng),
    }
    expected = 0.5 * batch["source"] + batch["target_dome"].mean()
    torch.testing.assert_close(predicted_in_tiles(_Local(), batch, 16), expected)
