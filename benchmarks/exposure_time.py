"""How long a log's cameras expose, by the edges of static things that pass by.

    python benchmarks/exposure_time.py WORK [--step 4]

While the shutter is open an edge that moves across itself by L pixels widens by L^2 / 12. Per
camera: edges by the speed at which the ego vehicle lets them pass, and the variance at which their
widths pile up; if it does not grow, the exposure is shorter than the widths can tell. Markdown.
"""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict
from itertools import pairwise
from pathlib import Path

import numpy as np

from lightsim.build.workspace import Workspace
from lightsim.core.buffers import BACKGROUND
from lightsim.core.colour import CLIPPED_CODE, linear_from_srgb8, luminance, srgb_from_linear
from lightsim.relighting.physical.edge_widths import find_edges, half_sample_mode
from lightsim.render.frame_renderer import FrameRenderer
from lightsim.render.transport.matrix import TransportConfig
from lightsim.scenario.replay import replay

_SPEEDS = (0, 30, 100, 300, 1000, np.inf)
_AROUND_S = 0.005
_FEWEST = 100


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("work", type=Path)
    parser.add_argument("--step", type=int, default=4, help="one frame in this many")
    options = parser.parse_args()
    found = _edges(Workspace(options.work, is_stale_allowed=True), options.step)
    names = " | ".join(f"{a:g} to {b:g} px/s" for a, b in pairwise(_SPEEDS))
    lines = [f"| camera | {names} |", "|---" + "|---:" * (len(_SPEEDS) - 1) + "|"]
    for camera, rows in found.items():
        speed, spread = np.concatenate(rows).T
        cells = []
        for low, high in pairwise(_SPEEDS):
            chosen = spread[(speed >= low) & (speed < high)]
            is_enough = len(chosen) >= _FEWEST
            cells.append(f"{half_sample_mode(chosen):.2f} ({len(chosen)})" if is_enough else "-")
        lines.append(f"| {camera} | {' | '.join(cells)} |")
    sys.stdout.write("\n".join(lines) + "\n")


def _edges(work: Workspace, step: int) -> dict[str, list[np.ndarray]]:
    """(speed in px/s across the edge, spread in px^2) of static edges, by camera."""
    log = work.log_at(work.reading.image_scale)
    frames = [f for name in log.cameras for f in log.frames_of(name)[::step]]
    scenario = replay(work.twin, "as recorded", tuple(frames), "recorded")
    renderer = FrameRenderer(
        work.twin.assets.background, work.unobserved_occluders, TransportConfig(), 0
    )
    found: dict[str, list[np.ndarray]] = defaultdict(list)
    for frame in frames:
        camera = log.cameras[frame.camera_name]
        buffers = renderer.geometry(scenario, frame, camera)
        srgb8 = frame.load_srgb8()
        nowhere = np.zeros(srgb8.shape[:2], dtype=bool)
        left_out = (srgb8 >= CLIPPED_CODE).any(axis=-1) | (buffers.actor_index != BACKGROUND)
        left_out |= log.ego_vehicle_masks.get(camera.name, nowhere)
        codes = srgb_from_linear(luminance(linear_from_srgb8(srgb8))).astype(np.float64)
        edges = find_edges(codes, left_out)
        rows, columns = edges.pixel.T
        points = buffers.position_world[rows, columns].astype(np.float64)
        ends = []
        here = log.ego.held(frame.time_ns)
        for half_s in (-_AROUND_S, _AROUND_S):
            then = log.ego.held(frame.time_ns + round(half_s * 1e9))
            pose = then @ here.inverse() @ frame.world_from_camera
            ends.append(camera.project(pose.inverse().apply(points))[0][:, ::-1])
        motion = (ends[1] - ends[0]) / (2 * _AROUND_S)
        speed = np.abs((motion * edges.across).sum(axis=1))
        found[camera.name].append(np.stack([speed, edges.spread_px2], axis=1))
    return found


if __name__ == "__main__":
    main()
