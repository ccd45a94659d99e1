"""Reconstruction, variant by variant, on held-out frames and sweeps; prints Markdown tables.

    python benchmarks/bench_reconstruction.py SOURCE --out DIR [--truth DIR] [--scale 0.5]
        [--variants tsdf,standard,paper] [--lpips] [--hold-out 8]

Each variant is a build of its own in DIR/<variant> (masks are shared), in a process of its own, so
that memory peaks are its own. Finished stages are kept: an interrupted run goes on.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np

from lightsim.build import pipeline as pipeline
from lightsim.build.measures import held_out_frames
from lightsim.build.options import BuildOptions
from lightsim.build.quality.frames import FramesConfig
from lightsim.build.quality.geometry import THRESHOLDS_M
from lightsim.build.workspace import FIELD_NAME, Workspace
from lightsim.core.buffers import BACKGROUND
from lightsim.core.reading import LogReading
from lightsim.datasets.fingerprint import hash_recording
from lightsim.progress import LineProgress, SilentProgress
from lightsim.render.gbuffers import render_gbuffers
from lightsim.render.scene import make_static_scene, without_actors
from lightsim.store.artefact import hash_names, read_record, state_of
from lightsim.store.exr import read_exr
from lightsim_lab.metrics.lpips import Lpips
from lightsim_lab.studies.twin_error import geometry as measure_geometry

QUICK: dict = {"preset": "draft", "neural_steps": 0}
"""Ablations of the alignment: fused LiDAR and textures of every fourth image."""
VARIANTS: dict[str, dict] = {
    "tsdf": {"neural_steps": 0, "colour": "vertex"},
    "tsdf+texture": {"neural_steps": 0},
    "draft": {"preset": "draft"},
    "standard": {},
    "paper": {"preset": "paper", "neural_steps": 2000},
    "aligned": QUICK,
    "no camera_poses": {**QUICK, "no_refine": ("camera_poses",)},
    "no rolling_shutter": {**QUICK, "no_refine": ("rolling_shutter",)},
    "no lidar_poses": {**QUICK, "no_refine": ("lidar_poses",)},
    "no actor_tracks": {**QUICK, "no_refine": ("actor_tracks",)},
    "no point_times": {**QUICK, "no_refine": ("point_times",)},
    "no ego_vehicle_masks": {**QUICK, "no_refine": ("ego_vehicle_masks",)},
    "no camera_gains": {**QUICK, "no_refine": ("camera_gains",)},
    "recorded": {
        **QUICK,
        "no_refine": ("rolling_shutter", "lidar_poses", "actor_tracks", "camera_poses"),
    },
}
STAGES = ("alignment", "fields", "neural", "geometry", "assets")


def main() -> None:
    options = _arguments()
    if options.one:
        _build_and_measure(options, options.one)
        return
    names = options.variants.split(",")
    _make_masks(options)
    for name in names:
        command = [sys.executable, *sys.argv, "--one", name]
        subprocess.run(command, check=True)
    _print_tables(options, names)


def normal_error_deg(work: Path, truth: Path) -> float:
    """Median angle between the twin's shading normals and the true ones of a synthetic log, on
    static surface of the frames with true buffers."""
    workspace = Workspace(work)
    log, background = workspace.log_at(1.0), workspace.assets.background
    frames = {(f.camera_name, f.stem): f for f in log.frames}
    scene = without_actors(make_static_scene([background]))
    angles: list[np.ndarray] = []
    for path in sorted((truth / "normal_world").glob("*/*.exr")):
        frame = frames.get((path.parent.name, path.stem))
        if frame is None:
            continue
        buffers = render_gbuffers(scene, log.cameras[frame.camera_name], frame)
        true_normal = read_exr(path)
        actor = read_exr(truth / "actor_index" / path.parent.name / path.name)
        is_static = np.rint(actor.reshape(buffers.depth_z_m.shape)) == BACKGROUND
        valid = is_static & buffers.has_surface
        cosine = (buffers.normal_world[valid] * true_normal[valid]).sum(axis=1)
        angles.append(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))
    if not angles:
        raise SystemExit(f"{truth} holds no true normals of a frame of the build")
    return float(np.median(np.concatenate(angles)))


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("source", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--truth", type=Path)
    parser.add_argument("--scale", type=float, default=0.5)
    parser.add_argument("--hold-out", type=int, default=8)
    parser.add_argument("--variants", default="tsdf,tsdf+texture,standard,paper")
    parser.add_argument("--lpips", action="store_true")
    parser.add_argument("--field", action="store_true", help="also score the field itself")
    parser.add_argument("--one", help=argparse.SUPPRESS)
    return parser.parse_args()


def _options(options: argparse.Namespace, name: str) -> BuildOptions:
    reading = LogReading(
        source=str(options.source.resolve()), image_scale=options.scale, hold_out=options.hold_out
    )
    return BuildOptions(reading=reading, **VARIANTS[name])


def _make_masks(options: argparse.Namespace) -> None:
    pipeline.build(
        options.out / "masks", _options(options, "standard"), LineProgress(), until="held_out_masks"
    )


def _build_and_measure(options: argparse.Namespace, name: str) -> None:
    """Build one variant as far as the sky, and write its scores.json."""
    work = options.out / name
    take_from_siblings(options.out, work, _options(options, name))
    pipeline.build(work, _options(options, name), LineProgress(), until="sky")
    frames = held_out_frames(
        Workspace(work),
        SilentProgress(),
        FramesConfig(Lpips() if options.lpips else None, with_exposure=False),
        with_field=options.field and (work / "neural" / FIELD_NAME).exists(),
    )
    geometry, _ = measure_geometry(Workspace(work), options.truth, SilentProgress())
    records = {stage: read_record(work / stage) for stage in STAGES}
    workspace = Workspace(work)
    assets = workspace.assets
    scores = {
        "frames": json.loads(frames.to_json())["rows"],
        "geometry": json.loads(geometry.to_json()),
        "seconds": {stage: record["seconds"] for stage, record in records.items() if record},
        "peak_memory_mb": max(r["peak_memory_mb"] for r in records.values() if r),
        "faces": len(assets.background.faces)
        + sum(len(actor.mesh.faces) for actor in assets.actors.values()),
        "texels": sum(
            0 if mesh.texture is None else mesh.texture.image.shape[0] * mesh.texture.image.shape[1]
            for mesh in (assets.background, *(actor.mesh for actor in assets.actors.values()))
        ),
        "normal_error_deg": None
        if options.truth is None
        else normal_error_deg(work, options.truth),
    }
    (work / "scores.json").write_text(json.dumps(scores, indent=1))


def take_from_siblings(out: Path, work: Path, options: BuildOptions) -> None:
    """Artefacts that another variant has made from the same recipe need not be made again."""
    source_key = hash_names(hash_recording(options.reading))
    for stage, artefact_key in pipeline.artefact_keys(options, source_key).items():
        for other in sorted(out.glob("*/")):
            if state_of(work / stage, artefact_key) == "made":
                break
            if state_of(other / stage, artefact_key) == "made":
                shutil.copytree(other / stage, work / stage, dirs_exist_ok=True)


def _print_tables(options: argparse.Namespace, names: list[str]) -> None:
    scores = {name: json.loads((options.out / name / "scores.json").read_text()) for name in names}
    rows = [r for r in scores[names[0]]["frames"] if r["region"] == "masked"]
    cameras = list(dict.fromkeys(r["condition"] for r in rows))
    where = f"{options.source.name}, without sky and ego vehicle"
    _print_line(f"\nHeld-out frames of {where}: PSNR dB / SSIM / LPIPS\n")
    _print_line("| | " + " | ".join(c.removesuffix("_camera") for c in cameras) + " | mean |")
    _print_line("|---|" + "---:|" * (len(cameras) + 1))
    for method, label in (("nearest image", "nearest image"), ("twin", "")):
        for name in names[:1] if label else names:
            _print_line(_frame_line(label or name, method, scores[name]["frames"], cameras))
    for name in names if options.field else ():
        if any(row["method"] == "field" for row in scores[name]["frames"]):
            _print_line(
                _frame_line(f"{name}, volume-rendered", "field", scores[name]["frames"], cameras)
            )
    _print_line(
        "\n| | median abs cm | across cm | 90 % cm | hit | F@5 cm | F@10 cm | normals deg "
        "| faces | texels | s | MB |"
    )
    _print_line("|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|")
    for name in names:
        _print_line(_geometry_line(name, scores[name]))


def _frame_line(label: str, method: str, rows: list[dict], cameras: list[str]) -> str:
    cells, table = [], []
    for camera in cameras:
        row = next(
            r
            for r in rows
            if (r["condition"], r["method"], r["region"]) == (camera, method, "masked")
        )
        s = row["scores"]
        table.append([s["psnr_db"], s["ssim"], np.nan if s["lpips"] is None else s["lpips"]])
        cells.append(_cell(table[-1]))
    return f"| {label} | " + " | ".join([*cells, _cell(np.mean(table, axis=0).tolist())]) + " |"


def _cell(values: list[float]) -> str:
    psnr, ssim, lpips = values
    return f"{psnr:.2f} / {ssim:.3f}" + ("" if np.isnan(lpips) else f" / {lpips:.3f}")


def _geometry_line(name: str, scores: dict) -> str:
    lidar, surface = scores["geometry"]["lidar"], scores["geometry"].get("surface") or []
    f_scores = [f"{row['f_score']:.3f}" for row in surface] or ["-", "-"]
    normals = scores["normal_error_deg"]
    across = 100 * lidar["median_across_m"]
    return (
        f"| {name} | {100 * lidar['median_abs_m']:.1f} | {across:.1f} "
        f"| {100 * lidar['percentile_90_m']:.1f} "
        f"| {lidar['hit_rate']:.3f} | {f_scores[0]} | {f_scores[1]} "
        f"| {'-' if normals is None else f'{normals:.1f}'} | {scores['faces'] / 1e3:.0f} k "
        f"| {scores['texels'] / 1e6:.1f} M | {sum(scores['seconds'].values()):.0f} "
        f"| {scores['peak_memory_mb']} |"
    )


def _print_line(line: str) -> None:
    sys.stdout.write(line + "\n")


if __name__ == "__main__":
    assert THRESHOLDS_M == (0.05, 0.10)
    main()
