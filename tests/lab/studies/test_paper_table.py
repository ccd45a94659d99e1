"""Table 1's bookkeeping, with logs, commands and features that stand for the real ones."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import pytest

from lightsim.cli.app import parse_command
from lightsim.errors import InputError
from lightsim.fleet.batch import BatchOptions, BatchResult
from lightsim.progress import SilentProgress
from lightsim.store.images import write_png
from lightsim_lab.studies import paper_table as module
from lightsim_lab.studies.paper_table import SEQUENCES, PaperTableOptions, paper_table


class FakeNetwork:
    """Features are the first pixels; counts the pictures that it has seen."""

    seen = 0

    def __init__(self, path: Path | None) -> None:
        pass

    def features(self, images: Iterable[np.ndarray]) -> np.ndarray:
        rows = [image.reshape(-1)[:2048].astype(float) for image in images]
        FakeNetwork.seen += len(rows)
        return np.array(rows).reshape(-1, 2048)


@pytest.fixture
def pandaset(tmp_path: Path, rng: np.random.Generator) -> Path:
    """Sequences 002 and 053, and 999, which the paper did not relight."""
    from PIL import Image

    for name in ("002", "053", "999"):
        folder = tmp_path / "pandaset" / name / "camera" / "front_camera"
        folder.mkdir(parents=True)
        for stem in range(3):
            picture = rng.integers(0, 256, (30, 30, 3)).astype(np.uint8)
            Image.fromarray(picture).save(folder / f"{stem:02d}.jpg")
    (tmp_path / "skies.txt").write_text("sun:100,30\n# night\nsky.exr\n")
    return tmp_path / "pandaset"


def test_the_sequences_are_the_papers() -> None:
    assert [len(SEQUENCES[n]) for n in ("15", "47")] == [15, 47]
    assert set(SEQUENCES["15"]) < set(SEQUENCES["47"])


def test_what_is_there_is_built_relit_and_compared_once(
    pandaset: Path, monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator
) -> None:
    asked: list[tuple[str, ...]] = []

    def run_batch(
        command: str, lines: Sequence[tuple[str, ...]], options: BatchOptions, progress: object
    ) -> BatchResult:
        for line in lines:
            parse_command((command, *line))  # It is a command of ours.
            asked.append((command, *line))
        for line in lines if command == "relight" else ():
            for sky in line[line.index("--sky") + 1 :]:
                name = Path(sky).stem.replace(":", "_").replace(",", "_")
                scenario = Path(line[0]) / "scenarios" / line[line.index("--name") + 1]
                folder = scenario / name / "frames" / "front_camera"
                if not folder.is_dir():
                    folder.mkdir(parents=True)
                    picture = rng.integers(0, 256, (30, 30, 3)).astype(np.uint8)
                    write_png(folder / "06.png", picture)
        return BatchResult(len(lines), 0, {Path("a.log"): "it failed"} if asked else {})

    monkeypatch.setattr(module, "run_batch", run_batch)
    monkeypatch.setattr("lightsim_lab.metrics.inception.Inception", FakeNetwork)
    out = pandaset.parent / "out"
    options = PaperTableOptions(
        pandaset=pandaset, skies=pandaset.parent / "skies.txt", out=out, build="--preset draft"
    )
    table = paper_table(options, SilentProgress())
    assert [words[:2] for words in asked if words[0] == "build"] == [
        ("build", str(pandaset / "002")),
        ("build", str(pandaset / "053")),
    ]
    assert asked[0][-2:] == ("--preset", "draft")
    relights = [words for words in asked if words[0] == "relight"]
    assert [words[-3:] for words in relights] == [("--sky", "sun:100,30", "sky.exr")] * 6
    assert all("6:25:6" in words and "front_camera" in words for words in relights)
    assert [(r.method, r.count, r.reference_count) for r in table.rows] == [
        ("network", 4, 9),
        ("physical", 4, 9),
        ("colour-transfer", 4, 9),
    ]
    text = table.to_table()
    assert "2 of 15 sequences: 002, 053." in text
    assert "2 skies; the paper has 23." in text
    assert "it failed" in text
    assert FakeNetwork.seen == 9 + 3 * 4
    assert paper_table(options, SilentProgress()).rows == table.rows
    assert FakeNetwork.seen == 9 + 3 * 4  # Features are kept.


def test_nothing_to_do_is_said(pandaset: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lightsim_lab.metrics.inception.Inception", FakeNetwork)
    skies, out = pandaset.parent / "skies.txt", pandaset.parent / "out"
    with pytest.raises(InputError, match="2 skies, 0 sequences"):
        paper_table(
            PaperTableOptions(pandaset=pandaset.parent, skies=skies, out=out), SilentProgress()
        )
    with pytest.raises(InputError, match="--methods"):
        PaperTableOptions(pandaset=pandaset, skies=skies, out=out, methods=("magic",))
