"""The viewer in a browser: what a user sees and does in the page of `lightsim view`."""

from __future__ import annotations

import io
import logging
import shlex
import shutil
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from tests.app.browser_client import TIMEOUT_S, BrowserClient, wait_until
from tests.conftest import BuiltStreet

from lightsim import cli
from lightsim.app.options import ViewOptions
from lightsim.app.server import open_server, stop_server
from lightsim.app.start import first_state, view
from lightsim.app.viewer import Viewer
from lightsim.app.viewer_base import frame_of
from lightsim.build.workspace import Workspace
from lightsim.core.frames import quaternion_from_matrix
from lightsim.progress import SilentProgress
from lightsim.scenario.edits import read_scenario_request
from lightsim.store.exr import write_exr
from lightsim.store.images import read_srgb8

pytestmark = pytest.mark.browser
SIZE = {"width": 900, "height": 500}
FLAGS = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")


@pytest.fixture(scope="module")
def chromium() -> Generator[Any]:
    playwright = pytest.importorskip("playwright.sync_api", reason="needs the extra `browser`")
    names = ("chromium", "chromium-browser", "google-chrome")
    path = next(filter(None, map(shutil.which, names)), None)
    if path is None:
        pytest.skip(f"needs one of {', '.join(names)}")
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=path, args=list(FLAGS))
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def viewer(
    built_street: BuiltStreet, tmp_path_factory: pytest.TempPathFactory
) -> Generator[Viewer]:
    """The viewer of a copy of the built street."""
    pytest.importorskip("viser", reason="needs the extra `view`")
    work = tmp_path_factory.mktemp("viewed") / "work"
    shutil.copytree(built_street.work, work, ignore=shutil.ignore_patterns("scenarios", "view"))
    workspace = Workspace(work)
    state, name = first_state(workspace, "", "")
    server = open_server("127.0.0.1", 0, work / "scenarios")
    viewer = Viewer(server, workspace, state, SilentProgress(), name=name)
    yield viewer
    viewer.close()
    stop_server(server)


@pytest.fixture(scope="module")
def open_page(chromium: Any, viewer: Viewer) -> Callable[[], BrowserClient]:
    def opened() -> BrowserClient:
        url = f"http://127.0.0.1:{viewer.server.get_port()}"
        return BrowserClient(chromium.new_page(viewport=SIZE), url)

    return opened


@pytest.fixture(scope="module")
def client(open_page: Callable[[], BrowserClient]) -> BrowserClient:
    """The page of most tests."""
    client = open_page()
    client.ready()
    return client


@pytest.fixture(autouse=True)
def no_errors(client: BrowserClient, caplog: pytest.LogCaptureFixture) -> Generator[None]:
    """Neither page nor server report an error, and the page loads nothing from elsewhere."""
    yield
    assert not client.errors
    assert not client.foreign
    assert not [r.getMessage() for r in caplog.records if r.levelno >= logging.ERROR]


def test_a_sun_that_is_typed_makes_the_picture_of_the_shown_command(
    viewer: Viewer, client: BrowserClient
) -> None:
    client.wait_final("source")
    assert viewer.wait(TIMEOUT_S)
    shown = viewer._picture._shown
    assert shown is not None
    client.wait_picture(shown.recorded)
    client.type("Azimuth", "90")
    client.wait_final("sun:90.0,")
    after = [text for text in client.statuses() if "sun:90.0," in text]
    assert [text.split(" · ")[0] for text in after] == ["preview", "final"]
    client.open_tab("Output")
    command = client.page.locator("textarea").first.input_value()
    cli.main(shlex.split(command)[1:])
    frame = f"{viewer.state.stem}.png"
    (path,) = (viewer.workspace.root / "scenarios" / "edited").rglob(frame)
    wanted = read_srgb8(path)
    shown = viewer._picture._shown
    assert shown is not None
    assert shown.is_final
    np.testing.assert_array_equal(shown.relit, wanted)
    client.wait_picture(wanted)
    assert np.abs(wanted - shown.recorded.astype(np.float64)).mean() > 5.0
    client.open_tab("Light")


