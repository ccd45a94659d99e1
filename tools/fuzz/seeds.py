"""Honest files to damage: a small log, and a work folder as a build leaves it."""

from __future__ import annotations

import gzip
import shutil
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tests.datasets.argoverse2_log import write_argoverse2_log
from tests.datasets.arrow_pickles import text_frame
from tests.datasets.lightsim_log import sweep_columns, sweep_times, write_lightsim_mini
from tests.datasets.mini_log import PERIOD_S, START_S, cuboid_columns, write_json, write_mini_log
from tests.datasets.nuscenes_log import write_data_set
from tests.datasets.point_writers import write_bin, write_pcd, write_ply

from lightsim.build.options import BuildOptions
from lightsim.build.pipeline import STAGES, artefact_keys
from lightsim.build.workspace import FIELD_CONFIG_NAME, FIELD_NAME, OPTIONS_NAME
from lightsim.core.alignment import Alignment, CameraCorrection, PathCorrection
from lightsim.core.buildings import Roofline, Wall
from lightsim.core.dome import Sun, add_sun
from lightsim.core.fields import GroundMap, SceneFields, TsdfGrid
from lightsim.core.log import DrivingLog
from lightsim.core.mesh import Material, Texture, TriMesh
from lightsim.core.reading import LogReading
from lightsim.core.twin import ActorAsset, DigitalTwin, Panorama, SceneAssets, SkyEstimate
from lightsim.datasets.fingerprint import hash_recording
from lightsim.datasets.reader import read_log
from lightsim.reconstruct.field.config import draft
from lightsim.store.alignment import write_alignment
from lightsim.store.artefact import hash_names, make_artefact
from lightsim.store.artefact import write_json as write_own_json
from lightsim.store.assets import write_assets, write_mesh
from lightsim.store.checkpoint import FolderCheckpointer
from lightsim.store.fields import write_fields
from lightsim.store.images import write_png
from lightsim.store.log import write_log
from lightsim.store.rooflines import write_rooflines
from lightsim.store.sky import write_panorama, write_sky
from lightsim.store.twin import write_twin
from lightsim.store.weights import WeightsRecord, write_weights

_MAX_FRAMES = 3
_MAX_CAMERAS = 2


@dataclass(frozen=True)
class Seeds:
    """Folders that are copied and damaged, never changed."""

    log: Path
    work: Path
    nuscenes: Path
    argoverse2: Path
    own: Path
    """A lightsim-log/1 folder, with sweeps in every format."""


def make_seeds(folder: Path, source: Path | None) -> Seeds:
    """The seeds in `folder`, from a log of PandaSet's layout or the synthetic mini log."""
    log = folder / "log"
    if source is None:
        write_mini_log(log)
        write_json(log / "annotations" / "semseg" / "classes.json", {"7": "Road", "13": "Car"})
        _rewrite_some(log)
    else:
        _copy_a_little(source, log)
    work = folder / "work"
    _write_work(work, log)
    return Seeds(
        log,
        work,
        write_data_set(folder / "nuscenes"),
        write_argoverse2_log(folder),
        _write_own(folder / "own"),
    )


def _write_own(folder: Path) -> Path:
    """The first sweep as .npz, and one each as .ply, .pcd and .bin."""
    write_lightsim_mini(folder)
    writers = ((".ply", write_ply, "ascii"), (".pcd", write_pcd, "binary"), (".bin", write_bin, ""))
    for time_ns, (suffix, write, form) in zip(sweep_times()[1:], writers, strict=True):
        path = folder / "sweeps" / "top" / f"{time_ns}.npz"
        write(path.with_suffix(suffix), sweep_columns(time_ns), form)
        path.unlink()
    return folder


