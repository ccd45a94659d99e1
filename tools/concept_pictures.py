"""Make the figures of docs/concepts from a finished build, one WebP file a page.

lightsim demo --out out/demo
python tools/concept_pictures.py out/demo/street --out docs/pictures/concepts

Relit and edited frames are written below WORK/scenarios, as `lightsim relight` and `simulate` do.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from lightsim import LogReading, RelightOptions, SimulateOptions
from lightsim.api import load_log, relight, simulate
from lightsim.build.workspace import Workspace
from lightsim.core.camera import PinholeCamera
from lightsim.core.colour import srgb8_from_linear
from lightsim.core.dome import SkyDome
from lightsim.core.mesh import Provenance, TriMesh
from lightsim.core.sensors import CameraFrame, LidarSweep
from lightsim.lighting.sky.clear_sky import clear_sky
from lightsim.lighting.target_sky import towards_sun
from lightsim.render.frame_renderer import FrameRenderer, TransportFrame
from lightsim.render.gbuffers import cast_primary_rays
from lightsim.render.scene import make_static_scene, place
from lightsim.render.transport.matrix import TransportConfig
from lightsim.scenario.replay import replay
from lightsim.store.images import read_srgb8
from lightsim.view.figures import (
    depth_colours,
    dome_preview,
    normal_colours,
    ratio_grey,
    strip,
    tone_mapped,
)

Picture = np.ndarray[Any, np.dtype[np.uint8]]
TARGET_DEG = (200.0, 45.0)
"""Azimuth from true north and elevation of the target sun."""
TILE_PX = 480
"""Width of one picture of a figure; pages show figures some 900 px wide."""
SLICE_M = (16.0, 9.0)
"""Half the width and the height of the slice through the signed distance field."""
REACH_M = 20.0
"""Half the width of the view of a LiDAR sweep from above."""
_DOT_PX = 4
"""Edge of a LiDAR return in that view, before it is reduced to half."""
PROVENANCE_COLOURS = {
    Provenance.MEASURED: (90, 160, 90),
    Provenance.MIRRORED: (70, 120, 200),
    Provenance.INTERPOLATED: (230, 190, 70),
    Provenance.INFERRED: (220, 110, 60),
    Provenance.BACKGROUND_PROXY: (150, 150, 160),
}


@dataclass(frozen=True)
class View:
    """One recorded frame of a build, and what the figures show of it."""

    root: Path
    camera_name: str
    stem: str

    @cached_property
    def work(self) -> Workspace:
        """The build."""
        return Workspace(self.root)

    @cached_property
    def frame(self) -> CameraFrame:
        """The recorded frame."""
        frames = self.work.log.frames_of(self.camera_name)
        return next(frame for frame in frames if frame.stem == self.stem)

    @property
    def camera(self) -> PinholeCamera:
        """Intrinsics at the build's image scale."""
        return self.work.log.cameras[self.camera_name]

    @cached_property
    def recorded(self) -> Picture:
        """The recorded picture."""
        return self.frame.load_srgb8()

    @cached_property
    def traced(self) -> TransportFrame:
        """The frame's light transport."""
        twin = self.work.twin
        renderer = FrameRenderer(
            twin.assets.background,
            self.work.unobserved_occluders,
            TransportConfig(),
            seed=0,
            recorded_sun=self.work.sky.dome.sun,
        )
        return renderer.trace(replay(twin, "figures", [self.frame]), self.frame, self.camera)

    @cached_property
    def target_sky(self) -> SkyDome:
        """A clear sky under the target sun, turbidity 3."""
        direction, _ = towards_sun(*TARGET_DEG, self.work.log.geo)
        return clear_sky(direction, 3.0, height_px=256)

    @cached_property
    def sweep(self) -> LidarSweep:
        """The sweep nearest in time to the frame."""
        sweeps = self.work.log.sweeps
        return min(sweeps, key=lambda s: abs(s.time_ns - self.frame.time_ns)).load()

    def coloured(self, background: TriMesh, colour_of: Callable[[TriMesh], Any]) -> Picture:
        """The static scene with a colour for every face or texel.

        Args:
            background: what is shown, frame `world`.
            colour_of: colours of a mesh's faces, or None for the mesh's own colours.
        """
        scene = place(make_static_scene([background]), _nobody(self), self.frame.time_ns)
        uv = self.camera.pixel_centres().reshape(-1, 2)
        seen = cast_primary_rays(scene, self.camera, self.frame, uv)
        picture = np.full((self.camera.height_px * self.camera.width_px, 3), 24, np.uint8)
        colours = colour_of(background)
        if colours is None:
            picture[seen.rows] = srgb8_from_linear(seen.base_colour)
        else:
            picture[seen.rows] = colours[seen.hits.face_index]
        return picture.reshape(self.camera.height_px, self.camera.width_px, 3)