def test_a_reloaded_page_and_a_second_one_show_the_same_state(
    viewer: Viewer, client: BrowserClient, open_page: Callable[[], BrowserClient]
) -> None:
    client.type("Azimuth", "120")
    wait_until(lambda: viewer.state.sky.sky.startswith("sun:120.0"), "the sun on the server")
    before = viewer.state
    client.reload()
    # The server first adds a control with its initial value, and then sends the present one.
    wait_until(lambda: client.value("Azimuth") == "120", "the azimuth in the reloaded page")
    other = open_page()
    other.ready()
    wait_until(lambda: other.value("Azimuth") == "120", "the azimuth in the second page")
    other.type("Elevation", "30")
    wait_until(lambda: client.value("Elevation") == "30", "the elevation in the first page")
    client.wait_final("sun:120.0,30.0")
    client.open_tab("Actors")
    client.click("Undo")
    wait_until(lambda: viewer.state == before, "the state before the change")
    wait_until(lambda: other.value("Elevation") != "30", "the change in the second page")
    assert not other.errors
    other.page.close()
    client.open_tab("Light")


def test_looking_through_the_camera_places_the_view_at_its_pose(
    viewer: Viewer, client: BrowserClient
) -> None:
    assert viewer.wait(TIMEOUT_S)
    client.click("Look through the camera")
    frame = frame_of(viewer.state, viewer.editor.recorded)
    (camera,) = (one.camera for one in viewer.server.get_clients().values())
    pose = frame.world_from_camera

    def is_there() -> bool:
        turned = abs(float(camera.wxyz @ quaternion_from_matrix(pose.rotation)))
        return bool(np.abs(camera.position - pose.translation_m).max() < 1e-2 and turned > 1 - 1e-4)

    wait_until(is_there, "the pose of the recording's camera")
    lens = viewer.workspace.log.cameras[frame.camera_name]
    assert camera.fov > 0.9 * 2 * np.arctan(lens.height_px / 2 / lens.fy)
    client.click("Look through the camera")


def test_an_actor_is_selected_removed_and_restored(viewer: Viewer, client: BrowserClient) -> None:
    client.open_tab("Actors")
    actor_id = viewer.editor.recorded.placements[0].track.actor_id
    client.choose("Actor", actor_id)
    wait_until(lambda: viewer._edits.selected == actor_id, "the selection")
    client.click("Remove")
    removal = {"do": "remove", "actor": actor_id}
    wait_until(lambda: viewer.state.edits == (removal,), "the removal")
    assert viewer.wait(TIMEOUT_S)
    assert not viewer.scene_view._actors[actor_id].frame.visible
    client.click("Restore as recorded")
    wait_until(lambda: viewer.state.edits == (), "the restored actor")
    client.open_tab("Light")


def test_a_saved_scenario_is_the_state(viewer: Viewer, client: BrowserClient) -> None:
    client.open_tab("Output")
    client.type("Name", "evening")
    client.click("Save SCENARIO.json")
    path = viewer.folder / "evening.json"
    wait_until(path.is_file, "the file")
    request = read_scenario_request(path)
    assert request.name == "evening"
    assert request.sky == viewer.state.sky
    client.open_tab("Light")


def test_an_uploaded_sky_is_shown_and_a_broken_one_is_refused(
    viewer: Viewer, client: BrowserClient, tmp_path: Path, rng: np.random.Generator
) -> None:
    skies = viewer.folder / "skies"
    upload = client.page.locator("input[type=file]")
    broken = tmp_path / "broken.exr"
    broken.write_bytes(b"not a picture")
    before = viewer.state
    upload.set_input_files(broken)
    client.page.get_by_text("Not possible").first.wait_for()
    assert viewer.state == before
    assert not list(skies.iterdir())
    sky = tmp_path / "soft light.exr"
    write_exr(sky, rng.uniform(0.5, 1.0, (16, 32, 3)).astype(np.float32))
    upload.set_input_files(sky)
    wait_until(lambda: viewer.state != before, "the uploaded sky")
    assert Path(viewer.state.sky.sky).parent == skies.resolve()
    client.wait_final(Path(viewer.state.sky.sky).name)
    shown = viewer._picture._shown
    assert shown is not None
    client.wait_picture(shown.relit)


def test_the_exported_page_opens_from_a_file(viewer: Viewer, chromium: Any, tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    options = ViewOptions(export=page)
    view(viewer.workspace.root, options, SilentProgress(), lambda _: None)
    opened = BrowserClient(chromium.new_page(viewport=SIZE), page.as_uri())
    opened.page.locator("canvas[data-engine]").wait_for()
    pixels = np.asarray(Image.open(io.BytesIO(opened.page.screenshot())).convert("RGB"))
    assert pixels.std() > 10.0
    assert not opened.errors
    assert not opened.foreign
    opened.page.close()
