"""The command line: exit codes, one-line errors, and help that lists every command."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lightsim import cli
from lightsim.store.images import write_png

COMMANDS = ["build", "relight", "render", "sky", "evaluate", "synthesize", "demo", "doctor"]


def run(*arguments: str) -> int:
    """Exit code of a command line."""
    try:
        cli.main(arguments)
    except SystemExit as stop:
        return int(stop.code or 0)
    return 0


def test_help_lists_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("--help") == 0
    text = capsys.readouterr().out
    assert all(command in text for command in COMMANDS)


@pytest.mark.parametrize("wrong", [("nonsense",), ("build",), ("relight", "w", "--frames")])
def test_wrong_usage_is_2(wrong: tuple[str, ...]) -> None:
    assert run(*wrong) == 2


@pytest.mark.parametrize(
    "command",
    [
        ("build", "nowhere", "--work", "w"),
        ("relight", "nowhere", "--name", "n", "--sky", "sun:10,20"),
        ("status", "nowhere"),
        ("evaluate", "frames", "nowhere"),
        ("sky", "show", "nowhere.hdr"),
        ("sky", "estimate", "nowhere.png", "--out", "o"),
    ],
)
def test_our_errors_are_1_and_one_line(
    command: tuple[str, ...],
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(*command) == 1
    errors = capsys.readouterr().err.strip().splitlines()
    assert len(errors) == 1
    assert "nowhere" in errors[0]


def test_interruption_is_130(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(command: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "run", interrupt)
    assert run("doctor") == 130


def test_doctor_speaks(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("doctor") == 0
    assert "numpy" in capsys.readouterr().out


def test_a_sky_can_be_shown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "sky.png"
    assert run("sky", "show", "sun:120,35", "--out", str(out)) == 0
    assert out.stat().st_size > 1000
    assert "sun_direction_world" in capsys.readouterr().out


def test_a_wrong_panorama_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = tmp_path / "narrow.png"
    write_png(picture, np.full((32, 40, 3), 90, np.uint8))
    assert run("sky", "estimate", str(picture), "--out", str(tmp_path / "sky")) == 1
    errors = capsys.readouterr().err.strip().splitlines()
    assert len(errors) == 1
    assert str(picture) in errors[0]
    assert "twice as wide" in errors[0]
