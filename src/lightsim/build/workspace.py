"""A work folder: one sub-folder per artefact, loaded on first access and cached."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import numpy as np
from jaxtyping import Bool, Float32

from lightsim.core.alignment import Alignment
from lightsim.core.buildings import Roofline
from lightsim.core.camera import PinholeCamera
from lightsim.core.fields import SceneFields
from lightsim.core.frames import Trajectory
from lightsim.core.kept_sweeps import KeptSweeps
from lightsim.core.log import DrivingLog
from lightsim.core.mesh import TriMesh
from lightsim.core.reading import LogReading
from lightsim.core.sensors import CameraFrame
from lightsim.core.twin import DigitalTwin, Panorama, SceneAssets, SkyEstimate
from lightsim.errors import ArtefactError
from lightsim.store.alignment import read_alignment
from lightsim.store.artefact import read_json, require_whole
from lightsim.store.assets import read_assets, read_mesh
from lightsim.store.fields import read_fields
from lightsim.store.images import read_grey8_alpha
from lightsim.store.log import (
    EGO_NAME,
    held_out_of,
    held_out_stems,
    read_reading,
    read_source,
    read_source_hashes,
    with_ego_vehicle,
)
from lightsim.store.rooflines import read_rooflines
from lightsim.store.sky import read_estimate, read_panorama
from lightsim.store.twin import read_twin_assets

if TYPE_CHECKING:
    from lightsim.reconstruct.field.sdf_field import SceneField
    from lightsim.render.roofs import UncertainRoofs

T = TypeVar("T")
FIELD_NAME = "field.safetensors"
FIELD_CONFIG_NAME = "field.json"
OPTIONS_NAME = "build.json"


class _MadeOf(Generic[T]):
    """Cached property whose source artefacts are checked at every access."""

    def __init__(self, function: Callable[[Workspace], T], stages: tuple[str, ...]) -> None:
        self._function, self._stages = function, stages
        self.__doc__ = function.__doc__

    def __get__(self, work: Workspace, owner: type) -> T:
        # At every access, also to a cached value: another stage may have read it legitimately.
        for stage in self._stages:
            work.check_open(stage)
        values = work.__dict__.setdefault("_values", {})
        name = self._function.__name__
        if name not in values:
            values[name] = self._function(work)
        return values[name]


def made_of(*stages: str) -> Callable[[Callable[[Workspace], T]], _MadeOf[T]]:
    """Decorate a property that is read once from the artefacts of these stages."""
    return lambda function: _MadeOf(function, stages)


class Workspace:
    """The artefacts of one log under `root`.

    Before its first use, every artefact is compared with the hashes in its record, and the
    recording with the hashes of the build.
    """

    def __init__(
        self,
        root: Path,
        reading: LogReading | None = None,
        source_hashes: Mapping[str, str] | None = None,
        *,
        is_stale_allowed: bool = False,
    ) -> None:
        """
        Args:
            root: the work folder.
            reading: options of reading the log; by default those of the build of `root`.
            source_hashes: hashes of the recording's files (datasets/fingerprint.py); by default
                computed when the recording is first read, and compared with those of the build.
            is_stale_allowed: continue if the recording has changed since the build.
        """
        self.root = root
        self._reading = reading
        self._source_hashes = source_hashes
        self._is_stale_allowed = is_stale_allowed
        self._records: dict[str, dict[str, Any]] = {}
        self._open: frozenset[str] | None = None
        self._sweeps = KeptSweeps()

    def folder(self, stage: str) -> Path:
        """Return the folder of a stage's artefact, which need not exist yet."""
        return self.root / stage

    @contextmanager
    def opened(self, stages: Iterable[str]) -> Generator[None]:
        """Restrict reading, during the block, to the artefacts that a stage declares as inputs."""
        before, self._open = self._open, frozenset(stages)
        try:
            yield
        finally:
            self._open = before

    def check_open(self, stage: str) -> None:
        """Raise AssertionError, a programming error, if a stage reads an undeclared artefact."""
        assert self._open is None or stage in self._open, f"'{stage}' is not declared as needed"

    def need(self, stage: str) -> Path:
        """Return the folder of a finished, undamaged artefact.

        Raises:
            ArtefactError: it has not been made, or is damaged.
        """
        self.record(stage)
        return self.folder(stage)

    def record(self, stage: str) -> dict[str, Any]:
        """Return artefact.json of a finished artefact; raises as `need`."""
        self.check_open(stage)
        if stage not in self._records:
            record = require_whole(self.folder(stage), self._remedy)
            if record is None:
                raise ArtefactError(
                    f"the '{stage}' artefact has not been made",
                    where=self.root,
                    got=self._not_a_work_folder,
                    remedy=self._remedy,
                )
            self._records[stage] = record
        return self._records[stage]

    @property
    def _not_a_work_folder(self) -> str | None:
        """What `root` is instead of a work folder; None if it is one."""
        if (self.root / OPTIONS_NAME).is_file():
            return None
        return f"a folder without {OPTIONS_NAME}" if self.root.is_dir() else "no such folder"

    @cached_property
    def _remedy(self) -> str:
        # A mistyped path or a recording must not become the target of a build.
        if self._not_a_work_folder is not None:
            return "Give a folder that lightsim build SOURCE --work WORK has made."
        return f"Run: lightsim build {read_source(self.root / OPTIONS_NAME)} --work {self.root}"

    @cached_property
    def reading(self) -> LogReading:
        """Options of reading the log: the given ones, else those of the build of `root`.

        Raises:
            ArtefactError: none were given, and there is no finished build.
        """
        if self._reading is not None:
            return self._reading
        recorded = read_reading(self.need("log"))
        return replace(recorded, source=read_source(self.root / OPTIONS_NAME))

    @cached_property
    def source_hashes(self) -> Mapping[str, str]:
        """Current hashes of the recording's files."""
        from lightsim.datasets.fingerprint import hash_recording

        if self._source_hashes is not None:
            return self._source_hashes
        return hash_recording(self.reading)

    def _check_source(self) -> None:
        """Reject a recording that has changed since the build."""
        from lightsim.datasets.fingerprint import describe_change

        # Given hashes are those of the running build, whose keys already depend on them.
        if self._source_hashes is not None or self._is_stale_allowed:
            return
        change = describe_change(read_source_hashes(self.need("log")), self.source_hashes)
        if change is not None:
            raise ArtefactError(
                "the recording has changed since the twin was built from it",
                where=self.reading.source,
                got=change,
                remedy=f"{self._remedy} (or give --allow-stale to continue with the old twin).",
            )

    @made_of("log", "alignment")
    def log(self) -> DrivingLog:
        """All frames at the scale of the build; sensors, path and boxes aligned."""
        return self._with_kept_sweeps(self.alignment.applied_to(self.recorded_log))

    @made_of("log")
    def recorded_log(self) -> DrivingLog:
        """All frames at the scale of the build, not aligned."""
        return self._recorded_at(self.reading.image_scale)

    @made_of("alignment")
    def alignment(self) -> Alignment:
        """Corrections of path, boxes and cameras that turn the recorded log into `log`."""
        return read_alignment(self.need("alignment"))

    @cached_property
    def _full_log(self) -> DrivingLog:
        from lightsim.datasets.reader import read_log

        if not (self.folder("log") / EGO_NAME).is_file():
            return self._read_recording()
        self._check_source()
        # The search for the ego vehicle decodes pictures and sweeps: its result is in the artefact.
        return self._with_kept_sweeps(with_ego_vehicle(read_log(self.reading), self.need("log")))

    def read_recording(self) -> DrivingLog:
        """Read the recording, at full size, and find the ego vehicle in it anew."""
        self._full_log = self._read_recording()
        return self._full_log

    def _read_recording(self) -> DrivingLog:
        from lightsim.datasets.reader import read_log
        from lightsim.masks.ego_body import with_ego_body

        self._check_source()
        log = self._with_kept_sweeps(read_log(self.reading, self._find_ego_vehicle))
        return with_ego_body(log, held_out_stems(log, self.reading.hold_out))

    def _with_kept_sweeps(self, log: DrivingLog) -> DrivingLog:
        return replace(log, sweeps=self._sweeps.of(log.sweeps))

    def _find_ego_vehicle(
        self, views: Sequence[tuple[PinholeCamera, Sequence[CameraFrame]]], ego: Trajectory
    ) -> tuple[dict[str, Bool[np.ndarray, "h w"]], tuple[str, ...]]:
        """Find the masks of the ego vehicle, from pictures that are not held out."""
        from lightsim.datasets.selection import FrameSelection
        from lightsim.masks.ego_vehicle import ego_vehicle_masks

        # No log exists yet: held-out stems are those of the pictures (numbers, as in --frames).
        chosen = FrameSelection.parse(self.reading.frames)
        frames = sorted((f for _, fs in views for f in fs), key=lambda f: f.time_ns)
        stems = tuple(dict.fromkeys(f.stem for f in frames if chosen.holds(int(f.stem))))
        held_out = held_out_of(stems, self.reading.hold_out)
        allowed = [(c, tuple(f for f in fs if f.stem not in held_out)) for c, fs in views]
        return ego_vehicle_masks(allowed, ego)

    def log_at(self, image_scale: float) -> DrivingLog:
        """Return the aligned log at another image scale."""
        return self.alignment.applied_to(self._recorded_at(image_scale))

    def _recorded_at(self, image_scale: float) -> DrivingLog:
        from lightsim.datasets.scale import at_scale

        return at_scale(self._full_log, image_scale)

    @made_of("log")
    def held_out(self) -> frozenset[str]:
        """Stems of held-out frames and sweeps, which stages of the build must not read."""
        return held_out_stems(self._full_log, self.reading.hold_out)

    @made_of("log", "alignment")
    def training_log(self) -> DrivingLog:
        """The log without held-out frames and sweeps, and without LiDAR returns on the ego vehicle:
        the input of the build."""
        return self._without_held_out(self.log).without_ego_returns()

    @made_of("log")
    def recorded_training_log(self) -> DrivingLog:
        """The recorded log without held-out frames and sweeps, and without LiDAR returns on the ego
        vehicle: the input of the alignment."""
        return self._without_held_out(self.recorded_log).without_ego_returns()

    def _without_held_out(self, log: DrivingLog) -> DrivingLog:
        out = self.held_out
        return replace(
            log,
            frames=tuple(f for f in log.frames if f.stem not in out),
            sweeps=tuple(s for s in log.sweeps if s.stem not in out),
        )

    def sky_matte(self, frame: CameraFrame) -> Float32[np.ndarray, "h w"]:
        """Return the expected fraction of sky of each pixel, at the build's image scale.

        Mattes of held-out frames are a separate artefact, which no stage that builds surfaces
        reads.
        """
        return self._sky_matte(frame, 0)

    def likeliest_sky(self, frame: CameraFrame) -> Float32[np.ndarray, "h w"]:
        """Return the maximum a posteriori matte, for compositing; `sky_matte` is the mean."""
        return self._sky_matte(frame, 1)

    def _sky_matte(self, frame: CameraFrame, plane: int) -> Float32[np.ndarray, "h w"]:
        stage = "held_out_masks" if frame.stem in self.held_out else "masks"
        # The grey plane holds the expectation, the alpha plane the maximum a posteriori matte.
        path = self.need(stage) / frame.camera_name / f"{frame.stem}.png"
        return read_grey8_alpha(path)[..., plane].astype(np.float32) / 255.0

    @made_of("fields")
    def fused(self) -> SceneFields:
        """Signed-distance grids of the fused LiDAR."""
        return read_fields(self.need("fields"))

    @made_of("neural")
    def fields(self) -> SceneFields:
        """Signed-distance grids for meshing: the fused LiDAR, refined by the neural field."""
        return read_fields(self.need("neural"))

    @made_of("log", "alignment", "fields", "neural")
    def scene_field(self) -> SceneField:
        """The trained neural field.

        Raises:
            ArtefactError: the build trained no field.
        """
        from lightsim.reconstruct.field.config import config_from_json
        from lightsim.reconstruct.field.neural import make_field
        from lightsim.store.weights import read_weights

        folder = self.need("neural")
        config = config_from_json(read_json(folder / FIELD_CONFIG_NAME))
        # The seed is arbitrary: all weights are replaced by the stored ones.
        field = make_field(self.training_log, self.fused, config, 0)
        field.load_state_dict(read_weights(folder / FIELD_NAME))
        return field

    @made_of("geometry")
    def meshes(self) -> SceneAssets:
        """Meshes of background and actors without colours."""
        return read_assets(self.need("geometry"))

    @made_of("assets")
    def assets(self) -> SceneAssets:
        """Meshes coloured with the observed radiance under the source sky."""
        return read_assets(self.need("assets"))

    @made_of("geometry")
    def initial_rooflines(self) -> list[Roofline]:
        """Roof edges of walls before shadows are evaluated."""
        return read_rooflines(self.need("geometry") / "rooflines.npz")

    @made_of("sky")
    def rooflines(self) -> list[Roofline]:
        """Roof edges of walls, estimated from views and shadows."""
        return read_rooflines(self.need("sky") / "rooflines.npz")

    @made_of("assets")
    def inferred(self) -> TriMesh:
        """Inferred roofs and rear walls, which cast shadows but were not measured; heights are
        those of `initial_rooflines`."""
        return read_mesh(self.need("assets") / "inferred.npz", "world")

    @made_of("panorama")
    def panorama(self) -> Panorama:
        """Stitched panorama around the ego's position in the middle of the log, scene units."""
        return read_panorama(self.need("panorama"))

    @made_of("sky")
    def sky(self) -> SkyEstimate:
        """The source sky: the light under which the log was recorded."""
        return read_estimate(self.need("sky"))

    @made_of("twin")
    def _twin_assets(self) -> tuple[SceneAssets, TriMesh]:
        return read_twin_assets(self.need("twin"))

    # No decorator of its own: `_twin_assets` checks the artefact.
    @property
    def unobserved_occluders(self) -> TriMesh:
        """The inferred casters with their base colour."""
        return self._twin_assets[1]

    @made_of("sky", "twin")
    def uncertain_roofs(self) -> UncertainRoofs | None:
        """Samples of the inferred casters; None if views show every roof edge."""
        from lightsim.build.assemble import uncertain_roofs

        background = self._twin_assets[0].background
        return uncertain_roofs(background, self.rooflines, self.sky.dome.sun)

    @made_of("log", "alignment", "sky", "twin")
    def twin(self) -> DigitalTwin:
        """The aligned log, its meshes with base colour, and the source sky."""
        return DigitalTwin(self.log, self._twin_assets[0], self.sky)
