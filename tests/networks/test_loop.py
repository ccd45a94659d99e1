"""The training loop: exact resume for all who use it, schedule, averages, several processes."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
import two_processes
from tests.lighting.fake_skies import FakeSkies
from tests.reconstruct.wall import small_config, small_field, wall_fields, wall_pool
from torch import Tensor, nn

from journals import MemoryJournal
from lightsim.errors import ArtefactError
from lightsim.lighting.sky.network import SkyNetwork, SkyNetworkConfig
from lightsim.networks import loop
from lightsim.networks.loop import Checkpointer, Learner, LoopConfig, Loss, Session, run_training
from lightsim.progress import Progress, SilentProgress
from lightsim.reconstruct.field.train import TrainingRays, train_field
from lightsim.store.checkpoint import FolderCheckpointer
from lightsim_lab.training.inpaint import InpaintConfig, train_inpaint
from lightsim_lab.training.sky import SkyRecipe, SkyTrainConfig, train_sky
from lightsim_lab.training.sky_losses import sky_loss

Weights = dict[str, Tensor]
Train = Callable[[Checkpointer, Progress, int], Weights]
"""(journal, progress, threads that draw batches) -> weights after `STEPS` steps."""
STEPS = 6


def field(checkpointer: Checkpointer, progress: Progress, workers: int) -> Weights:
    rays = TrainingRays(wall_pool(500, False), wall_pool(500, True))
    trained = small_field(small_config(steps=STEPS), wall_fields(0.0))
    train_field(trained, rays, 7, Session(checkpointer, progress))
    return trained.state_dict()


def inpaint(checkpointer: Checkpointer, progress: Progress, workers: int) -> Weights:
    config = InpaintConfig(
        LoopConfig(STEPS), batch=2, width=2, dilations=(1, 2), discriminator_width=2,
        discriminator_layers=2, adversarial_from=0.3, adversarial_weight=0.1, workers=workers,
    )  # fmt: skip
    return train_inpaint(FakeSkies(), config, Session(checkpointer, progress, device="cpu"))[0]


def sky(checkpointer: Checkpointer, progress: Progress, workers: int) -> Weights:
    config = SkyNetworkConfig(widths=(8, 8, 16), decoder_widths=(8, 8, 16), height_px=32)
    how = SkyTrainConfig(LoopConfig(STEPS), batch=2, workers=workers)
    recipe = SkyRecipe(SkyNetwork(config), sky_loss, how, 32)
    train_sky(recipe, FakeSkies(), Session(checkpointer, progress, device="cpu"))
    return recipe.network.state_dict()


class Interrupting:
    """Progress that interrupts before a given step."""

    def __init__(self, step: int) -> None:
        self._step = step

    def track(self, items: Any, description: str, total: int | None = None) -> Iterator[Any]:
        for item in items:
            if item == self._step:
                raise KeyboardInterrupt
            yield item


@pytest.mark.parametrize("train", [field, inpaint, sky])
def test_an_interrupted_training_that_goes_on_is_the_uninterrupted_one(
    train: Train, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(loop, "_SAVE_EVERY_S", 0.0)
    journals = [FolderCheckpointer(tmp_path / name) for name in ("whole", "parts")]
    for name in ("whole", "parts"):
        (tmp_path / name).mkdir()
    whole = train(journals[0], SilentProgress(), 0)
    for step in (2, 4):
        with pytest.raises(KeyboardInterrupt):
            train(journals[1], Interrupting(step), 0)
    # Threads that draw batches ahead change nothing.
    parts = train(journals[1], SilentProgress(), 2)
    for name, value in whole.items():
        assert torch.equal(value, parts[name]), name
    lines = (tmp_path / "parts" / "metrics.jsonl").read_text().splitlines()
    assert [json.loads(line)["step"] for line in lines] == [0, STEPS - 1]


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("is_mixed", [False, True], ids=["single precision", "bf16"])
def test_cuda_learns_what_the_cpu_learns(is_mixed: bool) -> None:
    """Losses of the same steps; networks train on with what they made of the steps before."""
    config = SkyNetworkConfig(widths=(8, 8, 16), decoder_widths=(8, 8, 16), height_px=32)
    losses = {}
    for device in ("cpu", "cuda"):
        how = SkyTrainConfig(LoopConfig(STEPS, mixed_precision=is_mixed), batch=4)
        recipe = SkyRecipe(SkyNetwork(config), sky_loss, how, 32)
        journal = MemoryJournal()
        train_sky(recipe, FakeSkies(), Session(journal, SilentProgress(), device=device))
        losses[device] = [line["loss"] for line in journal.lines]
    assert losses["cuda"] == pytest.approx(losses["cpu"], rel=5e-2 if is_mixed else 5e-3)


def test_two_processes_learn_from_a_batch_twice_as_large(tmp_path: Path) -> None:
    """Also when they stop after a step and go on; only the first of them writes."""
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
    two_processes.train(tmp_path / "one")
    torchrun = ("-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2")
    script = (two_processes.__file__, str(tmp_path / "two"))
    done = subprocess.run([sys.executable, *torchrun, *script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    one, two = (torch.load(tmp_path / name / "final.pt") for name in ("one", "two"))
    assert one["done"] == two["done"] == 30
    # Equal but for the order in which the points' gradients are summed.
    for network in ("a", "b"):
        torch.testing.assert_close(one[network], two[network], rtol=2e-5, atol=2e-6)
    lines = (tmp_path / "two" / "metrics.jsonl").read_text().splitlines()
    assert [json.loads(line)["step"] for line in lines] == [0, 25, 29]


class Recording(torch.optim.SGD):
    """Keeps the learning rates and the norms of the gradients it was given."""

    def __init__(self, *groups: dict[str, Any]) -> None:
        super().__init__(list(groups))
        self.seen: list[tuple[list[float], float]] = []

    def step(self, closure: None = None) -> None:  # type: ignore[override]
        gradients = [p.grad for group in self.param_groups for p in group["params"]]
        norm = torch.stack([g.square().sum() for g in gradients if g is not None]).sum().sqrt()
        self.seen.append(([group["lr"] for group in self.param_groups], float(norm)))


def run(
    layer: nn.Module, optimiser: Any, config: LoopConfig, checkpointer: MemoryJournal | None = None
) -> None:
    def losses(step: int, draw: int) -> Iterator[Loss]:
        yield "layer", 100 * layer(torch.ones(1, 2)).sum(), {}

    learner = Learner(layer, (optimiser,), is_averaged=True)
    run_training({"layer": learner}, losses, config, (checkpointer or MemoryJournal()).session())


def test_rates_warm_up_and_fall_by_a_cosine_and_gradients_are_clipped() -> None:
    layer = nn.Linear(2, 1)
    before = {name: value.clone() for name, value in layer.state_dict().items()}
    groups = ({"params": [layer.weight], "lr": 0.5}, {"params": [layer.bias], "lr": 2.0})
    optimiser = Recording(*groups)
    config = LoopConfig(11, warm_up_steps=4, final_fraction=0.2, largest_gradient=3.0)
    run(layer, optimiser, config)
    for step, (rates, norm) in enumerate(optimiser.seen):
        fraction = min(1, (step + 1) / 4) * (0.6 + 0.4 * math.cos(math.pi * step / 10))
        assert rates == pytest.approx([0.5 * fraction, 2.0 * fraction])
        assert norm == pytest.approx(3.0)
    # This optimiser moves nothing: the average of constant weights is constant.
    for name, value in layer.state_dict().items():
        assert torch.allclose(value, before[name])
    free = Recording({"params": list(layer.parameters()), "lr": 1.0})
    run(layer, free, replace(config, largest_gradient=None))
    assert free.seen[0][1] == pytest.approx(100 * math.sqrt(3))


def test_networks_are_compiled_where_the_config_asks(monkeypatch: pytest.MonkeyPatch) -> None:
    compiled: list[nn.Module] = []
    monkeypatch.setattr(nn.Module, "compile", lambda self: compiled.append(self))
    network = nn.Sequential(nn.Linear(2, 2), nn.Linear(2, 1))
    for is_compiled in (False, True):
        run(network, torch.optim.SGD(network.parameters()), LoopConfig(1, is_compiled=is_compiled))
    assert compiled == [network, *network]


def test_the_checkpoint_of_another_network_is_refused() -> None:
    checkpointer = MemoryJournal()
    small, large = nn.Linear(2, 1), nn.Linear(2, 3)
    run(small, torch.optim.SGD(small.parameters()), LoopConfig(1), checkpointer)
    with pytest.raises(ArtefactError, match="another training"):
        run(large, torch.optim.SGD(large.parameters()), LoopConfig(2), checkpointer)
    with pytest.raises(ArtefactError, match="another training"):
        run(small, torch.optim.SGD(small.parameters()), LoopConfig(2), MemoryJournal({"step": 1}))