def _nobody(view: View) -> Any:
    scenario = replay(view.work.twin, "figures", [view.frame])
    return replace(scenario, placements=())


def log_figure(view: View) -> Picture:
    """Returns of the nearest sweep on the recorded picture, coloured by distance."""
    uv, inside = view.frame.project(view.camera, view.sweep.points_world)
    distance = np.linalg.norm(
        view.sweep.points_world - view.frame.world_from_camera.translation_m, axis=1
    )
    colours = depth_colours(distance[None].astype(np.float32))[0]
    picture = view.recorded.copy()
    for (u, v), colour in zip(uv[inside].astype(int), colours[inside], strict=True):
        picture[v : v + 2, u : u + 2] = colour
    return strip([view.recorded, picture])


def masks_figure(view: View) -> Picture:
    """The recorded picture, and its sky matte in blue."""
    alpha = view.work.sky_matte(view.frame)[..., None]
    blue = np.array([40, 110, 255])
    tinted = view.recorded * (1 - 0.75 * alpha) + 0.75 * alpha * blue
    return strip([view.recorded, tinted.astype(np.uint8)])


def fields_figure(view: View) -> Picture:
    """A vertical slice across the street through the fused signed distances."""
    grid = view.work.fused.background[0]
    middle = view.frame.world_from_camera.translation_m
    path = view.work.fused.path_m
    ahead = path[-1, :2] - path[0, :2]
    across = np.array([-ahead[1], ahead[0]]) / np.linalg.norm(ahead)
    step_m = grid.voxel_m / 2
    s = np.arange(-SLICE_M[0], SLICE_M[0], step_m)
    z = middle[2] - 3.0 + np.arange(SLICE_M[1], 0, -step_m)
    x, y = (middle[k] + across[k] * s for k in (0, 1))
    points = np.stack(
        [np.broadcast_to(x, (len(z), len(s))), np.broadcast_to(y, (len(z), len(s))),
         np.broadcast_to(z[:, None], (len(z), len(s)))], axis=-1
    )  # fmt: skip
    sample = np.rint((points - grid.origin_m) / grid.voxel_m).astype(int)
    block, inner = sample // 8, sample % 8
    number = {tuple(coords): n for n, coords in enumerate(grid.block_coords.tolist())}
    at = np.array([number.get(tuple(b), -1) for b in block.reshape(-1, 3).tolist()])
    inside = inner.reshape(-1, 3)
    sdf = np.where(at < 0, np.nan, grid.sdf_m[at, inside[:, 0], inside[:, 1], inside[:, 2]])
    sdf[(at < 0) | (grid.weight[at, inside[:, 0], inside[:, 1], inside[:, 2]] <= 0)] = np.nan
    part = (sdf / grid.truncation_m).reshape(len(z), len(s), 1)
    outside, within = np.array([60, 120, 220]), np.array([220, 120, 60])
    shown = 255 - np.clip(np.abs(part), 0, 1) * (255 - np.where(part > 0, outside, within))
    return np.where(np.isnan(part), 36, shown).astype(np.uint8).repeat(2, 0).repeat(2, 1)


