"""`lightsim train`: from a folder of HDRs to weights and scores."""

from __future__ import annotations

import functools
import hashlib
import json
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest

from lightsim import cli
from lightsim.networks.stored import stored_config
from lightsim.progress import Progress
from lightsim.store.weights import WEIGHTS_FOLDER, load_weights, read_record, read_weights
from lightsim_lab.training import inpaint_scores as inpaint_evaluation
from lightsim_lab.training import run as commands
from lightsim_lab.training.inpaint_scores import evaluate_inpaint
from lightsim_lab.training.lighting_cache import LightingCache, PrepareConfig, read_cache
from lightsim_lab.training.sky_models import SkyKind
from lightsim_lab.training.street_panoramas import StreetConfig


def run(*arguments: object) -> int:
    """Exit code of a command line."""
    try:
        cli.main([str(argument) for argument in arguments])
    except SystemExit as stop:
        return int(stop.code or 0)
    return 0


def test_prepare_writes_what_the_options_ask_for(
    cache_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[PrepareConfig] = []

    def prepared(
        hdri: Path,
        split: Path | None,
        config: PrepareConfig,
        progress: Progress,
        ldr: Path | None,
    ) -> LightingCache:
        asked.append(config)
        return read_cache(cache_path)

    monkeypatch.setattr(commands, "prepare_cache", prepared)
    out = tmp_path / "cache.npz"
    options = ("--height", 32, "--streets", 12, "--positions", 3, "--seed", 4)
    assert run("train", "prepare", "lighting", "--hdri", tmp_path, "--out", out, *options) == 0
    streets = StreetConfig(street_count=12, held_out=2, positions=3)
    assert asked == [PrepareConfig(height_px=32, seed=4, streets=streets)]
    assert read_cache(out).height_px == 64


def documented() -> list[str]:
    """The recipe of docs/guides/training.md for the lighting networks."""
    text = (Path(__file__).parents[3] / "docs" / "guides" / "training.md").read_text()
    lines = [line for line in text.splitlines() if line.startswith("lightsim train ")]
    return [line for line in lines if "relight" not in line]


def test_the_recipe_is_one_command_for_each_network() -> None:
    assert len(documented()) == 2 + len(get_args(SkyKind))
    assert documented()[0].split()[2:4] == ["prepare", "lighting"]


@pytest.mark.slow
@pytest.mark.parametrize("number", range(1, 2 + len(get_args(SkyKind))))
def test_the_recipe_gives_networks_of_the_shipped_kind_and_scores(
    number: int, cache_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    quick = functools.partial(evaluate_inpaint, batches=1, size=1)
    monkeypatch.setattr(inpaint_evaluation, "evaluate_inpaint", quick)
    inpaint = tmp_path / "inpaint" / "weights.safetensors"
    inpaint.parent.mkdir()
    inpaint.write_bytes((WEIGHTS_FOLDER / "inpaint-small.safetensors").read_bytes())
    line = documented()[number].replace("RUNS", str(tmp_path))
    given = [*line.replace("CACHE.npz", str(cache_path)).split()[1:], "--steps", "1"]
    name = Path(given[given.index("--out") + 1]).name
    assert run(*given) == 0
    tensors = read_weights(tmp_path / name / "weights.safetensors")
    assert all(t.isfinite().all() for t in tensors.values())
    shipped = {"inpaint": "inpaint-small", "sky": "sky-small"}.get(name)
    if shipped is not None:
        assert _shapes(tensors) == _shapes(load_weights(shipped))
    if name != "inpaint":
        kind = stored_config(tensors)[0]
        assert kind == {"sky": "lightsim"}.get(name, name)
        methods = {"constant", "brightest pixel", kind}
    else:
        methods = {"network", "row mean", "nearest", "laplace"}
    scores = json.loads((tmp_path / name / "scores.json").read_text())
    assert set(scores) == methods
    values = [v for row in scores.values() for v in row.values() if isinstance(v, float)]
    assert len(values) >= 2 * len(methods)
    assert np.isfinite(values).all()
    record = read_record(tmp_path / name / "weights.safetensors")
    assert record.scores in scores.values()
    assert (record.steps, record.seed, record.licence) == (1, 0, "unknown")
    assert record.training_data == "2 HDR skies, 2 clear skies and 1 positions in synthetic streets"
    assert (
        record.split_hash == hashlib.sha256(b"a,train\nb,validation\nc,train\nd,test\n").hexdigest()
    )
    # The command that is on record is the one that was given.
    assert set(shlex.split(record.command)[1:]) <= set(given)


def _shapes(tensors: Mapping[str, Any]) -> dict[str, tuple[int, ...]]:
    return {key: tuple(value.shape) for key, value in tensors.items()}


def test_networks_that_look_at_no_completion_refuse_one(
    cache_path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("--data", cache_path, "--out", tmp_path, "--inpaint", tmp_path / "w")
    assert run("train", "sky", *words) == 1
    assert "--inpaint" in capsys.readouterr().err


def test_wrong_input_is_named(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert run("train", "inpaint", "--data", tmp_path / "no.npz", "--out", tmp_path) == 1
    assert "no.npz" in capsys.readouterr().err
    assert run("train", "prepare", "lighting", "--hdri", tmp_path, "--out", tmp_path / "x.npz") == 1
    assert "no .hdr or .exr file" in capsys.readouterr().err
    options = ("--out", tmp_path / "x.npz", "--streets", 2)
    assert run("train", "prepare", "lighting", "--hdri", tmp_path, *options) == 1
    assert "--streets" in capsys.readouterr().err
