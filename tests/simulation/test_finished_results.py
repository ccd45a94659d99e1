"""Commands that are repeated: finished results cost no tracing."""

from __future__ import annotations

from pathlib import Path

import pytest
from tests.render.rendering_scenes import constant_sky
from tests.simulation.test_moving_shadow import recorded
from tests.tiny_world import scenario_of

from lightsim.core.sky_choice import SkyChoice
from lightsim.progress import SilentProgress
from lightsim.simulation import relight
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
