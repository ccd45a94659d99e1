"""`lightsim train`: from a folder of HDRs to weights and scores."""

from __future__ import annotations

import functools
import hashlib
import json
import shlex
from pathlib import Path

import numpy as np
import pytest

from lightsim import cli
from lightsim.progress import Progress
from lightsim.store.weights import read_record, read_weights
from lightsim.training import inpaint_scores as inpaint_evaluation
from lightsim.training import run as commands
from lightsim.training.inpaint_scores import evaluate_inpaint
from lightsim.training.lighting_cache import LightingCache, PrepareConfig, read_cache
from lightsim.training.street_panoramas import StreetConfig


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
    assert run("train", "prepare", "--hdri", tmp_path, "--out", out, *options) == 0
    streets = StreetConfig(street_count=12, held_out=2, positions=3)
    assert asked == [PrepareConfig(height_px=32, seed=4, streets=streets)]
    assert read_cache(out).height_px == 64


@pytest.mark.slow
@pytest.mark.parametrize(
    ("what", "methods"),
    [
        (("inpaint",), {"network", "row mean", "nearest", "laplace"}),
        (("sky",), {"constant", "brightest pixel", "lightsim"}),
        (
            ("baseline", "--which", "nlfe_panorama"),
            {"constant", "brightest pixel", "nlfe_panorama"},
        ),
    ],
)
def test_training_writes_weights_and_scores(
    what: tuple[str, ...],
    methods: set[str],
    cache_path: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    quick = functools.partial(evaluate_inpaint, batches=1, size=1)
    monkeypatch.setattr(inpaint_evaluation, "evaluate_inpaint", quick)
    given = ("train", *what, "--data", cache_path, "--out", tmp_path, "--steps", 1)
    assert run(*given) == 0
    tensors = read_weights(tmp_path / "weights.safetensors").values()
    assert sum(t.numel() for t in tensors) > 10_000
    assert all(t.isfinite().all() for t in tensors)
    scores = json.loads((tmp_path / "scores.json").read_text())
    assert set(scores) == methods
    values = [v for row in scores.values() for v in row.values() if isinstance(v, float)]
    assert len(values) >= 2 * len(methods)
    assert np.isfinite(values).all()
    record = read_record(tmp_path / "weights.safetensors")
    assert record.scores in scores.values()
    assert (record.steps, record.seed, record.licence) == (1, 0, "unknown")
    assert record.training_data == "2 HDR skies, 2 clear skies and 1 positions in synthetic streets"
    assert (
        record.split_hash == hashlib.sha256(b"a,train\nb,validation\nc,train\nd,test\n").hexdigest()
    )
    # The command that is on record is the one that was given.
    assert sorted(shlex.split(record.command)[1:]) == sorted(str(word) for word in given)


def test_wrong_input_is_named(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert run("train", "inpaint", "--data", tmp_path / "no.npz", "--out", tmp_path) == 1
    assert "no.npz" in capsys.readouterr().err
    assert run("train", "prepare", "--hdri", tmp_path, "--out", tmp_path / "x.npz") == 1
    assert "no .hdr or .exr file" in capsys.readouterr().err
    options = ("--out", tmp_path / "x.npz", "--streets", 2)
    assert run("train", "prepare", "--hdri", tmp_path, *options) == 1
    assert "--streets" in capsys.readouterr().err
