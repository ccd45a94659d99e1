"""Results that exist already: repeated commands cost no tracing, others are refused or found."""

from __future__ import annotations

from pathlib import Path

import pytest
from tests.render.rendering_scenes import constant_sky
from tests.simulation.test_moving_shadow import recorded
from tests.tiny_world import scenario_of

from lightsim.app.start import scenario_file
from lightsim.core.sky_choice import SkyChoice
from lightsim.errors import InputError
from lightsim.progress import SilentProgress
from lightsim.simulation import claims, relight
from lightsim.simulation.claims import Job
from lightsim.simulation.options import RelightOptions
from lightsim.store.artefact import ArtefactKey, make_artefact


class ResolvedError(Exception):
    """Raised in place of the sky, which takes half a minute on a real log."""


def resolved(*_: object) -> None:
    raise ResolvedError


@pytest.mark.parametrize("is_whole", [True, False])
def test_only_skies_of_unfinished_results_are_resolved(
    is_whole: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    key = ArtefactKey("relight", {}, {}, {}, 0)
    job = Job(tmp_path / "scenarios" / "x", SkyChoice("sun:180,60"), "vp9", {}, key)

    def fill(folder: Path) -> tuple[str, ...]:
        (folder / "report.html").write_text("page")
        return ()

    make_artefact(job.folder, key, fill)
    if not is_whole:
        (job.folder / "report.html").unlink()
    monkeypatch.setattr(relight, "plan_jobs", lambda *_: [job])
    monkeypatch.setattr(relight, "resolve_sky", resolved)
    work = recorded(constant_sky((0.6, 0.6, 0.6)))
    work.root = tmp_path
    scenario = scenario_of(work)

    def make() -> list[Path]:
        options = RelightOptions(name="x")
        return relight.make_frames(work, scenario, options, SilentProgress())

    if is_whole:
        assert make() == [job.folder]
    else:
        with pytest.raises(ResolvedError):
            make()


def test_other_settings_are_named_one_by_one(tmp_path: Path) -> None:
    """A sky was printed with all its settings, equal ones included."""
    before = {"sky": {"sky": "sun:1,2", "scale": "auto"}, "linear": False, "seed": 0}
    key = ArtefactKey("relight", {}, {k: v for k, v in before.items() if k != "seed"}, {}, 0)
    make_artefact(tmp_path / "x", key, lambda _: ())
    now = {**before, "sky": {"sky": "sun:3,4", "scale": "auto"}}
    with pytest.raises(InputError, match=r"got sky = sun:1,2, expected sky = sun:3,4\. "):
        claims._refuse_other_settings(tmp_path / "x", now)


def test_results_of_one_sky_and_of_several_share_no_name(tmp_path: Path) -> None:
    one, several = tmp_path / "one", tmp_path / "several"
    for folder in (one, several / "sun_1_2"):
        make_artefact(folder, ArtefactKey("relight", {}, {}, {}, 0), lambda _: ())
    claims._refuse_other_layout(one, [one])
    claims._refuse_other_layout(several, [several / "sun_1_2", several / "source"])
    for base, folders in ((one, [one / "a", one / "b"]), (several, [several])):
        with pytest.raises(InputError, match="cannot share a name"):
            claims._refuse_other_layout(base, folders)


def test_the_viewer_finds_results_and_lists_them(tmp_path: Path) -> None:
    """A misspelt name was a JSON file to be corrected."""
    (tmp_path / "build.json").write_text("{}")
    for name in ("noon", "day/source"):
        folder = tmp_path / "scenarios" / name
        folder.mkdir(parents=True)
        for file in ("artefact.json", "scenario.json"):
            (folder / file).write_text("{}")
        assert scenario_file(tmp_path, name) == folder / "scenario.json"
    with pytest.raises(InputError, match=r"--scenario non.*expected a SCENARIO\.json.*noon"):
        scenario_file(tmp_path, "non")
