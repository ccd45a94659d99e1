"""Generation of a synthetic street log and its ground truth."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from lightsim.core.checks import check_number
from lightsim.core.frames import RigidTransform
from lightsim.errors import InputError
from lightsim.progress import Progress
from lightsim.render.denoise import check_installed
from lightsim.store.atomic import whole_file
from lightsim.store.entries import Entries
from lightsim.store.images import write_exr
from lightsim_lab.synthetic.geometry import Snapshot
from lightsim_lab.synthetic.guides import Guides, render_guides
from lightsim_lab.synthetic.lidar import scan
from lightsim_lab.synthetic.plan import (
    Size,
    Standing,
    StreetConfig,
    Style,
    config_of,
    plan_street,
)
from lightsim_lab.synthetic.renderers import StreetRenderer
from lightsim_lab.synthetic.rig import SWEEP_S, MountedCamera, mount_cameras, world_from_ego
from lightsim_lab.synthetic.sensor import camera_isp
from lightsim_lab.synthetic.skies import FurtherSkies, Sky, build_sky, sky_specs
from lightsim_lab.synthetic.street import Street, build_street
from lightsim_lab.synthetic.tracing import Placed, StreetTracer
from lightsim_lab.synthetic.truth import (
    compute_buffers,
    stem_of,
    write_geometry,
    write_sky,
    write_truth_json,
)
from lightsim_lab.synthetic.writer import (
    camera_pose,
    utc_s,
    write_cuboids,
    write_rig,
    write_sweep,
)

# Key of the ego vehicle's body in the path tracer.
_EGO_KEY = "ego"
# Beginnings of the options that add target skies (`FurtherSkies.words`).
_SKY_OPTIONS = ("more-skies", "drawn-suns", "sky")
_HALF_BUFFERS = ("normal_world", "base_colour", "sun_visibility", "actor_index")


@dataclass(frozen=True, eq=False)
class _Shot:
    """One image to render: file, camera, frame, light paths and seed."""

    path: Path
    mounted: MountedCamera
    index: int
    samples: int
    seed: int
    has_sensor_noise: bool
    """True for images of the log; those of the truth have no sensor noise."""


@dataclass(frozen=True)
class Variation:
    """Style of the street, and changes of the settings of a size.

    Args:
        paths: light paths per pixel, of log and truth; None: those of the size.
        sway: pitch, roll and heave of the ego vehicle (`StreetConfig.sway`).
        has_fast_traffic: oncoming traffic is dense and fast (`StreetConfig.has_fast_traffic`).
        style: buildings, vegetation, traffic and materials of the street.
        standing: motion of an ego vehicle that waits at a junction (`StreetConfig.standing`).

    Raises:
        InputError: a number is out of range.
    """

    paths: int | None = None
    sway: float = 0.0
    has_fast_traffic: bool = False
    style: Style = "city"
    standing: Standing | None = None

    def __post_init__(self) -> None:
        if self.paths is not None:
            check_number("--paths", self.paths, 1, 1 << 16)
        check_number("--sway", self.sway, 0.0, 5.0)

    def of(self, config: StreetConfig) -> StreetConfig:
        """Return the changed settings."""
        if self.paths is not None:
            config = replace(config, samples=self.paths, truth_samples=self.paths)
        return replace(
            config,
            sway=self.sway,
            has_fast_traffic=self.has_fast_traffic,
            standing=self.standing,
        )

    @property
    def words(self) -> str:
        """Options of the command line that make the changes, with a leading space."""
        paths = "" if self.paths is None else f" --paths {self.paths}"
        sway = f" --sway {self.sway:g}" if self.sway else ""
        style = "" if self.style == "city" else f" --style {self.style}"
        fast = " --fast-traffic" if self.has_fast_traffic else ""
        standing = f" --standing {self.standing}" if self.standing else ""
        return style + paths + sway + fast + standing


def synthesize(
    out: Path,
    *,
    seed: int,
    size: Size,
    progress: Progress,
    is_denoised: bool = False,
    variation: Variation | None = None,
    further: FurtherSkies | None = None,
    renderer: StreetRenderer | None = None,
) -> None:
    """Write OUT/log (PandaSet's layout) and OUT/truth.

    Existing files are not replaced, so that an interrupted run can be resumed.

    Args:
        is_denoised: denoise the path-traced images of log and truth.
        variation: style of the street, and changes of the size's settings.
        further: target skies in addition to the usual three.
        renderer: renderer of the pictures, with its cameras; None: Mitsuba on the CPU.

    Raises:
        InputError: the seed is negative, a panorama cannot be read, OUT is not writable or holds
            another street, or there is no CUDA device.
        MissingDependencyError: denoising requires the extra `denoise`, and Cycles an interpreter
            with bpy.
    """
    # Checked before anything is written.
    if is_denoised:
        check_installed()
    renderer = renderer or StreetRenderer()
    record = renderer.record()
    variation = variation or Variation()
    config = variation.of(config_of(size))
    plan = plan_street(seed, variation.style)
    is_standing = config.standing is not None
    street = build_street(plan, config.ego_speed_m_s, config.has_fast_traffic, is_standing)
    cameras = mount_cameras(plan, config)
    log, truth = out / "log", out / "truth"
    # The truth records the command that reproduces it.
    command = f"lightsim synthesize --seed {seed} --size {size}"
    command += " --denoise" if is_denoised else ""
    command += variation.words
    further = further or FurtherSkies()
    command += further.words
    command += renderer.words
    _check_same_street(truth / "truth.json", command)
    log.mkdir(parents=True, exist_ok=True)
    truth.mkdir(parents=True, exist_ok=True)
    write_rig(log, plan, config, cameras)
    write_truth_json(truth / "truth.json", street, config, cameras, command, record)
    if not (truth / "scene.npz").exists():
        write_geometry(truth / "scene.npz", street)
    _write_sweeps(log, street, config, progress)
    skies = [build_sky(spec, plan) for spec in sky_specs(plan)] + further.of(plan)
    skies = [sky.exposed(renderer.sensor.exposure_ev) for sky in skies]
    for sky in skies:
        write_sky(truth / "skies", sky, config.dome_height_px, plan.enu_from_world)
    _write_buffers(truth, street, config, cameras, skies[0], progress)
    guide = _PoseGuides(street, config) if is_denoised else None
    for number, sky in enumerate(skies):
        shots = _shots(out, sky, number, config, cameras)
        _render(street, config, sky, shots, guide, progress, renderer)


def _check_same_street(path: Path, command: str) -> None:
    """Check that the folder of a truth.json is of the same street and renderer; target skies may be
    added."""
    if not path.is_file():
        return
    made = Entries.of_file(path, "Give another --out.").text("command")
    differing = set(made.split(" --")) ^ set(command.split(" --"))
    if any(not option.startswith(_SKY_OPTIONS) for option in differing):
        raise InputError(
            "the folder holds a street that another command made",
            where=path,
            got=made,
            expected=command,
            remedy="Give another --out: finished pictures are kept, so that both would be mixed.",
        )


def _write_sweeps(log: Path, street: Street, config: StreetConfig, progress: Progress) -> None:
    for k in progress.track(range(config.frame_count), "LiDAR sweeps and labels"):
        time_s = SWEEP_S * k
        name = f"{stem_of(k)}.pkl.gz"
        sweep, cuboids = log / "lidar" / name, log / "annotations" / "cuboids" / name
        if not sweep.exists():
            rng = np.random.default_rng([street.plan.seed, 8, k])
            write_sweep(sweep, scan(street, config, time_s, rng), utc_s(street.plan, time_s))
        if not cuboids.exists():
            write_cuboids(cuboids, street, config, time_s)


def _write_buffers(
    truth: Path,
    street: Street,
    config: StreetConfig,
    cameras: tuple[MountedCamera, ...],
    sky: Sky,
    progress: Progress,
) -> None:
    """Write depth, normals, base colour, sun visibility and actor index of the chosen frames."""
    wanted = config.buffer_cameras or [mounted.camera.name for mounted in cameras]
    chosen = [mounted for mounted in cameras if mounted.camera.name in wanted]
    jobs = [(k, mounted) for k in config.buffer_stems for mounted in chosen]
    for k, mounted in progress.track(jobs, "exact buffers"):
        file = f"{mounted.camera.name}/{stem_of(k)}.exr"
        # The actor index is written last: if it exists, all buffers of the view do.
        if (truth / "actor_index" / file).exists():
            continue
        time_s = SWEEP_S * k + mounted.time_offset_s
        snapshot = snapshot_at(street, config, time_s)
        pose = camera_pose(street.plan, config, mounted, time_s)
        for name, buffer in compute_buffers(snapshot, mounted.camera, pose, sky).items():
            path = truth / name / file
            path.parent.mkdir(parents=True, exist_ok=True)
            write_exr(path, buffer, half=name in _HALF_BUFFERS)


def _shots(
    out: Path, sky: Sky, number: int, config: StreetConfig, cameras: tuple[MountedCamera, ...]
) -> list[_Shot]:
    """Return the missing images of a sky; the first sky is that of the log."""
    is_source = number == 0
    indices = range(config.frame_count) if is_source else config.truth_stems
    root = out / "log" / "camera" if is_source else out / "truth" / "relit" / sky.spec.name
    shots = []
    for k in indices:
        for i, mounted in enumerate(cameras):
            shot = _Shot(
                root / mounted.camera.name / f"{stem_of(k)}.jpg",
                mounted,
                k,
                config.samples if is_source else config.truth_samples,
                # Distinct for every image, so that their noise is independent.
                (number * 1000 + k) * len(cameras) + i,
                is_source,
            )
            if not shot.path.exists():
                shots.append(shot)
    return shots


def _render(
    street: Street,
    config: StreetConfig,
    sky: Sky,
    shots: list[_Shot],
    guide: _PoseGuides | None,
    progress: Progress,
    renderer: StreetRenderer,
) -> None:
    if not shots:
        return
    tracer = street_tracer(street, config, sky, renderer)
    for shot in progress.track(shots, f"rendering '{sky.spec.name}' ({tracer.variant})"):
        mounted = shot.mounted
        time_s = SWEEP_S * shot.index + mounted.time_offset_s
        tracer.place(actor_poses_at(street, time_s))
        if street.ego_body:
            tracer.place({_EGO_KEY: world_from_ego(street.plan, config, time_s)})
        pose = camera_pose(street.plan, config, mounted, time_s)
        radiance = tracer.render(
            mounted.camera,
            mounted.margin_px,
            pose,
            shot.samples,
            shot.seed,
            None if guide is None else guide.of(shot),
        )
        rng = None
        if shot.has_sensor_noise:
            rng = np.random.default_rng([street.plan.seed, 9, shot.seed])
        shot.path.parent.mkdir(parents=True, exist_ok=True)
        _write_jpeg(shot.path, camera_isp(radiance, mounted.gain, rng, renderer.sensor))


class _PoseGuides:
    """Cache of the denoiser's guides, which depend on the pose and not on the sky."""

    def __init__(self, street: Street, config: StreetConfig) -> None:
        self._street, self._config = street, config
        self._cache: dict[tuple[int, str], Guides] = {}

    def of(self, shot: _Shot) -> Guides:
        """Return the guides of a shot; those of frames with relit images are cached."""
        key = (shot.index, shot.mounted.camera.name)
        if key in self._cache:
            return self._cache[key]
        time_s = SWEEP_S * shot.index + shot.mounted.time_offset_s
        guides = guides_at(self._street, self._config, shot.mounted, time_s)
        if shot.index in self._config.truth_stems:
            self._cache[key] = guides
        return guides


def guides_at(
    street: Street, config: StreetConfig, mounted: MountedCamera, time_s: float
) -> Guides:
    """Render the denoiser's guides for a camera of the ego vehicle."""
    snapshot = snapshot_at(street, config, time_s)
    pose = camera_pose(street.plan, config, mounted, time_s)
    return render_guides(snapshot, mounted.camera, pose)


def street_tracer(
    street: Street, config: StreetConfig, sky: Sky, renderer: StreetRenderer | None = None
) -> StreetTracer:
    """Return the path tracer of a street under a sky; its actors are placed by `actor_poses_at`."""
    bodies = [Placed(_key(i), actor.parts) for i, actor in enumerate(street.participants)]
    if street.ego_body:
        bodies.append(Placed(_EGO_KEY, street.ego_body))
    return (renderer or StreetRenderer()).tracer(
        [part.transformed(street.plan.world_from_street) for part in street.background],
        bodies,
        street.finishes,
        sky,
        config.environment_height_px,
    )


def _write_jpeg(path: Path, srgb8: UInt8[np.ndarray, "h w 3"]) -> None:
    """Write a JPEG image with 4:2:0 chroma subsampling, as PandaSet's."""
    with whole_file(path) as temporary:
        # Quality 92: chosen, not measured on PandaSet.
        Image.fromarray(srgb8).save(temporary, quality=92, subsampling="4:2:0")


def _key(index: int) -> str:
    return f"actor{index}"


def snapshot_at(street: Street, config: StreetConfig, time_s: float) -> Snapshot:
    """Return the street at a time, with the body of the ego vehicle if it has one."""
    poses = list(actor_poses_at(street, time_s).values())
    return Snapshot(street, poses, world_from_ego(street.plan, config, time_s))


def actor_poses_at(street: Street, time_s: float) -> dict[str, RigidTransform]:
    """Return `world_from_actor` of every participant at a time, by its key in the path tracer."""
    return {
        _key(i): street.plan.world_from_street @ actor.street_from_actor(time_s)
        for i, actor in enumerate(street.participants)
    }
