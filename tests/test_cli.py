"""The command line: exit codes, one-line errors, and help that lists every command."""

from __future__ import annotations

import os
import shlex
import signal
from pathlib import Path

import numpy as np
import pytest
import torch
from tests.render.rendering_scenes import sun_sky

from lightsim import cli
from lightsim.cli.doctor import Doctor
from lightsim.core.version import __version__
from lightsim.store.images import read_srgb8, write_exr, write_png
from lightsim_lab.synthetic import shipped_street

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


def test_the_version_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("--version") == 0
    assert capsys.readouterr().out == f"lightsim {__version__}\n"


def test_help_names_arguments_and_offers_no_none(capsys: pytest.CaptureFixture[str]) -> None:
    """Work folders were PATH, and options without a default took the word None."""
    assert run("simulate", "--help") == 0
    text = capsys.readouterr().out
    assert "WORK SCENARIO.json" in text
    assert "{None" not in text
    assert run("build", "log", "--work", "w", "--heading-deg", "north") == 2
    assert "None" not in capsys.readouterr().err.partition("Argument helptext")[0]


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
        ("evaluate", "compare", "nowhere.json", "nowhere.json"),
        ("batch", "status", "nowhere"),
        ("export", "nowhere", "--out", "o"),
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

    monkeypatch.setattr(Doctor, "run", interrupt)
    assert run("doctor") == 130


