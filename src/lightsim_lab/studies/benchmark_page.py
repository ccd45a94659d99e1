"""HTML page of the benchmark: leaderboards and the weakest pictures of the reference method."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from lightsim.build.quality.frames import FrameTask
from lightsim.store.images import read_srgb8
from lightsim.view.report import Figure, Section, Table, write_report
from lightsim_lab.studies.benchmark_options import REFERENCE, BenchmarkOptions
from lightsim_lab.studies.leaderboard import Leaderboard, weakest
from lightsim_lab.studies.report import compared


def write_page(options: BenchmarkOptions, boards: Sequence[Leaderboard]) -> Path:
    """Write index.html of a side and size; return its path."""
    tables = [
        Table(columns, lines, caption)
        for board in boards
        for caption, columns, lines in board.tables()
    ]
    cases = weakest(options.scores("relighting"), REFERENCE, count=5)
    figures = [_case(options, *case) for case in cases]
    sections = [
        Section("Leaderboard", "\n\n".join(boards[0].notes), tables=tables),
        Section(f"The {len(figures)} weakest pictures of {REFERENCE}", figures=figures),
    ]
    path = options.root / "index.html"
    write_report(path, "LightSim benchmark", sections, subtitle="lightsim evaluate benchmark")
    return path


def _case(
    options: BenchmarkOptions, street: str, sky: str, camera: str, stem: str, psnr_db: float
) -> Figure:
    """Return a figure of the truth, the recorded picture and all existing relit pictures."""
    folder = options.root / "streets" / street
    recorded = folder / "log" / "camera" / camera / f"{stem}.jpg"
    beginning = f"{options.scenarios}-"
    pictures = {"recorded": recorded}
    for made in sorted((options.work(int(street)) / "scenarios").glob(f"{beginning}*")):
        # Frames of a method may have been removed to save space; its scores remain.
        picture = made / sky / "frames" / camera / f"{stem}.png"
        if picture.is_file():
            pictures[made.name.removeprefix(beginning)] = picture
    truth = folder / "truth" / "relit" / sky / camera / f"{stem}.jpg"
    load = {name: partial(read_srgb8, path) for name, path in pictures.items()}
    task = FrameTask(f"street {street}, {sky}", camera, stem, partial(read_srgb8, truth), load)
    figure = compared(task)
    return Figure(f"{psnr_db:.1f} dB: {figure.caption}", figure.image, figure.is_wide)
