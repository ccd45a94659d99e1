"""Stand-ins for commands and for the Inception network in tests of the paper's tables."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from lightsim.cli.app import parse_command
from lightsim.core.sky_choice import SkyChoice
from lightsim.fleet.batch import BatchOptions, BatchResult, log_of
from lightsim.fleet.lines import BatchCommand
from lightsim.simulation.skies import parse_sky
from lightsim.store.images import write_png


class FakeNetwork:
    """Returns first pixels as features; counts all pictures it was given."""

    seen = 0

    def __init__(self, path: Path | None) -> None:
        pass

    def features(self, images: Iterable[np.ndarray]) -> np.ndarray:
        rows = [image.reshape(-1)[:2048].astype(float) for image in images]
        FakeNetwork.seen += len(rows)
        return np.array(rows).reshape(-1, 2048)


class FakeBatch:
    """Replaces `run_batch`: writes weights and pictures as the commands would; records the lines.

    Args:
        failing: a command with this text in one of its words fails. A failing relight leaves
            pictures, as an interrupted one does.
    """

    def __init__(self, rng: np.random.Generator, failing: str = "nothing") -> None:
        self.rng, self.failing = rng, failing
        self.asked: list[tuple[str, ...]] = []

    def of(self, command: BatchCommand) -> list[tuple[str, ...]]:
        """Return the recorded lines of a command."""
        return [words for words in self.asked if words[0] == command]

    def __call__(
        self,
        command: BatchCommand,
        lines: Sequence[tuple[str, ...]],
        options: BatchOptions,
        progress: object,
    ) -> BatchResult:
        failed = {}
        for line in lines:
            is_repeated = (command, *line) in self.asked
            self.asked.append((command, *line))
            parse_command((command, *line))  # Raises if the command line is wrong.
            if any(self.failing in word for word in line):
                failed[log_of(command, line, options.out)] = "it failed"
            elif line[0] == "relight":
                run = Path(after(line, "--out"))
                run.mkdir(parents=True, exist_ok=True)
                (run / "weights.safetensors").write_bytes(run.name.encode())
            if command == "relight" and not is_repeated:
                self._relight(line)
        return BatchResult(len(lines), 0, failed)

    def _relight(self, line: Sequence[str]) -> None:
        stems = ["06"] if "--frames" in line else ["06", "07"]
        scenario = Path(line[0]) / "scenarios" / after(line, "--name")
        named = line[line.index("--sky") + 1 :]
        for sky in named:
            folder = scenario / parse_sky(SkyChoice(sky)).name if len(named) > 1 else scenario
            for stem in stems:
                path = folder / "frames" / "front_camera" / f"{stem}.png"
                path.parent.mkdir(parents=True, exist_ok=True)
                write_png(path, self.rng.integers(0, 256, (30, 30, 3)).astype(np.uint8))


def after(line: Sequence[str], option: str) -> str:
    """Return the word after an option."""
    return line[line.index(option) + 1]
