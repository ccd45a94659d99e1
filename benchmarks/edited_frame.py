"""What an edited frame costs, by part; a Markdown table.

    python benchmarks/edited_frame.py WORK SCENARIO.json [--cameras a,b] [--frames 60:64]

Source images of the scenario, as `lightsim simulate --sky source` makes them; nothing is written.
Means over the edited frames, without the first of each camera, which measures its look and traces
most of the faces that rays meet. Processor and wall seconds of one process; OMP_NUM_THREADS and
NUMBA_NUM_THREADS say how many threads it has. Every second counts for the innermost part.
"""

from __future__ import annotations

import argparse
import functools
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

import lightsim.relighting.physical.filters as filters
import lightsim.relighting.physical.ratio as ratio
import lightsim.render.frame_renderer as frame_renderer
import lightsim.simulation.source_image as source_image
from lightsim.build.workspace import Workspace
from lightsim.core.sky_choice import SkyChoice
from lightsim.scenario.edits import read_scenario_request
from lightsim.simulation.edited import asset_library, edited_scenario
from lightsim.simulation.options import RelightOptions
from lightsim.simulation.relight import replayed
from lightsim.simulation.relighter import RelightConfig, Relighter
from lightsim.simulation.skies import resolve_sky
from lightsim.store.artefact import peak_memory_mb

_REST = "rest"
_PARTS: tuple[tuple[str, Any, str], ...] = (
    ("scene of the moment", frame_renderer, "place"),
    ("primary rays", frame_renderer, "render_gbuffers"),
    ("samples of new actors", frame_renderer, "render_samples"),
    ("light transport matrix", frame_renderer, "trace_transport"),
    ("light", frame_renderer, "light"),
    ("sun past actors", frame_renderer, "sun_visibility"),
    ("coverage", frame_renderer, "actor_coverage"),
    ("new actors' layer", source_image.SourceImages, "_layer_of"),
    ("edited picture", source_image, "edited_image"),
    ("medians", filters, "median"),
    ("denoising", ratio, "denoised_where_amplified"),
)
"""Functions where they are looked up."""


class Stopwatch:
    """Processor and wall seconds by part."""

    def __init__(self) -> None:
        self.seconds: defaultdict[str, np.ndarray] = defaultdict(lambda: np.zeros(2))
        self._running = [_REST]
        self._since = _now()

    @contextmanager
    def measure(self, part: str) -> Generator[None]:
        """Seconds that pass belong to this part, and not to the one around it."""
        self._turn()
        self._running.append(part)
        try:
            yield
        finally:
            self._turn()
            self._running.pop()

    def taken(self) -> dict[str, np.ndarray]:
        """All since it was last asked."""
        self._turn()
        found, self.seconds = dict(self.seconds), defaultdict(lambda: np.zeros(2))
        return found

    def _turn(self) -> None:
        now = _now()
        self.seconds[self._running[-1]] += now - self._since
        self._since = now


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("work", type=Path)
    parser.add_argument("scenario", type=Path)
    parser.add_argument("--cameras", default="")
    parser.add_argument("--frames", default="")
    options = parser.parse_args()
    watch = Stopwatch()
    for part, owner, name in _PARTS:
        setattr(owner, name, _watched(getattr(owner, name), part, watch))
    names = tuple(filter(None, options.cameras.split(",")))
    chosen = RelightOptions(name="edited_frame", frames=options.frames, cameras=names)
    work = Workspace(options.work, is_stale_allowed=True)
    start, frames, first, free = _measured(work, options.scenario, chosen, watch)
    sys.stdout.write(_table(start, frames, first, free) + "\n")


def _watched(function: Callable[..., Any], part: str, watch: Stopwatch) -> Callable[..., Any]:
    @functools.wraps(function)
    def timed(*args: Any, **kwargs: Any) -> Any:
        with watch.measure(part):
            return function(*args, **kwargs)

    return timed


_Taken = dict[str, np.ndarray]


def _measured(
    work: Workspace, path: Path, options: RelightOptions, watch: Stopwatch
) -> tuple[_Taken, list[_Taken], list[_Taken], list[_Taken]]:
    """What is taken before the first frame; by edited frames; by the first of each camera; and by
    frames without edits."""
    recorded = replayed(work, options)
    asked = read_scenario_request(path)
    scenario = edited_scenario(work, recorded, asked, asset_library(None, path.parent))
    log = work.log_at(work.reading.image_scale)
    relighter = Relighter(work, log, RelightConfig(), options, recorded)
    target = relighter.target(resolve_sky(SkyChoice("source"), work))
    start = watch.taken()
    edited: list[_Taken] = []
    first: list[_Taken] = []
    free: list[_Taken] = []
    known: set[str] = set()
    for frame in scenario.frames:
        (made,) = relighter.relit(frame, scenario, [target])
        taken = watch.taken()
        if made.traced is None:
            free.append(taken)
        else:
            (edited if frame.camera_name in known else first).append(taken)
            known.add(frame.camera_name)
    return start, edited, first, free


def _table(start: _Taken, edited: list[_Taken], first: list[_Taken], free: list[_Taken]) -> str:
    lines = ["| part | processor s | wall s |", "|---|---:|---:|"]
    rows = [(part, _mean(edited, part)) for part in [*(p for p, _, _ in _PARTS), _REST]]
    rows += [
        (f"an edited frame ({len(edited)})", _mean(edited)),
        (f"the first of a camera ({len(first)})", _mean(first)),
        (f"a frame without edits ({len(free)})", _mean(free)),
        ("before the first frame", _mean([start])),
    ]
    lines += [f"| {name} | {seconds[0]:.2f} | {seconds[1]:.2f} |" for name, seconds in rows]
    return "\n".join([*lines, "", f"peak memory {peak_memory_mb():.0f} MB"])


def _mean(frames: list[_Taken], part: str | None = None) -> np.ndarray:
    """Seconds of a part, or of all, a frame."""
    wanted = [s for f in frames for p, s in f.items() if part in (None, p)]
    return np.sum(wanted, axis=0) / len(frames) if wanted else np.zeros(2)


def _now() -> np.ndarray:
    return np.array([time.process_time(), time.perf_counter()])


if __name__ == "__main__":
    main()