def geometry_figure(view: View) -> Picture:
    """Normals of the meshes, and where each surface comes from."""

    def colours(mesh: TriMesh) -> Any:
        table = np.array([PROVENANCE_COLOURS[p] for p in Provenance], np.uint8)
        return table[mesh.face_provenance]

    background = view.work.twin.assets.background
    return strip([normal_colours(view.traced.geometry), view.coloured(background, colours)])


def appearance_figure(view: View) -> Picture:
    """The recorded picture, and the static scene in the radiance of its textures."""
    background = view.work.assets.background
    return strip([view.recorded, view.coloured(background, lambda _: None)])


def lighting_figure(view: View) -> Picture:
    """The stitched panorama above the estimated dome."""
    dome = dome_preview(view.work.sky.dome)
    panorama = Image.fromarray(srgb8_from_linear(view.work.panorama.radiance))
    shown = np.asarray(panorama.resize(dome.shape[1::-1]))
    rows = len(dome)
    # Nothing is observed near zenith and nadir, and the dome's lower half is one colour.
    return _stacked([shown[rows // 4 : rows * 3 // 4], dome[: rows * 5 // 8]])


def twin_figure(view: View) -> Picture:
    """The light of the recording, and the base colour that remains without it."""
    light = view.traced.light(view.work.sky.dome)
    return strip([tone_mapped(light.shaded), srgb8_from_linear(view.traced.geometry.base_colour)])


def rendering_figure(view: View) -> Picture:
    """Depth, normals, ambient occlusion, and the shadow ratio under another sun."""
    buffers = view.traced.buffers
    ratio = view.traced.light(view.target_sky).ratio
    occlusion = ratio_grey(np.repeat(buffers.ambient_occlusion[..., None], 3, axis=2))
    return _stacked(
        [
            strip([depth_colours(buffers.depth_z_m), normal_colours(buffers)]),
            strip([occlusion, ratio_grey(ratio)]),
        ]
    )


def relighting_figure(view: View) -> Picture:
    """Recorded, light of both skies, relit."""
    options = RelightOptions(
        name="figure-relit", sky=(f"sun:{TARGET_DEG[0]},{TARGET_DEG[1]}",),
        cameras=(view.camera_name,), frames=_frames(view), overwrite=True,
    )  # fmt: skip
    folder = relight(view.root, options)[0]
    relit = read_srgb8(folder / "frames" / view.camera_name / f"{view.stem}.png")
    skies = (view.work.sky.dome, view.target_sky)
    lights = [tone_mapped(view.traced.light(sky).shaded) for sky in skies]
    return _stacked([strip([view.recorded, relit]), strip(lights)])


def _stacked(rows: Sequence[Picture]) -> Picture:
    """Pictures of one width below each other."""
    gap = np.full((6, rows[0].shape[1], 3), 128, np.uint8)
    return np.concatenate([part for row in rows for part in (row, gap)][:-1])


def _frames(view: View) -> str:
    return f"{int(view.stem)}:{int(view.stem) + 1}"


def _edited(view: View, write_log: Path | None) -> Path:
    """Folder of the frame without the parked vehicle that covers most of it."""
    shown = view.traced.geometry.actor_index
    number_by_actor = replay(view.work.twin, "figures", [view.frame]).number_by_actor
    area = {
        track.actor_id: int((shown == number_by_actor[track.actor_id]).sum())
        for track in view.work.log.actors
        if not track.is_moving and track.actor_id in number_by_actor
    }
    removed = max(area, key=lambda actor: area[actor])
    path = view.root / "figure-edited.json"
    edits = [{"do": "remove", "actor": removed}]
    path.write_text(json.dumps({"version": 1, "name": "figure-edited", "edits": edits}))
    options = SimulateOptions(
        name="figure-edited", sky=("source",), cameras=(view.camera_name,),
        frames=_frames(view), overwrite=True, write_log=write_log,
    )  # fmt: skip
    return simulate(view.root, path, options)[0]


def scenarios_figure(view: View) -> Picture:
    """Recorded, and without the parked vehicle that covers most of the picture."""
    folder = _edited(view, None)
    edited = read_srgb8(folder / "frames" / view.camera_name / f"{view.stem}.png")
    return strip([view.recorded, edited])


def lidar_figure(view: View) -> Picture:
    """The recorded sweep from above, and the sweep of the log without that vehicle."""
    with TemporaryDirectory() as folder:
        written = Path(folder) / "log"
        _edited(view, written)
        log = load_log(LogReading(source=str(written)))
        edited = log.sweeps[0].load()
        recorded = min(view.work.log.sweeps, key=lambda s: abs(s.time_ns - edited.time_ns))
        sweeps = (recorded.load().points_world, edited.points_world)
    middle = view.frame.world_from_camera.translation_m
    return strip([_from_above(points - middle) for points in sweeps])


def _from_above(points_m: Any) -> Picture:
    """Points coloured by height, x to the right and y up, metres about the middle."""
    near = np.abs(points_m[:, :2]).max(axis=1) < REACH_M
    points = points_m[near]
    size = 2 * TILE_PX
    at = ((points[:, :2] / REACH_M + 1) / 2 * (size - 1)).astype(int)
    order = np.argsort(points[:, 2])
    height = np.clip((points[order, 2] + 2.5) * 8 + 2, 2, 80)
    picture = np.full((size, size, 3), 16, np.uint8)
    colours = depth_colours(height[None])[0]
    for down, right in np.ndindex(_DOT_PX, _DOT_PX):
        row = np.minimum(size - 1 - at[order, 1] + down, size - 1)
        column = np.minimum(at[order, 0] + right, size - 1)
        picture[row, column] = colours
    return picture


FIGURES: dict[str, tuple[Callable[[View], Picture], Sequence[str]]] = {
    "log": (log_figure, ("recorded", "LiDAR returns by distance")),
    "masks": (masks_figure, ("recorded", "sky matte")),
    "fields": (fields_figure, ()),
    "geometry": (geometry_figure, ("normals", "provenance")),
    "appearance": (appearance_figure, ("recorded", "radiance textures, static scene")),
    "lighting": (lighting_figure, ()),
    "twin": (twin_figure, ("light of the recording", "base colour")),
    "rendering": (rendering_figure, ("depth", "normals", "ambient occlusion", "shadow ratio")),
    "relighting": (relighting_figure, ("recorded", "relit", "source light", "target light")),
    "scenarios": (scenarios_figure, ("recorded", "vehicle removed")),
    "lidar": (lidar_figure, ("recorded sweep", "sweep without the vehicle")),
}
"""Each figure, and the captions of its pictures: two in a row."""


def _captioned(picture: Picture, captions: Sequence[str]) -> Image.Image:
    image = Image.fromarray(picture)
    image = image.resize((2 * TILE_PX, round(2 * TILE_PX * image.height / image.width)))
    draw = ImageDraw.Draw(image)
    rows = max(1, len(captions) // 2)
    for number, words in enumerate(captions):
        place_px = (8 + number % 2 * TILE_PX, 6 + number // 2 * image.height // rows)
        draw.text(place_px, words, fill="white", stroke_width=2, stroke_fill="black")
    return image


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("work", type=Path)
    parser.add_argument("--camera", default="front_left_camera")
    parser.add_argument("--frame", default="03", help="stem of the frame")
    parser.add_argument("--only", nargs="*", choices=tuple(FIGURES), default=tuple(FIGURES))
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    view = View(given.work, given.camera, given.frame)
    for name in given.only:
        make, captions = FIGURES[name]
        _captioned(make(view), captions).save(given.out / f"{name}.webp", quality=80, method=6)


if __name__ == "__main__":
    main()
