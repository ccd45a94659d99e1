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
