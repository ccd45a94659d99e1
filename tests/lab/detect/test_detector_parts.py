"""Targets, lifts, trunk and model of the detector against closed forms."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from lightsim.errors import InputError
from lightsim_lab.detect.config import DetectorConfig, config_of
from lightsim_lab.detect.lift import BilinearLift, DeformableAttention, Pillars
from lightsim_lab.detect.model import Detector
from lightsim_lab.detect.targets import HEAT, MAPS, decode, encode, loss_of
from lightsim_lab.detect.trunk import Trunk, find_trunk_weights, load_trunk, offset_px

CONFIG = config_of("small")
NONE = np.zeros((0, 7))
# Camera of 480 x 272 pixels that looks along x of the level frame.
PROJECTION = np.array([[240.0, -400, 0, 0], [130, 0, -400, 0], [1, 0, 0, 0]])


def as_output(maps: np.ndarray) -> np.ndarray:
    """Return target maps as a head that is certain of them would."""
    sure = np.where(maps[HEAT] == 1, 9.0, -9.0)
    return np.concatenate([sure[None], np.nan_to_num(maps[1:])])


def test_decoding_returns_the_encoded_boxes(rng: np.random.Generator) -> None:
    places = [(12.3, -7.9), (33.0, 14.99), (79.6, 39.2), (0.4, -39.6)]
    boxes = np.array([
        [*place, *rng.uniform(-1, 0, 1), *rng.uniform(1.5, 12, 3), rng.uniform(-np.pi, np.pi)]
        for place in places
    ])  # fmt: skip
    found, scores = decode(as_output(encode(boxes, NONE, CONFIG)), CONFIG)
    assert len(found) == 4
    assert (scores > 0.99).all()
    order = [int(np.argmin(np.hypot(*(found - box)[:, :2].T))) for box in boxes]
    assert found[order] == pytest.approx(boxes, abs=1e-4)


def test_boxes_outside_are_left_out_and_the_nearer_of_a_cell_stays() -> None:
    near, far = [20.1, 0.2, 0, 4, 2, 1.5, 0.0], [20.9, 0.9, 0, 4, 2, 1.5, 1.0]
    outside = [81.0, 0, 0, 4, 2, 1.5, 0]
    found, _ = decode(as_output(encode(np.array([far, near, outside]), NONE, CONFIG)), CONFIG)
    assert found == pytest.approx(np.array([near]), abs=1e-5)


def test_repeated_detections_are_removed() -> None:
    boxes = np.array([[20.5, 0.5, 0, 4, 2, 1.5, 0.0], [23.5, 0.5, 0, 4, 2, 1.5, 0.0]])
    maps = as_output(encode(boxes, NONE, CONFIG))
    assert len(decode(maps, CONFIG)[0]) == 2
    # A box of twice the length overlaps both centres.
    boxes[:, 3] = 9
    found, _ = decode(as_output(encode(boxes, NONE, CONFIG)), CONFIG)
    assert len(found) == 1


def test_all_vehicles_of_a_crowded_picture_are_detected() -> None:
    boxes = np.array([
        [x, y, 0, 4, 2, 1.5, 0.0] for x in (10.5, 20.5, 30.5, 40.5) for y in np.arange(-19.5, 20, 4)
    ])  # fmt: skip
    assert len(decode(as_output(encode(boxes, NONE, CONFIG)), CONFIG)[0]) == len(boxes) == 40


def test_ignored_boxes_are_no_negatives() -> None:
    box = np.array([[20.5, 0.5, 0, 4, 2, 1.5, 0.0]])
    target = torch.from_numpy(encode(NONE, box, CONFIG))[None]
    output = torch.zeros(1, MAPS, 80, 80)
    output[:, HEAT] = -9.0
    before = sum(loss_of(output, target))
    # Cells within 1 m of the box: 17.5 to 23.5 m ahead, -1.5 to 2.5 m to the left.
    output[0, HEAT, 18:23, 39:42] = 9.0
    assert sum(loss_of(output, target)) == before
    output[0, HEAT, 30, 40] = 9.0
    assert sum(loss_of(output, target)) > before + 1
    # A box that has to be detected counts on an ignored one.
    both = encode(box, box, CONFIG)
    assert both[HEAT, 20, 40] == 1
    assert np.isnan(both[HEAT]).any()


def test_the_loss_of_certain_and_right_maps_is_small() -> None:
    box = np.array([[20.5, 0.5, 0, 4, 2, 1.5, 0.3]])
    target = torch.from_numpy(encode(box, NONE, CONFIG))[None]
    right = torch.from_numpy(as_output(target[0].numpy())).float()[None]
    assert sum(loss_of(right, target)) < 0.01
    wrong = right.clone()
    wrong[:, 1] += 2.0
    assert loss_of(wrong, target)[1] == pytest.approx(0.25 * 2.0)


def test_lifted_features_are_those_of_the_pinhole_projection() -> None:
    lift, (w, h) = BilinearLift(CONFIG), CONFIG.picture_px
    # Features with the pixel coordinates of their own centres.
    u = torch.arange(w // 8) * 8.0 + 4 + offset_px(8)
    v = torch.arange(h // 8) * 8.0 + 4 + offset_px(8)
    features = torch.stack([u.expand(h // 8, -1), v[:, None].expand(-1, w // 8)])
    features = features.expand(1, len(CONFIG.heights_m), -1, -1, -1)
    # Mixed precision must not round the projections.
    with torch.autocast("cpu", torch.bfloat16):
        sampled = lift.sampled(features, torch.tensor(PROJECTION).float()[None])[0]
    count = 0
    for i, j, z in ((20, 40, 0), (10, 36, 1), (60, 70, 2), (30, 12, 3), (5, 41, 2)):
        x, y = i + 0.5, j + 0.5 - 40
        expected = (240 - 400 * y / x, 130 - 400 * CONFIG.heights_m[z] / x)
        if 8 <= expected[0] < w - 8 and 8 <= expected[1] < h - 8:
            count += 1
            assert sampled[z, :, i, j].tolist() == pytest.approx(expected, abs=1e-2)
    assert count >= 4


def test_cells_outside_the_picture_have_no_features() -> None:
    pillars = Pillars(CONFIG)
    _, is_shown = pillars(torch.tensor(PROJECTION).float()[None])
    assert is_shown.any()
    # At 10 m ahead the picture shows 6 m to either side.
    assert is_shown[0, 10 * 80 + 45].any()
    assert not is_shown[0, 10 * 80 + 48].any()
    # A camera that looks back sees nothing ahead.
    back = torch.tensor(PROJECTION * [[-1, -1, 1, 1]]).float()[None]
    assert not pillars(back)[1].any()


def test_attention_samples_its_references() -> None:
    attention = DeformableAttention(4, 1, 2, 4)
    with torch.no_grad():
        for layer in (attention._value, attention._out):
            layer.weight.copy_(torch.eye(4))
            layer.bias.zero_()
        attention._offset.bias.zero_()
        attention._weight.bias.zero_()
    level = torch.arange(4 * 3 * 5).reshape(1, 4, 3, 5).float()
    # Centres of column 1 in row 0, and of column 3 in row 2, in [-1, 1].
    references = torch.tensor([[[[-0.4, -2 / 3], [0.4, 2 / 3]]]])
    is_valid = torch.tensor([[[True, True]]])
    found = attention(torch.zeros(1, 1, 4), [references], is_valid, [level])
    expected = (level[0, :, 0, 1] + level[0, :, 2, 3]) / 2
    assert found[0, 0].tolist() == pytest.approx(expected.tolist(), rel=1e-4)
    # References outside the picture add nothing.
    half = attention(
        torch.zeros(1, 1, 4), [references], is_valid & torch.tensor([True, False]), [level]
    )
    assert half[0, 0].tolist() == pytest.approx((level[0, :, 0, 1] / 2).tolist(), rel=1e-4)


@pytest.mark.parametrize("stride", [8, 16])
def test_features_are_displaced_by_the_padding(stride: int) -> None:
    trunk = Trunk().double()
    with torch.no_grad():
        for parameter in trunk.parameters():
            if parameter.ndim == 4:
                # Equal positive weights: the gradient's centroid is the centre of the field.
                parameter.fill_(0.5 / parameter[0].numel())
    pictures = torch.full((1, 3, 512, 448), 128.0, dtype=torch.float64, requires_grad=True)
    fine = trunk.fine(pictures)
    features = fine if stride == 8 else trunk.coarse(fine)
    i, j = features.shape[-2] // 2, features.shape[-1] // 2
    features[0, 0, i, j].backward()
    assert pictures.grad is not None
    weight = pictures.grad[0].sum(0)
    for axis, cell in ((0, i), (1, j)):
        line = weight.sum(1 - axis)
        centre = float((line * (torch.arange(len(line)) + 0.5)).sum() / line.sum())
        assert centre == pytest.approx((cell + 0.5) * stride + offset_px(stride), abs=1e-6)


def test_the_trunk_keeps_its_statistics_and_rejects_other_files(tmp_path: Path) -> None:
    trunk = Trunk()
    assert not any(m.training for m in trunk.train().modules() if m is not trunk)
    with pytest.raises(InputError, match=r"missing\.pth"):
        load_trunk(trunk, tmp_path / "missing.pth")
    other = tmp_path / "other.pth"
    torch.save({"a": torch.zeros(1)}, other)
    with pytest.raises(InputError, match="efficientnet-lite0-57934424"):
        load_trunk(trunk, other)
    torch.save({**trunk.state_dict(), "_fc.weight": torch.zeros(1)}, other)
    load_trunk(trunk, other)
    assert find_trunk_weights(other) == other


def step(config: DetectorConfig) -> Detector:
    network = Detector(config, Trunk())
    w, h = config.picture_px
    pictures = torch.randint(0, 255, (2, 3, h, w), dtype=torch.uint8)
    projections = torch.tensor(PROJECTION).float().expand(2, 3, 4)
    box = np.array([[20.5, 0.5, 0, 4, 2, 1.5, 0.3]])
    target = torch.from_numpy(np.stack([encode(box, NONE, config)] * 2))
    maps = network(network.prepared(pictures), projections)
    assert maps.shape == (2, MAPS, config.cells, config.cells)
    focal, values = loss_of(maps, target)
    (focal + values).backward()
    return network


def test_the_detector_of_the_paper_runs_and_learns_everywhere() -> None:
    config = replace(config_of("paper"), picture_px=(64, 48), cells=10)
    assert (config.attention_layers, config.heads, config.points) == (3, 8, 8)
    network = step(config)
    idle = [name for name, p in network.named_parameters() if p.grad is None]
    assert not idle


def test_a_frozen_trunk_gets_no_gradient_and_is_not_optimised() -> None:
    network = step(replace(config_of("test"), picture_px=(64, 48)))
    own = {id(p) for p in network.trunk.parameters()}
    assert all((p.grad is None) == (id(p) in own) for p in network.parameters())
    assert [group["lr"] for group in network.groups()] == [1e-3]
    free = step(replace(config_of("test"), picture_px=(64, 48), is_trunk_frozen=False))
    assert [group["lr"] for group in free.groups()] == [1e-3, 2e-4]


def test_the_prepared_features_of_a_frozen_trunk_are_those_that_a_free_one_computes() -> None:
    config = replace(config_of("test"), picture_px=(480, 272))
    frozen, free = (Detector(replace(config, is_trunk_frozen=k), Trunk()) for k in (True, False))
    free.load_state_dict(frozen.state_dict())
    pictures = torch.randint(0, 255, (2, 3, 272, 480), dtype=torch.uint8)
    projections = torch.tensor(PROJECTION).float().expand(2, 3, 4)
    maps = [network(network.prepared(pictures), projections) for network in (frozen, free)]
    # Features are kept in half precision.
    assert torch.allclose(*maps, atol=1e-2)
    assert not torch.equal(maps[0][0], maps[0][1])
