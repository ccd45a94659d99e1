"""Pictures, mirror images and training of the detector on made pictures."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from lightsim.networks.loop import LoopConfig, Session
from lightsim.progress import SilentProgress
from lightsim.store.checkpoint import FolderCheckpointer
from lightsim.store.images import write_png
from lightsim_lab.detect.boxes import match
from lightsim_lab.detect.config import DetectorConfig, config_of
from lightsim_lab.detect.pictures import (
    Picture,
    Sample,
    distort,
    jitter_exposure,
    prepared_samples,
    treated,
)
from lightsim_lab.detect.train import detect, make_detector, seconds_per_step, train_detector

QUIET = SilentProgress()


def tiny_config(steps: int) -> DetectorConfig:
    loop = LoopConfig(steps, warm_up_steps=5, largest_gradient=35.0)
    return replace(
        config_of("test"), picture_px=(160, 96), reach_m=24.0, cells=24, channels=16, rate=4e-3,
        loop=loop,
    )  # fmt: skip


def samples(pictures: list[Picture], folder: Path, config: DetectorConfig) -> list[Sample]:
    network = make_detector(config, 0, None, "cpu")
    return prepared_samples("street", pictures, folder / "inputs.npz", network, QUIET)


def session(folder: Path, minutes: float | None = None) -> Session:
    folder.mkdir(exist_ok=True)
    return Session(FolderCheckpointer(folder), QUIET, minutes, "cpu")


def test_a_detector_learns_two_pictures(pictures: list[Picture], tmp_path: Path) -> None:
    config = tiny_config(100)
    made = samples(pictures, tmp_path, config)
    network = make_detector(config, 1, None, "cpu")
    assert train_detector(network, (made, made), 3, session(tmp_path / "run"), "") == 100
    found = detect(network, made, QUIET)
    for one, sample in zip(found, made, strict=True):
        matches = match(one, sample.view.boxes, sample.view.ignored)
        assert matches.is_true[0, :2].all()
        assert matches.scores[0] > 0.4


def test_an_interrupted_training_continues_as_if_it_had_not_been(
    pictures: list[Picture], tmp_path: Path
) -> None:
    config = tiny_config(4)
    made = samples(pictures, tmp_path, config)

    def trained(folder: str, minutes: float | None = None) -> tuple[torch.nn.Module, int]:
        network = make_detector(config, 1, None, "cpu")
        run = session(tmp_path / folder, minutes)
        return network, train_detector(network, (made, made), 3, run, "")

    whole, _ = trained("whole")
    assert trained("parts", 0.0)[1] == 1
    parts, steps = trained("parts")
    assert steps == 4
    for one, other in zip(whole.parameters(), parts.parameters(), strict=True):
        assert torch.equal(one, other)


def test_random_weights_of_the_trunk_do_not_depend_on_the_seed() -> None:
    one, other = (make_detector(tiny_config(1), seed, None, "cpu") for seed in (0, 1))
    equal = [torch.equal(a, b) for a, b in zip(one.parameters(), other.parameters(), strict=True)]
    trunk = len(list(one.trunk.parameters()))
    assert all(equal[:trunk])
    assert not all(equal[trunk:])


def test_a_step_takes_time(pictures: list[Picture], tmp_path: Path) -> None:
    config = tiny_config(1)
    made = samples(pictures, tmp_path, config)
    assert 0 < seconds_per_step(make_detector(config, 0, None, "cpu"), made) < 10


def test_a_mirror_image_shows_the_mirrored_boxes(pictures: list[Picture], tmp_path: Path) -> None:
    (sample, _) = samples(pictures, tmp_path, tiny_config(1))
    mirrored = sample.mirrored

    def place(one: Sample) -> np.ndarray:
        u, v, w = one.view.projection @ [*one.view.boxes[0, :3], 1.0]
        return np.array([u / w, v / w])

    u, v = place(sample)
    assert place(mirrored) == pytest.approx([160 - u, v])
    assert mirrored.view.boxes[0, [1, 6]].tolist() == [-1.2, -0.2]
    assert np.array_equal(mirrored.inputs[0], sample.inputs[1])
    assert mirrored.mirrored.view.projection == pytest.approx(sample.view.projection)


def test_inputs_are_made_once(
    pictures: list[Picture], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = samples(pictures, tmp_path, tiny_config(1))
    monkeypatch.setattr(Picture, "read", None)
    again = samples(pictures, tmp_path, tiny_config(1))
    assert all(np.array_equal(a.inputs, b.inputs) for a, b in zip(first, again, strict=True))


def test_inputs_of_other_pictures_are_not_reused(pictures: list[Picture], tmp_path: Path) -> None:
    config = tiny_config(1)
    first = samples(pictures, tmp_path, config)
    # Relit again, to another light: the name is the same.
    write_png(pictures[1].path, np.full((96, 160, 3), 20, np.uint8))
    again = samples(pictures, tmp_path, config)
    assert np.array_equal(first[0].inputs, again[0].inputs)
    assert not np.array_equal(first[1].inputs, again[1].inputs)
    # Of an interrupted preparation, fewer pictures existed.
    assert len(samples(pictures[:1], tmp_path, config)) == 1


def test_pictures_are_scaled_with_their_projection(pictures: list[Picture], tmp_path: Path) -> None:
    config = replace(tiny_config(1), picture_px=(80, 64))
    (sample, _) = samples(pictures, tmp_path, config)
    # Half the width: 48 rows, and 16 black ones below.
    assert sample.view.projection[:2] == pytest.approx(pictures[0].view.projection[:2] / 2)
    read = pictures[0].read((80, 64))
    assert read.shape == (3, 64, 80)
    assert not read[:, 48:].any()
    assert read[:, :48].mean() > 50


def test_all_pictures_get_noise_and_compression(rng: np.random.Generator) -> None:
    smooth = np.full((90, 160, 3), 0.5, np.float32)
    found = treated(smooth, (160, 96), rng).astype(float)[:, :90]
    assert found.mean() == pytest.approx(127.5, abs=0.5)
    # The compression keeps a part of the noise of 3 codes; colours are at half resolution.
    assert 0.8 < found.std() < 3.0


def test_changes_of_colours_keep_the_scene(rng: np.random.Generator) -> None:
    picture = rng.uniform(0.2, 0.6, (40, 60, 3)).astype(np.float32)
    means = np.array([distort(picture, rng).mean(axis=(0, 1)) for _ in range(40)])
    assert means.std(axis=0).min() > 0.03
    exposed = np.array([jitter_exposure(picture, rng).mean(axis=(0, 1)) for _ in range(40)])
    assert exposed.std(axis=0).min() > 0.03
    ratio = exposed[:, 0] / exposed[:, 1]
    assert ratio.std() > 0.02
    # Exposure keeps the order of brightness.
    changed = jitter_exposure(picture, rng)
    assert (np.argsort(changed[..., 0].ravel()) == np.argsort(picture[..., 0].ravel())).all()


def test_vehicles_outside_the_region_of_interest_are_ignored(
    pictures: list[Picture], tmp_path: Path
) -> None:
    # 24 m ahead and 12 m to either side; the detector cannot find the others.
    places = [(9.3, 1.2), (23.9, -11.9), (24.1, 0.0), (9.3, 12.1), (9.3, -12.1), (-0.1, 2.7)]
    boxes = np.array([[x, y, -0.9, 4.4, 1.9, 1.4, 0.2] for x, y in places])
    hidden = boxes[:1] + [5.0, 0, 0, 0, 0, 0, 0]
    view = replace(pictures[0].view, boxes=boxes, ignored=hidden)
    (sample,) = samples([replace(pictures[0], view=view)], tmp_path, tiny_config(1))
    assert np.array_equal(sample.view.boxes, boxes[:2])
    assert np.array_equal(sample.view.ignored, np.concatenate([hidden, boxes[2:]]))
    assert len(view.boxes) == 6
