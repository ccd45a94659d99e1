"""Checkpoints and metrics of training: whole files, plain tensors, no pickled code."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lightsim.errors import ArtefactError
from lightsim.store.atomic import unwritable, whole_file
from lightsim.store.reading import open_regular, read_bytes

_MAX_BYTES = 4 << 30
"""A checkpoint of the largest field with its optimiser takes a tenth of it."""
CHECKPOINT_NAME = "checkpoint.pt"
METRICS_NAME = "metrics.jsonl"


class FolderCheckpointer:
    """Checkpoint and metrics.jsonl in one folder; see `networks.loop.Checkpointer`."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def load(self) -> dict[str, Any] | None:
        """The last state saved, or None.

        Raises:
            ArtefactError: the file is damaged.
        """
        import torch

        path = self._folder / CHECKPOINT_NAME
        if not path.is_file():
            return None
        try:
            # weights_only: an allow-list unpickler, tensors and plain containers alone.
            with open_regular(path, "checkpoint", _MAX_BYTES) as handle:
                state = torch.load(handle, map_location="cpu", weights_only=True)
        except Exception as error:
            raise ArtefactError(
                "the checkpoint cannot be read",
                where=path,
                got=f"{type(error).__name__}: {error}"[:200],
                remedy="Delete the file; training then starts again.",
            ) from error
        if not isinstance(state, dict) or type(state.get("step")) is not int:
            raise ArtefactError(
                "the checkpoint names no step",
                where=path,
                remedy="Delete the file; training then starts again.",
            )
        self._forget_after(state["step"])
        return state

    def save(self, state: Mapping[str, Any]) -> None:
        """Replace the checkpoint, whole or not at all.

        Raises:
            LightSimError: the file cannot be written.
        """
        import torch

        with whole_file(self._folder / CHECKPOINT_NAME) as temporary:
            torch.save(dict(state), temporary)

    def record(self, metrics: Mapping[str, float]) -> None:
        """Append a line to metrics.jsonl, values rounded to six decimals.

        Raises:
            LightSimError: the file cannot be written.
        """
        path = self._folder / METRICS_NAME
        try:
            with path.open("a") as handle:
                handle.write(json.dumps({k: round(v, 6) for k, v in metrics.items()}) + "\n")
        except OSError as error:
            raise unwritable(path, error) from error

    def finish(self) -> None:
        """Drop the checkpoint; what remains of training are weights and metrics."""
        (self._folder / CHECKPOINT_NAME).unlink(missing_ok=True)

    def _forget_after(self, step: int) -> None:
        """Drop lines of steps that will be done again."""
        path = self._folder / METRICS_NAME
        if not path.is_file():
            return
        text = read_bytes(path, "list of metrics", _MAX_BYTES).decode(errors="replace")
        lines = [line for line in text.splitlines() if line.strip()]
        kept = [line for line in lines if self._step(line) < step]
        with whole_file(path) as temporary:
            temporary.write_text("".join(line + "\n" for line in kept))

    def _step(self, line: str) -> float:
        try:
            return float(json.loads(line)["step"])
        except (ValueError, TypeError, KeyError, RecursionError) as error:
            raise ArtefactError(
                "a line of the metrics is broken",
                where=self._folder / METRICS_NAME,
                got=f"{line[:60]!r}",
                remedy="Delete the file, or the line.",
            ) from error
