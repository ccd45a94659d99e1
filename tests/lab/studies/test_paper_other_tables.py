"""Tables A2 and A4: what they ask for, with commands and features that stand for the real ones."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from tests.lab.studies.fake_commands import FakeBatch, FakeNetwork, after

from lightsim.errors import InputError
from lightsim.progress import SilentProgress
from lightsim.store.exr import read_exr, write_exr
from lightsim.store.images import write_jpeg
from lightsim_lab.studies import sky_networks, study
from lightsim_lab.studies.paper_ablations import PaperAblationOptions, paper_ablations
from lightsim_lab.studies.paper_skies import PaperSkyOptions, paper_skies
from lightsim_lab.studies.sky_networks import NetworksReport


@pytest.fixture
def pandaset(tmp_path: Path, rng: np.random.Generator) -> Path:
    """Sequences 001 and 057, and a sky file with one bright column."""
    for name in ("001", "057"):
        folder = tmp_path / "pandaset" / name / "camera" / "front_camera"
        folder.mkdir(parents=True)
        for stem in ("06", "07"):
            picture = rng.integers(0, 256, (30, 30, 3)).astype(np.uint8)
            write_jpeg(folder / f"{stem}.jpg", picture)
    radiance = np.ones((72, 144, 3), np.float32)
    radiance[:, 0] = 9.0
    write_exr(tmp_path / "noon.exr", radiance)
    (tmp_path / "unseen.txt").write_text(f"{tmp_path / 'noon.exr'}\n")
    return tmp_path / "pandaset"


def test_ablated_networks_relight_one_sequence(
    pandaset: Path, monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator
) -> None:
    batch = FakeBatch(rng, failing="paper-edges-800")
    monkeypatch.setattr(study, "run_batch", batch)
    monkeypatch.setattr("lightsim_lab.metrics.inception.Inception", FakeNetwork)
    out = pandaset.parent / "A2"
    options = PaperAblationOptions(
        log=pandaset / "001", data=Path("data"), unseen=pandaset.parent / "unseen.txt", out=out,
        train="--steps 7", kid_subset_size=2,
    )  # fmt: skip
    table = paper_ablations(options, SilentProgress())
    trained = batch.of("train")
    assert len(trained) == 8
    assert all(words[-2:] == ("--steps", "7") and "paper" in words for words in trained)
    assert ("--without", "shadow-maps") in [words[8:10] for words in trained]
    relit = batch.of("relight")
    assert len(relit) == 2 * 7  # All frames, and the first one, by all networks but one.
    assert {after(words, "--frames") for words in relit if "--frames" in words} == {"6:7"}
    assert [row.method for row in table.rows][:2] == ["all", "without sim-real"]
    assert {row.count for row in table.rows} == {2 + 72}
    assert {row.reference_count for row in table.rows} == {2}
    text = table.to_table()
    assert "it failed" in text
    assert "1 unseen skies; the paper has 3." in text
    assert "0 other skies; the paper has 92." in text
    # The sun of a turned sky goes round: 5 degrees are two of 144 columns.
    turned = read_exr(out / "turned" / "noon-010.exr")
    assert turned[0, :, 0].argmax() == 4


def test_other_weights_are_other_commands(
    pandaset: Path, monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator
) -> None:
    batch = FakeBatch(rng)
    monkeypatch.setattr(study, "run_batch", batch)
    monkeypatch.setattr("lightsim_lab.metrics.inception.Inception", FakeNetwork)
    options = PaperAblationOptions(
        log=pandaset / "001", data=Path("data"), unseen=pandaset.parent / "unseen.txt",
        out=pandaset.parent / "A2", kid_subset_size=2,
    )  # fmt: skip
    paper_ablations(options, SilentProgress())
    first = set(batch.of("relight"))
    paper_ablations(options, SilentProgress())
    assert set(batch.of("relight")) == first

    def train_otherwise(command: str, lines: Sequence[tuple[str, ...]], *rest: object) -> object:
        result = batch(command, lines, *rest)  # type: ignore[arg-type]
        for path in (pandaset.parent / "A2" / "runs").glob("*/weights.safetensors"):
            path.write_bytes(path.parent.name.encode() + b"longer")
        return result

    monkeypatch.setattr(study, "run_batch", train_otherwise)
    paper_ablations(options, SilentProgress())
    now = set(batch.of("relight")) - first
    assert len(now) == len(first)


def test_skies_of_the_ablations_are_files(pandaset: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lightsim_lab.metrics.inception.Inception", FakeNetwork)
    (pandaset.parent / "unseen.txt").write_text("sun:100,30\n")
    options = PaperAblationOptions(
        log=pandaset / "001", data=Path("data"), unseen=pandaset.parent / "unseen.txt",
        out=pandaset.parent / "A2",
    )  # fmt: skip
    with pytest.raises(InputError, match="sun:100,30"):
        paper_ablations(options, SilentProgress())


def test_all_logs_are_built_up_to_their_skies_and_compared(
    pandaset: Path, monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator
) -> None:
    batch = FakeBatch(rng, failing="057")
    compared: list[tuple[list[str], Path]] = []

    def compare(logs: Sequence, runs: Path) -> NetworksReport:
        compared.append(([work.root.name for work in logs], runs))
        return NetworksReport(("001",), ("a log by night",), ())

    monkeypatch.setattr(study, "run_batch", batch)
    monkeypatch.setattr(sky_networks, "compare_sky_networks", compare)
    out = pandaset.parent / "A4"
    report = paper_skies(
        PaperSkyOptions(pandaset=pandaset, out=out, data=Path("lighting.npz"), train="--steps 9"),
        SilentProgress(),
    )
    builds = batch.of("build")
    assert [Path(words[1]).name for words in builds] == ["001", "057"]
    assert {after(words, "--until") for words in builds} == {"sky"}
    trainings = [words[1:] for words in batch.of("train")]
    assert trainings[0][0] == "inpaint"  # Others look through it.
    assert sorted(Path(after(words, "--out")).name for words in trainings) == [
        "inpaint", "nlfe", "nlfe-star", "paper", "sold-net",
    ]  # fmt: skip
    weights = str(out / "sky-runs" / "inpaint" / "weights.safetensors")
    assert [after(w, "--inpaint") for w in trainings if "--inpaint" in w] == [weights] * 2
    assert compared == [(["001"], out / "sky-runs")]
    assert report.left_out[0] == "a log by night"
    assert report.left_out[1].endswith("it failed")


def test_a_folder_without_logs_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="there is no log"):
        paper_skies(PaperSkyOptions(pandaset=tmp_path, out=tmp_path / "out"), SilentProgress())