def test_an_interruption_that_a_library_wraps_is_130(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Stopped within Dr.Jit, `synthesize` called it a fault of LightSim."""

    def interrupt(command: object) -> None:
        raise RuntimeError("error while performing a custom operation") from KeyboardInterrupt()

    monkeypatch.setattr(Doctor, "run", interrupt)
    assert run("doctor") == 130
    assert "interrupted" in capsys.readouterr().err


def test_doctor_speaks(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("doctor") == 0
    assert "numpy" in capsys.readouterr().out


def test_a_sky_can_be_shown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "sky.png"
    assert run("sky", "show", "sun:120,35", "--out", str(out)) == 0
    picture = read_srgb8(out)
    row, column = np.argwhere((picture == (255, 64, 32)).all(-1)).mean(0) / picture.shape[:2]
    # A ring marks the sun. The centre column looks along world +x: without a log, due east.
    assert column == pytest.approx(0.5 + 30 / 360, abs=0.01)
    assert row == pytest.approx((90 - 35) / 180, abs=0.01)
    lines = capsys.readouterr().out.splitlines()
    assert "sun: azimuth 120.0, elevation 35.0 degrees (--sky sun:120.0,35.0)" in lines


@pytest.mark.parametrize(
    ("option", "value"),
    [
        *(("--image-scale", v) for v in ("nan", "inf", "0", "-0.5", "1.5")),
        *(("--exposure-ev", v) for v in ("nan", "inf", "-inf", "1e9")),
        *(("--sky-yaw-deg", v) for v in ("nan", "inf")),
        *(("--sky-scale", v) for v in ("nan", "0", "-1", "inf", "bright")),
        ("--seed", "-1"),
        *(
            ("--name", v)
            for v in ("", ".", "..", "../x", "/x", "a/b", "a\n", "-n", ".n", "x" * 200)
        ),
    ],
)
def test_numbers_and_names_out_of_range_are_1_before_anything_is_done(
    option: str, value: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = {"--name": "n", "--sky": "sun:10,20", option: value}
    words = [f"{name}={text}" for name, text in given.items()]
    assert run("relight", str(tmp_path), *words) == 1
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert option in line
    assert "expected" in line
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("option", "value"),
    [
        *(("--image-scale", v) for v in ("nan", "0", "-1", "2")),
        *(("--heading-deg", v) for v in ("nan", "inf", "400")),
        *(("--hold-out", v) for v in ("-1", "1")),
        ("--seed", "-1"),
        ("--neural-steps", "-1"),
        ("--neural-steps", "1" + "0" * 400),
        ("--seed", "1" + "0" * 400),
    ],
)
def test_a_build_checks_its_numbers(
    option: str, value: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("build", str(tmp_path), f"--work={tmp_path}", f"{option}={value}") == 1
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert option in line
    assert "expected" in line
    assert "e+" not in line.partition("expected")[2]


@pytest.mark.skipif(torch.cuda.is_available(), reason="a CUDA device is present")
def test_a_build_without_its_device_makes_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The device was looked for when the field was trained, minutes later."""
    work = tmp_path / "work"
    assert run("build", str(shipped_street() / "log"), f"--work={work}", "--device=cuda") == 1
    assert "--device cuda: no CUDA device is available" in capsys.readouterr().err
    assert not work.exists()


@pytest.mark.parametrize(
    ("option", "value"),
    [("--latitude", "95"), ("--latitude", "nan"), ("--longitude", "inf"), ("--heading-deg", "nan"),
     ("--move-sun", "10,-5"), ("--move-sun", "nan,5"), ("--sun-factor", "-1")],
)  # fmt: skip
def test_places_and_suns_that_cannot_be_are_named(
    option: str, value: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    picture = tmp_path / "panorama.png"
    write_png(picture, np.full((32, 64, 3), 120, np.uint8))
    place = {"--time": "2024-06-01T12:00:00Z", "--latitude": "50", "--longitude": "10",
             "--heading-deg": "0", "--out": str(tmp_path / "sky"), option: value}  # fmt: skip
    words = [f"{name}={text}" for name, text in place.items()]
    assert run("sky", "estimate", str(picture), *words) == 1
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert option in line
    assert not (tmp_path / "sky").exists()


@pytest.mark.parametrize(
    ("sky", "wrong"),
    [
        ("nowhere.hdr", "no such file"),
        ("~/no/where", "no such file"),
        ("nowhere.exr#Layer", "no such file"),
        (".", "is a folder"),
        ("noon", "neither a file nor a known form"),
        ("", "no sky is named"),
        ("Sun:10,20", "Write sun in lower case"),
        ("a" * 5000, "neither a file"),
        ("a\0b", "neither a file"),
        ("sun:nan,5", "the sun cannot be read"),
        ("sun:120", "the sun cannot be read"),
        ("sun:5,-5", "elevation is out of range"),
    ],
)
def test_words_that_name_no_sky_are_refused(
    sky: str, wrong: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("sky", "show", sky) == 1
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert wrong in line
    assert "expected" in line
    assert len(line) < 2000


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("--sky", "noon", "--sky noon: the sky is neither"),
        ("--weights", "none.bin", "--weights none.bin: no such file"),
        ("--source-sky", "none.hdr", "--source-sky none.hdr: no such file"),
    ],
)
def test_a_wrong_file_is_reported_before_the_twin_is_read(
    option: str, value: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("relight", "nowhere", "--name", "n", option, value) == 1
    assert message in capsys.readouterr().err


def test_the_documented_estimate_of_a_sky_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The guide's command gave no heading, without which place and time are refused."""
    page = Path(__file__).parents[1] / "docs" / "guides" / "skies.md"
    (line,) = [x for x in page.read_text().splitlines() if x.startswith("lightsim sky estimate P")]
    monkeypatch.chdir(tmp_path)
    write_png(tmp_path / "PANORAMA.png", np.full((64, 128, 3), 120, np.uint8))
    assert run(*shlex.split(line)[1:]) == 0
    assert (tmp_path / "sky" / "sun.json").is_file()


def test_pictures_of_skies_are_png_in_any_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A name with another suffix became a PNG, and a missing folder an error after the work."""
    assert run("sky", "show", "sun:180,40", "--out", str(tmp_path / "s.gif")) == 1
    assert "expected NAME.png" in capsys.readouterr().err
    assert run("sky", "show", "sun:180,40", "--out", str(tmp_path / "new" / "s.png")) == 0
    assert (tmp_path / "new" / "s.png").is_file()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("show", "time:2019-05-10T19:00:00Z"), "Use sun:AZIMUTH,ELEVATION instead.\n"),
        (("estimate", "a.hdr", "--out", "o"), "HDR sky already"),
    ],
)
def test_remedies_of_skies_without_a_log_apply(
    words: tuple[str, ...], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """They proposed to build with a place, and to download the picture again."""
    assert run("sky", *words) == 1
    assert message in capsys.readouterr().err


def test_export_lists_the_scenarios_of_a_work_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A work folder was taken for a recording."""
    for name in ("noon", "day/source"):
        folder = tmp_path / "scenarios" / name
        folder.mkdir(parents=True)
        (folder / "artefact.json").write_text("{}")
    (tmp_path / "build.json").write_text("{}")
    for given in (tmp_path, tmp_path / "scenarios"):
        assert run("export", str(given), "--format", "kitti", "--out", str(tmp_path / "e")) == 1
        line = capsys.readouterr().err
        assert str(tmp_path / "scenarios" / "noon") in line
        assert str(tmp_path / "scenarios" / "day" / "source") in line


def test_a_picture_of_8_bits_is_to_be_estimated_from(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_png(tmp_path / "a.png", np.full((16, 32, 3), 90, np.uint8))
    assert run("sky", "show", str(tmp_path / "a.png")) == 1
    assert "`lightsim sky estimate a.png --out DIR`" in capsys.readouterr().err


@pytest.mark.parametrize("heading_deg", [None, 200.0])
def test_a_file_is_described_in_the_words_of_options(
    heading_deg: float | None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The sun as --sky sun: takes it, from the file's north where it has one; notes as lines."""
    radiance = sun_sky(np.radians(30.0), 35.0, 0.1).radiance
    numbers = {} if heading_deg is None else {"headingDeg": heading_deg}
    write_exr(
        tmp_path / "a.exr", np.pad(radiance, ((0, 0), (2, 2), (0, 0)), "wrap"), False, "", numbers
    )
    assert run("sky", "show", str(tmp_path / "a.exr"), "--out", str(tmp_path / "a.png")) == 0
    printed = capsys.readouterr()
    lines = printed.out.splitlines()
    azimuth = 60.0 if heading_deg is None else 170.0
    (sun,) = [line for line in lines if line.startswith("sun: ")]
    words = sun[sun.index("sun:", 4) : -1]
    found, elevation = map(float, words.removeprefix("sun:").split(","))
    assert (found, elevation) == (pytest.approx(azimuth, abs=0.7), pytest.approx(35.0, abs=0.3))
    assert "note: resampled from 516x256 to 512x256 px" in lines
    assert not any("[" in line for line in lines)
    assert not printed.err
    assert run("sky", "show", words, "--out", str(tmp_path / "b.png")) == 0


def test_a_sky_lit_only_from_below_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    radiance = np.zeros((32, 64, 3), np.float32)
    radiance[20:] = 1.0
    write_exr(tmp_path / "flipped.exr", radiance)
    assert run("sky", "show", str(tmp_path / "flipped.exr"), "--out", str(tmp_path / "o.png")) == 1
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "below the horizon" in line


def test_what_should_not_happen_is_one_line_that_asks_for_a_report(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(command: object) -> None:
        raise ZeroDivisionError("two\nlines")

    monkeypatch.setattr(Doctor, "run", fail)
    assert run("doctor") == 1
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "ZeroDivisionError: two lines. Please report it" in line
    with pytest.raises(ZeroDivisionError):
        cli.main(["doctor", "-v"])


def test_sigterm_ends_a_command_like_ctrl_c(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(Doctor, "run", lambda _: os.kill(os.getpid(), signal.SIGTERM))
    before = signal.getsignal(signal.SIGTERM)
    assert run("doctor") == 130
    assert "interrupted" in capsys.readouterr().err
    assert signal.getsignal(signal.SIGTERM) is before


def test_a_wrong_panorama_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = tmp_path / "narrow.png"
    write_png(picture, np.full((32, 40, 3), 90, np.uint8))
    assert run("sky", "estimate", str(picture), "--out", str(tmp_path / "sky")) == 1
    errors = capsys.readouterr().err.strip().splitlines()
    assert len(errors) == 1
    assert str(picture) in errors[0]
    assert "twice as wide" in errors[0]
