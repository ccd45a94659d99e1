"""Relighting of one street recorded by different vehicles, against path-traced truth.

    python benchmarks/recorders.py STREET --seed SEED --sway SWAY --out OUT [--only NAME ...]

STREET: of `lightsim synthesize --seed SEED --size small --sway SWAY`. The same pictures are
recorded as PandaSet does (two turning LiDARs as one of 64 beams at 10 Hz, poses with six degrees
of freedom, boxes at 10 Hz), as nuScenes does (as_nuscenes.py), as KITTI does (one camera, raw
sweeps, OXTS, no boxes), and by cameras alone with a point cloud. Each is built with equal settings
and relit under the skies of the truth by the networks that learned on PandaSet-like streets.

Prints a Markdown table: PSNR of all pixels, sRGB, mean over cameras, frames and skies, beside a
copy of the recorded picture. Finished recordings, builds and frames are kept.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from lightsim.build.options import BuildOptions
from lightsim.build.pipeline import build
from lightsim.build.quality.metrics import psnr
from lightsim.core.reading import LogReading
from lightsim.progress import Progress, terminal_progress
from lightsim.simulation.options import RelightOptions
from lightsim.simulation.relight import relight
from lightsim.store.images import read_srgb8
from lightsim_lab.synthetic.as_cameras import record_as_cameras
from lightsim_lab.synthetic.as_kitti import record_as_kitti
from lightsim_lab.synthetic.as_nuscenes import record_as_nuscenes
from lightsim_lab.synthetic.generate import Variation
from lightsim_lab.synthetic.plan import StreetConfig, config_of, plan_street
from lightsim_lab.synthetic.street import Street, build_street

# Cameras that look ahead, by their name in PandaSet; KITTI's vehicle has the first one only.
_CAMERAS = ("front_camera", "front_left_camera", "front_right_camera")
_FRAMES = "0:10"
# Training steps of the neural field, those of the demo.
_STEPS = 60


@dataclass(frozen=True)
class Recording:
    """How a vehicle's log of the street is read.

    Args:
        record: (street, settings, PandaSet log, folder, progress) -> options of reading.
        names: camera's name in the recording, by its name in PandaSet.
    """

    record: Callable[[Street, StreetConfig, Path, Path, Progress], LogReading]
    names: Mapping[str, str]


def _pandaset(
    street: Street, config: StreetConfig, log: Path, out: Path, progress: Progress
) -> LogReading:
    return LogReading(source=str(log))


def _nuscenes(
    street: Street, config: StreetConfig, log: Path, out: Path, progress: Progress
) -> LogReading:
    scene = record_as_nuscenes(street, config, log, out, progress)
    return LogReading(source=str(out), scene=scene, place=_place(street))


def _place(street: Street) -> str:
    return f"{street.plan.latitude_deg},{street.plan.longitude_deg}"


def _kitti(
    street: Street, config: StreetConfig, log: Path, out: Path, progress: Progress
) -> LogReading:
    return LogReading(source=str(record_as_kitti(street, config, log, out)))


def _cameras(
    street: Street, config: StreetConfig, log: Path, out: Path, progress: Progress
) -> LogReading:
    record_as_cameras(street, log, out, progress)
    return LogReading(source=str(out))


_SAME = {name: name for name in _CAMERAS}
RECORDINGS = {
    "pandaset": Recording(_pandaset, _SAME),
    "nuscenes": Recording(
        _nuscenes,
        dict(zip(_CAMERAS, ("CAM_FRONT", "CAM_FRONT_LEFT", "CAM_FRONT_RIGHT"), strict=True)),
    ),
    "kitti": Recording(_kitti, {"front_camera": "image_02"}),
    "cameras": Recording(_cameras, _SAME),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("street", type=Path)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--sway", type=float, default=0.0)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--only", nargs="+", choices=tuple(RECORDINGS), default=tuple(RECORDINGS))
    options = parser.parse_args()
    config = Variation(sway=options.sway).of(config_of("small"))
    street = build_street(plan_street(options.seed), config.ego_speed_m_s)
    progress = terminal_progress()
    rows: list[str] = []
    for name in options.only:
        recording = RECORDINGS[name]
        out = options.out / name
        log = options.street / "log"
        reading = recording.record(street, config, log, out / "log", progress)
        work = _built(reading, recording, out / "work", progress)
        rows += _scored(name, recording, work, options.street, progress)
    print("| recorded as | camera | sky | relit, dB | copy, dB |\n|---|---|---|---:|---:|")  # noqa: T201
    print("\n".join(rows))  # noqa: T201


def _built(reading: LogReading, recording: Recording, work: Path, progress: Progress) -> Path:
    changed = LogReading(
        source=reading.source,
        scene=reading.scene,
        place=reading.place,
        frames=_FRAMES,
        cameras=tuple(recording.names.values()),
        image_scale=1.0,
    )
    build(work, BuildOptions(reading=changed, neural_steps=_STEPS), progress)
    return work


def _scored(
    name: str, recording: Recording, work: Path, street: Path, progress: Progress
) -> list[str]:
    """Return one row for each camera and sky."""
    truth = street / "truth"
    skies = sorted(path.name for path in (truth / "relit").iterdir())
    stems = sorted({path.stem for path in (truth / "relit").glob("*/*/*.jpg")})
    numbers = [int(stem) for stem in stems]
    step = int(np.gcd.reduce(np.diff(numbers))) if len(numbers) > 1 else 1
    asked = RelightOptions(
        name="truth",
        sky=tuple(str(truth / "skies" / f"{sky}.exr") for sky in skies),
        sky_scale="none",
        frames=f"{numbers[0]}:{numbers[-1] + 1}:{step}",
        image_scale=1.0,
        overwrite=True,
    )
    rows: list[str] = []
    for sky, made in zip(skies, relight(work, asked, progress), strict=True):
        for camera, own in recording.names.items():
            relit, copied = [], []
            for stem in stems:
                true = _picture(truth / "relit" / sky / camera / f"{stem}.jpg")
                found = {int(p.stem): p for p in (made / "frames" / own).glob("*.png")}
                relit.append(psnr(_picture(found[int(stem)]), true))
                source = _picture(street / "log" / "camera" / camera / f"{stem}.jpg")
                copied.append(psnr(source, true))
            rows.append(
                f"| {name} | {camera} | {sky} | {np.mean(relit):.2f} | {np.mean(copied):.2f} |"
            )
    return rows


def _picture(path: Path) -> Float32[np.ndarray, "h w 3"]:
    return read_srgb8(path).astype(np.float32) / 255.0


if __name__ == "__main__":
    main()