def _rewrite_some(log: Path) -> None:
    """Frame 1 as today's mirrors and exporters have it: no gzip, text of Arrow, JPG."""
    for part in ("lidar", "annotations/semseg"):
        path = log / part / "01.pkl.gz"
        (log / part / "01.pkl").write_bytes(gzip.decompress(path.read_bytes()))
        path.unlink()
    boxes = log / "annotations" / "cuboids"
    (boxes / "01.pkl").write_bytes(text_frame(cuboid_columns(START_S + PERIOD_S)))
    (boxes / "01.pkl.gz").unlink()
    for path in (log / "camera").glob("*/01.jpg"):
        path.rename(path.with_suffix(".JPG"))


def _copy_a_little(source: Path, log: Path) -> None:
    """Two cameras and three frames of a recording; lists of poses and times whole."""
    names = sorted(p.name for p in (source / "camera").iterdir() if p.is_dir())
    first = [n for n in names if n == "front_camera"]
    cameras = (first + [n for n in names if n not in first])[:_MAX_CAMERAS]
    for path in sorted(source.rglob("*")):
        parts = path.relative_to(source).parts
        if not path.is_file() or (parts[0] == "camera" and parts[1] not in cameras):
            continue
        stem = path.name.split(".")[0]
        if stem.isdigit() and int(stem) >= _MAX_FRAMES:
            continue
        target = log / path.relative_to(source)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, target)


def _write_work(work: Path, log_folder: Path) -> None:
    """All artefacts that a build makes, from tiny stand-ins for what its stages compute."""
    work.mkdir()
    reading = LogReading(source=str(log_folder), image_scale=1.0)
    options = BuildOptions(reading=reading, preset="draft", neural_steps=0)
    write_own_json(work / OPTIONS_NAME, options)
    log = read_log(reading)
    writers = _Writers(log, reading, hash_recording(reading))
    recipe_of = artefact_keys(options, hash_names(writers.hashes))
    for stage in STAGES:
        write = getattr(writers, stage.name, writers.nothing)
        make_artefact(work / stage.name, recipe_of[stage.name], write)


@dataclass(frozen=True)
class _Writers:
    """Fill the folder of the stage of the same name with the store's own writers."""

    log_: DrivingLog
    reading: LogReading
    hashes: dict[str, str]

    def nothing(self, folder: Path) -> Iterable[str]:
        (folder / "index.html").write_text("<html></html>")
        return ()

    def log(self, folder: Path) -> Iterable[str]:
        write_log(folder, self.log_, self.reading, self.hashes)
        return self.log_.notes

    def masks(self, folder: Path) -> Iterable[str]:
        for frame in self.log_.frames:
            (folder / frame.camera_name).mkdir(exist_ok=True)
            camera = self.log_.cameras[frame.camera_name]
            matte = np.full((camera.height_px, camera.width_px), 200, np.uint8)
            write_png(folder / frame.camera_name / f"{frame.stem}.png", matte)
        return ()

    def alignment(self, folder: Path) -> Iterable[str]:
        ego = self.log_.ego
        n = len(ego.times_ns)
        small = np.full((n, 3), 1e-3)
        path = PathCorrection(ego.times_ns, np.zeros(3), small, small)
        cameras = {name: CameraCorrection(small[0], small[0], 1e-3) for name in self.log_.cameras}
        actors = {a.actor_id: a.trajectory.matrices for a in self.log_.actors[:2]}
        write_alignment(folder, Alignment(path, cameras, actors, numbers={"x": 1.0}, notes=("y",)))
        return ()

    def fields(self, folder: Path) -> Iterable[str]:
        write_fields(folder, _fields())
        return ()

    def neural(self, folder: Path) -> Iterable[str]:
        import torch

        write_fields(folder, _fields())
        record = WeightsRecord("a field", "by hand", "nothing", "0", 0, 5, {"x": 1.0}, "none", "0")
        write_weights(folder / FIELD_NAME, {"a": torch.ones(4, 3), "b.c": torch.zeros(7)}, record)
        write_own_json(folder / FIELD_CONFIG_NAME, draft())
        checkpointer = FolderCheckpointer(folder)
        checkpointer.record({"step": 3.0, "loss": 0.5})
        checkpointer.save({"step": 5, "model": {"a": torch.ones(4, 3)}})
        return ()

    def geometry(self, folder: Path) -> Iterable[str]:
        write_assets(folder, self._assets())
        write_rooflines(folder / "rooflines.npz", [_roofline()])
        return ()

    def assets(self, folder: Path) -> Iterable[str]:
        write_assets(folder, self._assets())
        write_mesh(folder / "inferred.npz", _mesh("world"))
        return ()

    def panorama(self, folder: Path) -> Iterable[str]:
        radiance = np.full((16, 32, 3), 0.5, np.float32)
        seen = np.ones((16, 32), bool)
        write_panorama(folder, Panorama(radiance, seen, seen, ~seen))
        return ()

    def sky(self, folder: Path) -> Iterable[str]:
        write_sky(folder, _sky(), 20.0)
        write_rooflines(folder / "rooflines.npz", [_roofline()])
        return ()

    def twin(self, folder: Path) -> Iterable[str]:
        write_twin(folder, DigitalTwin(self.log_, self._assets(), _sky()), _mesh("world"))
        return ()

    def _assets(self) -> SceneAssets:
        actors = {
            a.actor_id: ActorAsset(a.actor_id, a.kind, _mesh("actor")) for a in self.log_.actors[:2]
        }
        gains = {name: np.array([1.0, 0.9, 1.1], np.float32) for name in self.log_.cameras}
        return SceneAssets(_mesh("world"), actors, gains, ("a note",))


