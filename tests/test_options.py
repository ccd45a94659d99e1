"""One list of options for Python and the command line, checked where the options are made."""

from __future__ import annotations

import copy
from dataclasses import fields

import pytest

from lightsim.api import BuildOptions, LogReading, RelightOptions
from lightsim.cli import main
from lightsim.core.sky_choice import SkyChoice
from lightsim.errors import InputError
from lightsim.render.options import LightChoice, RendererChoice
from lightsim.simulation.options import RenderOptions, SimulateOptions

READING = LogReading(source="log")
BUILD = BuildOptions(reading=READING)
RELIGHT = RelightOptions(name="noon")
RENDER = RenderOptions(what=("depth",))


@pytest.mark.parametrize(
    ("options", "name"),
    [
        *((BUILD, name) for name in ("preset", "colour", "gps", "sky_model", "device")),
        *((RendererChoice(), name) for name in ("renderer", "backend")),
        (LightChoice(), "renderer"),
        (READING, "dataset"),
        (RELIGHT, "method"),
    ],
)
def test_a_word_that_is_no_choice_is_refused_in_python_too(options: object, name: str) -> None:
    wrong = copy.copy(options)
    object.__setattr__(wrong, name, "nonsense")  # The test run checks types before that.
    option = name.replace("_", "-")
    with pytest.raises(InputError, match=f"--{option}.*nonsense.*expected one of"):
        wrong.__post_init__()  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("command", "options"),
    [("build", BUILD), ("build", READING), ("relight", RELIGHT), ("render", RENDER),
     ("render", RendererChoice()), ("relight", LightChoice()), ("simulate", LightChoice())],
)  # fmt: skip
def test_the_command_line_has_every_option(
    command: str, options: object, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        main([command, "--help"])
    text = capsys.readouterr().out
    names = {field.name for field in fields(options)} - {"reading", "source"}  # type: ignore[arg-type]
    assert not [name for name in names if f"--{name.replace('_', '-')}" not in text]


def test_names_and_skies_are_read_from_the_command_line(monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[RelightOptions] = []

    def relight(work: object, options: RelightOptions, progress: object) -> list[object]:
        given.append(options)
        return []

    monkeypatch.setattr("lightsim.simulation.relight.relight", relight)
    main(["relight", "w", "--name", "n", "--sky", "sun:10,20", "a.hdr", "--cameras", "left, right"])
    assert given == [
        RelightOptions(name="n", sky=("sun:10,20", "a.hdr"), cameras=("left", "right"))
    ]


def test_a_scenarios_name_and_sky_stand_in_for_options_that_were_not_given() -> None:
    asked = SkyChoice("sun:120,30", yaw_deg=10.0, sun_factor=0.5)
    found = SimulateOptions(sky_yaw_deg=20.0).completed("street", asked)
    assert (found.name, found.sky, found.sky_yaw_deg, found.sun_factor) == (
        "street",
        ("sun:120,30",),
        20.0,
        0.5,
    )
    other = SimulateOptions(name="mine", sky=("source",)).completed("street", asked)
    assert (other.name, other.sky, other.sun_factor) == ("mine", ("source",), 1.0)
    with pytest.raises(InputError, match="--name"):
        SimulateOptions().completed("../street", asked)
