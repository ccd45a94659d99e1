"""Selection of frames of a log."""

from __future__ import annotations

from dataclasses import dataclass

from lightsim.errors import InputError


@dataclass(frozen=True)
class FrameSelection:
    """START:STOP[:STEP] over frame indices; as in Python, STOP is not included."""

    start: int = 0
    stop: int | None = None
    step: int = 1

    @staticmethod
    def parse(text: str) -> FrameSelection:
        """Parse the words of the command line; "" selects all frames.

        Raises:
            InputError: not of the form START:STOP[:STEP] with 0 <= START < STOP and STEP >= 1.
        """
        if not text:
            return FrameSelection()
        parts = text.split(":")
        # isdigit alone accepts digits of other scripts; nine digits exceed every log.
        is_number = [part.isascii() and part.isdigit() and len(part) < 9 for part in parts]
        is_form = len(parts) in (2, 3) and all(
            ok or not part for ok, part in zip(is_number, parts, strict=True)
        )
        if is_form:
            numbers = [int(part) if part else None for part in parts]
            start, stop, step = numbers[0] or 0, numbers[1], (numbers + [None])[2]
            step = 1 if step is None else step
            if step >= 1 and (stop is None or start < stop):
                return FrameSelection(start, stop, step)
        raise InputError(
            "not a range of frames",
            where="--frames",
            got=repr(text),
            expected="START:STOP or START:STOP:STEP, such as 42:60 or 0:80:2 (STOP not included)",
        )

    def holds(self, number: int) -> bool:
        """Return whether the frame with this index is selected."""
        is_inside = number >= self.start and (self.stop is None or number < self.stop)
        return is_inside and (number - self.start) % self.step == 0
