"""The benchmark's bookkeeping, with commands that stand for the real ones."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lightsim.errors import InputError, MissingDependencyError
from lightsim.fleet import process
from lightsim.progress import SilentProgress
from lightsim.store.images import write_png
from lightsim.store.weights import (
    WeightsRecord,
    read_record,
    write_weights,
)
from lightsim_lab.baselines.methods import ALL_METHODS
from lightsim_lab.studies import benchmark as module
from lightsim_lab.studies.benchmark import benchmark
from lightsim_lab.studies.benchmark_options import (
    CYCLES_STREETS,
    HELD_OUT,
    STYLE_VALIDATION,
    TRAINING,
    BenchmarkOptions,
    held_out_names,
)
from lightsim_lab.synthetic.checksum import street_checksum
from lightsim_lab.synthetic.plan import Style, street_name

FAKE = """
import json, sys
from pathlib import Path
words = sys.argv[1:]
asked = Path("{asked}")
with asked.open("a") as file:
    file.write(json.dumps(words) + chr(10))
if words[0] == "build" and "/58/" in words[1] and not asked.with_name("mended").exists():
    sys.exit("error: this street cannot be built")
if "self-osr" in words:
    sys.exit("error: this method fails")
if words[0] == "evaluate" and "--out" in words:
    out = Path(words[words.index("--out") + 1])
    out.parent.mkdir(parents=True, exist_ok=True)
    methods = words[words.index("--method") + 1] if "--method" in words else "LightSim"
    names = [*methods.split(","), "copy"]
    rows = [
        dict(condition=sky, camera_name="front_camera", method=name, region="masked",
             is_exposed=False, exposure_factor=1.0, count=1, scores=dict(psnr_db=20.0, ssim=0.5),
             scores_by_stem={{"03": dict(psnr_db=20.0 + len(name), ssim=0.5)}})
        for name in names
        for sky in ("low_sun", "overcast")
    ]
    out.write_text(json.dumps({{"rows": rows}}))