def _fields() -> SceneFields:
    def grid(frame: str) -> TsdfGrid:
        values = np.linspace(-0.2, 0.2, 512, dtype=np.float32).reshape(1, 8, 8, 8)
        corner = np.zeros((1, 3), np.int32)
        return TsdfGrid(frame, np.zeros(3), 0.1, 0.3, corner, values, np.ones_like(values))

    ground = GroundMap(np.zeros(2), 1.0, np.zeros((4, 4), np.float32), np.ones((4, 4), bool))
    return SceneFields((grid("world"),), (50.0,), {"a": grid("actor")}, ground, np.zeros((2, 3)))


def _roofline() -> Roofline:
    wall = Wall(np.zeros(3), np.eye(3)[0], np.eye(3)[1], (0.0, 0.5), (0.0, 2.0))
    column, cells = np.zeros(2), np.array([2, 3])
    energy = np.zeros((2, 9), np.float32)
    return Roofline(
        wall, 0.25, column, energy, cells, cells + 3, np.ones(2, bool), column + 8.0, 0.3
    )


def _mesh(frame: str) -> TriMesh:
    faces = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]], np.int32)
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
    image = np.linspace(0, 1, 4 * 6 * 3, dtype=np.float32).reshape(4, 6, 3)
    corner_uv = np.tile(np.array([[1, 1], [3, 1], [1, 3]], np.float32), (4, 1, 1))
    return TriMesh(
        frame,
        vertices,
        faces,
        np.full((4, 3), 0.5, np.float32),
        (Material(0.3, 0.4, "car paint"), Material(0.05, 0.0, "glass")),
        np.array([0, 1, 1, 0], np.uint8),
        Texture(image, corner_uv),
        np.ones(4, np.float32),
        np.arange(4, dtype=np.uint8),
    )


def _sky() -> SkyEstimate:
    sun = Sun(np.array([0.0, 0.6, 0.8]), np.array([60.0, 50.0, 40.0], np.float32))
    dome = add_sun(np.full((16, 32, 3), 0.25, np.float32), sun)
    return SkyEstimate(
        dome, 0.0, 53.13, "image", 3.0, 0.3, np.full(3, 0.7, np.float32), 0.1, ("a note",)
    )
