"""Benchmark of the viewer: start, preview while a control is dragged, final picture, memory.

    python benchmarks/bench_viewer.py WORK

Pictures are made in this process, without a browser. `key` is the time from a change of the sun to
the preview that the clients receive, JPEG included; `final` from the end of the change to the
final picture, without the 0.3 s for which the viewer waits.
"""

from __future__ import annotations

import argparse
import io
import resource
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from lightsim.app.picture_layers import ShownPicture
from lightsim.app.server import open_server, stop_server
from lightsim.app.start import first_state
from lightsim.app.viewer import FINAL_DELAY_S, Viewer
from lightsim.build.workspace import Workspace
from lightsim.core.sky_choice import SkyChoice
from lightsim.progress import SilentProgress

_CHANGES = 40
_FINALS = 5
# Time after a final picture after which the 3D view begins to get its light, in seconds.
_REST_S = 1.5


def main() -> None:
    """Print the table of one work folder."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("work", type=Path)
    arguments = parser.parse_args()
    start = time.perf_counter()
    workspace = Workspace(arguments.work)
    state, _ = first_state(workspace, "", "")
    server = open_server("127.0.0.1", 0)
    viewer = Viewer(server, workspace, state, SilentProgress())
    ready_s = time.perf_counter() - start
    viewer.wait(600)
    try:
        rows = [("start to controls", [ready_s]), *measured(viewer)]
    finally:
        viewer.close()
        stop_server(server)
    camera = viewer.workspace.log.cameras[state.camera]
    sys.stdout.write(f"{camera.width_px}x{camera.height_px}\n| | median s | p95 s |\n|-|-|-|\n")
    for name, seconds in rows:
        median, late = np.percentile(seconds, [50, 95])
        sys.stdout.write(f"| {name} | {median:.2f} | {late:.2f} |\n")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    sys.stdout.write(f"peak memory {peak:.2f} GB\n")


def measured(viewer: Viewer) -> list[tuple[str, list[float]]]:
    """Return seconds of previews, of final pictures and of frames that were not traced."""
    pictures: list[tuple[float, ShownPicture]] = []
    viewer.on_picture = lambda shown: pictures.append((time.perf_counter(), shown))
    keys, finals = [], []
    change(viewer, 90.0)
    wait_for(pictures, is_final=True)
    # The light of the 3D view is traced once for each frame, which takes both cores for seconds.
    time.sleep(_REST_S)
    viewer.wait(600)
    for number in range(_CHANGES):
        pictures.clear()
        begin = change(viewer, 91.0 + number)
        wait_for(pictures, is_final=False)
        encoded(pictures[-1][1])
        keys.append(time.perf_counter() - begin)
    wait_for(pictures, is_final=True)
    for number in range(_FINALS):
        pictures.clear()
        begin = change(viewer, 180.0 + 7 * number)
        finals.append(wait_for(pictures, is_final=True) - begin - FINAL_DELAY_S)
    return [("key to preview", keys), ("final picture", finals)]


def change(viewer: Viewer, azimuth_deg: float) -> float:
    """Move the sun and return the time."""
    begin = time.perf_counter()
    viewer.change(replace(viewer.state, sky=SkyChoice(f"sun:{azimuth_deg},40")))
    return begin


def wait_for(pictures: list[tuple[float, ShownPicture]], *, is_final: bool) -> float:
    """Wait for a picture and return its time."""
    while True:
        for moment, shown in tuple(pictures):
            if shown.is_final == is_final:
                return moment
        time.sleep(0.002)


def encoded(shown: ShownPicture) -> bytes:
    """Return the picture as the clients receive it."""
    stream = io.BytesIO()
    Image.fromarray(shown.relit).save(stream, "JPEG", quality=85)
    return stream.getvalue()


if __name__ == "__main__":
    main()
