"""What long work says of itself."""

from __future__ import annotations

import pytest

from lightsim.progress import LineProgress


@pytest.mark.parametrize(("count", "said"), [(2, "  work: 2/2, "), (0, "")])
def test_work_is_told_and_no_work_is_not(
    count: int, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert list(LineProgress().track(range(count), "work")) == list(range(count))
    line = capsys.readouterr().err
    assert line.startswith(said)
    assert bool(line) == bool(count)


def test_the_last_item_is_printed_once(capsys: pytest.CaptureFixture[str]) -> None:
    """Slow items print a line each: the end repeated the line of the last one."""
    list(LineProgress(every_s=0.0).track(range(2), "work"))
    first, last = capsys.readouterr().err.splitlines()
    assert first.startswith("  work: 1/2, ")
    assert first.endswith(" s left")
    assert last.startswith("  work: 2/2, ")
    assert not last.endswith(" left")