"""
"""Stands for lightsim: notes what it was asked for, cannot build street 58 nor relight by
self-osr."""


@pytest.fixture
def asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    path = tmp_path / "asked.txt"
    monkeypatch.setattr(process, "PROGRAM", ("-c", FAKE.format(asked=path)))
    # The stand-ins render nothing.
    monkeypatch.setattr(module, "check_installed", lambda: None)
    return path


def test_a_missing_denoiser_is_reported_before_any_command(
    asked: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def missing() -> None:
        raise MissingDependencyError("pyoidn")

    monkeypatch.setattr(module, "check_installed", missing)
    with pytest.raises(MissingDependencyError):
        benchmark(options(tmp_path / "b", [0]), SilentProgress())
    assert not asked.exists()


def options(folder: Path, seeds: Sequence[int]) -> BenchmarkOptions:
    """Truth and recording of the pictures that the page shows are there."""
    found = BenchmarkOptions(out=folder, seeds=tuple(seeds), methods=("colour-transfer",))
    for seed in seeds:
        truth = found.street(seed) / "truth" / "relit"
        shown = [found.street(seed) / "log" / "camera"]
        for place in (*shown, truth / "low_sun", truth / "overcast"):
            path = place / "front_camera" / "03.jpg"
            path.parent.mkdir(parents=True, exist_ok=True)
            write_png(path, np.zeros((20, 20, 3), np.uint8))
    return found


def commands(asked: Path) -> list[list[str]]:
    lines = asked.read_text().splitlines()
    asked.unlink()
    return [json.loads(line) for line in lines]


def test_a_street_that_fails_leaves_the_others_and_is_mended_later(asked: Path) -> None:
    chosen = options(asked.parent / "out", (1, 58))
    result = benchmark(chosen, SilentProgress())
    done = commands(asked)
    whole = ["synthesize", "build", *["evaluate"] * 4]
    assert [words[0] for words in done] == [*whole, "synthesize", "build"]
    # Twins are built from whole pictures, as those that networks learn from.
    assert all(words[4:6] == ["--image-scale", "1"] for words in done if words[0] == "build")
    assert all("works/1" in words[2] for words in done if words[0] == "evaluate")
    relit = [words for words in done if "--method" in words]
    # A process for each method, and one for all their scores.
    assert [words[words.index("--method") + 1] for words in relit] == [
        "network",
        "colour-transfer",
        "network,colour-transfer",
    ]
    assert ["--no-scores" in words for words in relit] == [True, True, False]
    assert [words[words.index("--name") + 1] for words in relit] == [
        "benchmark-estimated-sky-network",
        "benchmark-estimated-sky-colour-transfer",
        "benchmark-estimated-sky",
    ]
    board = result.relighting
    assert board.streets == ("1",)
    assert [entry.method for entry in board.entries] == ["network", "colour-transfer", "copy"]
    assert any("street 58: error: this street cannot be built" in note for note in board.notes)
    assert any(note == "Not measured: network on 0, 58, 904." for note in board.notes)
    assert result.edits is not None
    assert (chosen.root / "index.html").stat().st_size > 1000
    assert len(json.loads((chosen.root / "leaderboard.json").read_text())) == 2
    # The same command runs what is missing, and nothing else.
    asked.with_name("mended").touch()
    assert benchmark(chosen, SilentProgress()).relighting.streets == ("1", "58")
    again = commands(asked)
    assert [words[0] for words in again] == ["build"] + ["evaluate"] * 4
    assert all("58" in words[1] + words[2] for words in again)
    benchmark(chosen, SilentProgress())
    assert not asked.exists()


def record(streets: dict[str, list[str]] | str) -> WeightsRecord:
    words = ("a network", "lightsim train relight", "streets", "", 0, 1, {}, "CC0", "0.2.0")
    return WeightsRecord(*words, streets=streets)


def test_networks_that_saw_a_street_are_refused(
    asked: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import torch

    monkeypatch.setattr("lightsim.relighting.methods.relight_by", lambda *_: None)
    path = asked.parent / "weights.safetensors"

    def run(side: str, stored: WeightsRecord) -> None:
        write_weights(path, {"w": torch.zeros(1)}, stored)
        chosen = BenchmarkOptions(
            out=asked.parent,
            side=side,  # type: ignore[arg-type]
            methods=("network",),
            weights=(f"network={path}",),
        )
        benchmark(chosen, SilentProgress())

    with pytest.raises(InputError, match="was trained on streets of the validation side"):
        run("validation", record({"training": ["77", "904"], "validation": []}))
    chosen_by = record({"training": ["77"], "validation": ["7003", "58"]})
    with pytest.raises(InputError, match="of the test side"):
        run("test", chosen_by)
    with pytest.raises(InputError, match="do not record their training streets"):
        run("validation", record("unknown"))
    assert not asked.exists()
    # Streets of the validation side may choose.
    write_weights(path, {"w": torch.zeros(1)}, chosen_by)
    chosen = BenchmarkOptions(out=asked.parent, weights=(f"network={path}",))
    module._check_unseen("network", chosen)


def test_shipped_networks_tell_their_streets() -> None:
    for method in ALL_METHODS.values():
        path = method.shipped_file()
        if path is None:
            continue
        streets = read_record(path).streets
        assert not isinstance(streets, str)
        assert set(streets["training"]) <= {str(seed) for seed in TRAINING}
        assert len(streets["training"]) >= 5


def test_sides_share_no_street_and_streets_are_the_committed_ones(tmp_path: Path) -> None:
    seeds = [*TRAINING, *HELD_OUT["validation"], *HELD_OUT["test"]]
    assert len(set(seeds)) == len(seeds)
    assert min(len(side) for side in HELD_OUT.values()) >= 4
    for side in HELD_OUT.values():
        seed = next(iter(side))
        assert street_checksum(seed) == side[seed]
    with pytest.raises(InputError, match="no streets of this side"):
        BenchmarkOptions(out=tmp_path, seeds=(7001,))
    with pytest.raises(InputError, match="METHOD=FILE"):
        BenchmarkOptions(out=tmp_path, weights=("physical=x",))


@pytest.mark.parametrize("style", tuple(STYLE_VALIDATION))
def test_each_style_has_committed_validation_streets(style: Style, tmp_path: Path) -> None:
    chosen = BenchmarkOptions(out=tmp_path, style=style)
    assert len(chosen.checksums) >= 2
    seed = next(iter(chosen.checksums))
    assert street_checksum(seed, style) == chosen.checksums[seed]
    assert f"{style}-{seed}" in held_out_names()
    assert chosen.root.name == f"validation-small-{style}"
    words = module._synthesize(chosen, seed)
    assert words[words.index("--style") + 1] == style
    with pytest.raises(InputError, match="no test streets"):
        BenchmarkOptions(out=tmp_path, style=style, side="test")


@pytest.mark.parametrize("style", tuple(CYCLES_STREETS))
def test_streets_of_cycles_are_a_set_of_their_own(style: Style, tmp_path: Path) -> None:
    usual = BenchmarkOptions(out=tmp_path, style=style)
    python = Path("blender/bin/python")
    chosen = replace(usual, renderer="cycles", blender_python=python)
    (seed,) = chosen.checksums
    assert street_checksum(seed, style) == chosen.checksums[seed]
    assert street_name(seed, style) in held_out_names()
    assert seed not in (*usual.checksums, *TRAINING)
    assert chosen.root != usual.root
    words = module._synthesize(chosen, seed)
    assert words[-4:] == ("--renderer", "cycles", "--blender-python", str(python))
    assert "--renderer" not in module._synthesize(usual, next(iter(usual.checksums)))
    with pytest.raises(InputError, match="--style" if style != "city" else "--side"):
        replace(chosen, side="test")
    with pytest.raises(InputError, match="no streets of this side"):
        replace(chosen, seeds=(0,))


def test_nothing_is_chosen_on_streets_of_cycles(asked: Path) -> None:
    import torch

    path = asked.parent / "weights.safetensors"
    stored = record({"training": ["77"], "validation": ["31", "58"]})
    write_weights(path, {"w": torch.zeros(1)}, stored)
    chosen = BenchmarkOptions(out=asked.parent, weights=(f"network={path}",))
    module._check_unseen("network", chosen)
    with pytest.raises(InputError, match="cycles side"):
        module._check_unseen("network", replace(chosen, renderer="cycles"))


def test_a_missing_blender_is_reported_before_any_command(asked: Path) -> None:
    chosen = BenchmarkOptions(
        out=asked.parent, renderer="cycles", blender_python=Path("/nowhere/python")
    )
    with pytest.raises(MissingDependencyError, match="--blender-python"):
        benchmark(chosen, SilentProgress())
    assert not asked.exists()


def test_a_method_that_fails_leaves_the_others(asked: Path) -> None:
    chosen = replace(options(asked.parent / "out", (1,)), methods=("self-osr", "physical"))
    board = benchmark(chosen, SilentProgress()).relighting
    assert [entry.method for entry in board.entries] == ["network", "physical", "copy"]
    assert any("error: this method fails" in note for note in board.notes)


def test_the_field_of_a_street_is_trained_on_its_twin(asked: Path) -> None:
    chosen = replace(options(asked.parent / "out", (1,)), methods=("nerf-osr",))
    benchmark(chosen, SilentProgress())
    done = commands(asked)
    assert [words[0] for words in done] == ["synthesize", "build", "train"] + ["evaluate"] * 4
    assert done[2][1:] == ["nerf-osr", str(chosen.work(1))]
