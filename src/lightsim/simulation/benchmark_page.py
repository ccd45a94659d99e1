"""index.html of the benchmark: the leaderboards, and the weakest pictures of our own method."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from lightsim.evaluate.frames import FrameTask
from lightsim.evaluate.leaderboard import weakest
from lightsim.simulation.benchmark_options import REFERENCE, BenchmarkOptions
from lightsim.simulation.evaluation import OURS
from lightsim.simulation.report import compared
from lightsim.store.artefact import write_text
from lightsim.store.images import read_srgb8
from lightsim.view.report import Figure, Section, Table, write_report

if TYPE_CHECKING:
    from lightsim.simulation.benchmark import Benchmark

_SHOWN = 5


def write_page(options: BenchmarkOptions, result: Benchmark) -> Path:
    """leaderboard.json and index.html."""
    write_text(options.root / "leaderboard.json", result.to_json() + "\n")
    tables = [
        Table(columns, lines, caption)
        for board in result.boards
        for caption, columns, lines in board.tables()
    ]
    cases = weakest(options.scores / REFERENCE, OURS, _SHOWN)
    figures = [_case(options, *case) for case in cases]
    sections = [
        Section("Leaderboard", "\n\n".join(result.relighting.notes), tables=tables),
        Section(f"The {len(figures)} weakest pictures of {OURS}", figures=figures),
    ]
    path = options.root / "index.html"
    write_report(path, "LightSim benchmark", sections, subtitle="lightsim evaluate benchmark")
    return path


def _case(
    options: BenchmarkOptions, street: str, sky: str, camera: str, stem: str, psnr_db: float
) -> Figure:
    """Truth, recorded picture, and what every method made of it; a method whose frames are gone is
    left out."""
    folder = options.root / "streets" / street
    recorded = folder / "log" / "camera" / camera / f"{stem}.jpg"
    ending = f"-{options.source_sky}-sky"
    pictures = {"recorded": recorded}
    for made in sorted(
        (options.root / "works" / street / "scenarios").glob(f"benchmark-*{ending}")
    ):
        picture = made / sky / "frames" / camera / f"{stem}.png"
        if picture.is_file():
            pictures[made.name.removeprefix("benchmark-").removesuffix(ending)] = picture
    truth = folder / "truth" / "relit" / sky / camera / f"{stem}.jpg"
    load = {name: partial(read_srgb8, path) for name, path in pictures.items()}
    task = FrameTask(f"street {street}, {sky}", camera, stem, partial(read_srgb8, truth), load)
    figure = compared(task)
    return Figure(f"{psnr_db:.1f} dB: {figure.caption}", figure.image, figure.is_wide)
