"""Checkpoints and metrics of training: atomic files of plain tensors, without pickled code."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lightsim.errors import ArtefactError
from lightsim.store.atomic import unwritable, whole_file
from lightsim.store.reading import open_regular, read_bytes

# Largest size of a checkpoint that is read, in bytes; the largest field with its optimiser takes a
# tenth of it.
_MAX_BYTES = 4 << 30
CHECKPOINT_NAME = "checkpoint.pt"
METRICS_NAME = "metrics.jsonl"


class FolderCheckpointer:
    """Checkpoint and metrics.jsonl of a training in one folder (`networks.loop.Checkpointer`)."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def load(self) -> dict[str, Any] | None:
        """Return the last saved state; None if there is none.

        Raises:
            ArtefactError: the file is damaged.
        """
        import torch

        path = self._folder / CHECKPOINT_NAME
        if not path.is_file():
            return None
        try:
            # With weights_only, torch unpickles tensors and plain containers only: no code runs.
            with open_regular(path, "checkpoint", _MAX_BYTES) as handle:
                state = torch.load(handle, map_location="cpu", weights_only=True)
        # Damaged files cause exceptions of many types in torch.
        except Exception as error:
            raise ArtefactError(
                "the checkpoint cannot be read",
                where=path,
                got=f"{type(error).__name__}: {error}"[:200],
                remedy="Delete the file; training then starts again.",
            ) from error
        if not isinstance(state, dict) or type(state.get("step")) is not int:
            raise ArtefactError(
                "the checkpoint has no step number",
                where=path,
                remedy="Delete the file; training then starts again.",
            )
        # The interrupted process may have continued beyond its last checkpoint.
        self._forget_after(state["step"])
        return state

    def save(self, state: Mapping[str, Any]) -> None:
        """Replace the checkpoint atomically.

        Raises:
            LightSimError: the file cannot be written.
        """
        import torch

        with whole_file(self._folder / CHECKPOINT_NAME) as temporary:
            torch.save(dict(state), temporary)

    def record(self, metrics: Mapping[str, float]) -> None:
        """Append a line to metrics.jsonl, with values rounded to six decimals.

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
        """Delete the checkpoint; the metrics remain."""
        (self._folder / CHECKPOINT_NAME).unlink(missing_ok=True)

    def _forget_after(self, step: int) -> None:
        """Remove the metrics of the steps that training will repeat."""
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
