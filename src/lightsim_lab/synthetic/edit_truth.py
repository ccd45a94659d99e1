"""True images, buffers and LiDAR sweeps of edited streets (`truth/edits`)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from lightsim.core.mesh import Material, TriMesh
from lightsim.progress import Progress
from lightsim.render.denoise import check_installed
from lightsim.store.images import write_exr, write_png
from lightsim.store.meshes import write_glb
from lightsim_lab.synthetic.edits import (
    INSERTED_MODEL,
    TrueEdit,
    View,
    choose_edits,
    staged_street,
)
from lightsim_lab.synthetic.generate import actor_poses_at, guides_at, street_tracer
from lightsim_lab.synthetic.geometry import Snapshot
from lightsim_lab.synthetic.lidar import scan
from lightsim_lab.synthetic.participants import Participant
from lightsim_lab.synthetic.plan import Size, StreetConfig, Style, config_of, plan_street
from lightsim_lab.synthetic.renderers import StreetRenderer
from lightsim_lab.synthetic.rig import SWEEP_S, mount_cameras
from lightsim_lab.synthetic.sensor import camera_isp
from lightsim_lab.synthetic.shapes import joined
from lightsim_lab.synthetic.skies import Sky, build_sky, sky_specs
from lightsim_lab.synthetic.street import Street, build_street
from lightsim_lab.synthetic.textures import Finish
from lightsim_lab.synthetic.tracing import StreetTracer
from lightsim_lab.synthetic.truth import compute_buffers, stem_of
from lightsim_lab.synthetic.writer import camera_pose, utc_s, write_json, write_sweep

_BUFFERS = ("depth_z_m", "actor_index", "sun_visibility")


@dataclass(frozen=True, eq=False)
class _Staged:
    """Street of one edit, and the folder of its files."""

    edit: TrueEdit
    street: Street
    config: StreetConfig
    folder: Path


def synthesize_edits(
    out: Path,
    *,
    seed: int,
    size: Size,
    progress: Progress,
    is_denoised: bool = False,
    renderer: StreetRenderer | None = None,
    style: Style = "city",
) -> None:
    """Write OUT/truth/edits to an output folder of `synthesize`; existing files are not replaced.

    Raises:
        InputError: the seed is negative, OUT is not writable, or there is no CUDA device.
        MissingDependencyError: denoising requires the extra `denoise`, and Cycles an interpreter
            with bpy.
    """
    renderer = renderer or StreetRenderer()
    if is_denoised:
        check_installed()
    config, plan = config_of(size), plan_street(seed, style)
    street = staged_street(build_street(plan, config.ego_speed_m_s))
    cameras = mount_cameras(plan, config)
    sky = build_sky(sky_specs(plan)[0], plan).exposed(renderer.sensor.exposure_ev)
    assert sky.sun is not None
    edits = choose_edits(street, config, cameras, sky.sun.direction_world)
    staged = [_staged(out / "truth" / "edits", street, config, edit) for edit in edits]
    # Light paths come last: they take most of the time, and all else is complete if they stop.
    for one in staged:
        _write_scenario(one)
        _write_sweeps(one)
    shots = [(one, view) for one in staged for view in one.edit.views]
    for one, view in progress.track(shots, "exact buffers of edits"):
        _write_buffers(one, view, sky)
    tracer = street_tracer(street, config, sky, renderer)
    for one, view in progress.track(shots, f"rendering edits ({tracer.variant})"):
        path = one.folder / "frames" / view.mounted.camera.name / f"{stem_of(view.index)}.png"
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            radiance = _radiance(tracer, one, view, is_denoised=is_denoised)
            # Without sensor noise, as all pictures of the truth.
            write_png(path, camera_isp(radiance, view.mounted.gain, None, renderer.sensor))


def _staged(root: Path, street: Street, config: StreetConfig, edit: TrueEdit) -> _Staged:
    return _Staged(
        edit,
        replace(street, participants=edit.participants),
        replace(config, ego_offset_m=edit.ego_offset_m),
        root / edit.name,
    )


def _write_scenario(staged: _Staged) -> None:
    """Write SCENARIO.json, and the model if it inserts one."""
    if not staged.edit.entries:
        return
    edits = list(staged.edit.entries)
    scenario = {"version": 1, "name": staged.edit.name, "edits": edits}
    write_json(staged.folder / "SCENARIO.json", scenario)
    if any(entry["do"] == "insert" for entry in edits):
        write_glb(staged.folder / INSERTED_MODEL, model_of(staged.street))


def model_of(street: Street) -> TriMesh:
    """Convert the last participant to a mesh with flat faces and the materials of its finishes.

    Base colour, roughness and metallic are retained; clear coat and specular level are not.
    """
    actor: Participant = street.participants[-1]
    counts = [len(part.faces) for part in actor.parts]
    colours = [street.finishes[p.material].look_up(p.uv_m.astype(float)) for p in actor.parts]
    return TriMesh(
        "actor",
        *joined(actor.parts),
        np.concatenate(colours).astype(np.float32),
        tuple(_material(part.material, street.finishes) for part in actor.parts),
        np.repeat(np.arange(len(actor.parts), dtype=np.uint8), counts),
    )


def _material(name: str, finishes: Mapping[str, Finish]) -> Material:
    finish = finishes[name]
    return Material(float(finish.roughness.mean()), finish.metallic, name)


def _write_sweeps(staged: _Staged) -> None:
    """Write the LiDAR sweeps of an edit, with noise; those without edits are in the log."""
    street, config = staged.street, staged.config
    if not staged.edit.entries:
        return
    for k in config.truth_stems:
        path = staged.folder / "lidar" / f"{stem_of(k)}.pkl.gz"
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            time_s = SWEEP_S * k
            # The same random stream as in the log: the noise of unchanged rays is the same.
            rng = np.random.default_rng([street.plan.seed, 8, k])
            returns = scan(street, config, time_s, rng)
            write_sweep(path, returns, utc_s(street.plan, time_s))


def _write_buffers(staged: _Staged, view: View, sky: Sky) -> None:
    street, camera = staged.street, view.mounted.camera
    paths = {
        name: staged.folder / name / camera.name / f"{stem_of(view.index)}.exr" for name in _BUFFERS
    }
    if all(path.exists() for path in paths.values()):
        return
    snapshot = Snapshot(street, list(actor_poses_at(street, view.time_s).values()))
    pose = camera_pose(street.plan, staged.config, view.mounted, view.time_s)
    buffers = compute_buffers(snapshot, camera, pose, sky)
    for name, path in paths.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        # Depth needs single precision; the other buffers are exact enough in half precision.
        write_exr(path, buffers[name], half=name != "depth_z_m")


def _radiance(
    tracer: StreetTracer, staged: _Staged, view: View, *, is_denoised: bool
) -> Float32[np.ndarray, "h w 3"]:
    """Render the radiance of a view.

    The seed of the light paths depends on the frame alone, so that unedited parts are equal in all
    edits.
    """
    street, config, mounted = staged.street, staged.config, view.mounted
    tracer.place(actor_poses_at(street, view.time_s))
    return tracer.render(
        mounted.camera,
        mounted.margin_px,
        camera_pose(street.plan, config, mounted, view.time_s),
        config.truth_samples,
        view.index,
        guides_at(street, config, mounted, view.time_s) if is_denoised else None,
    )
