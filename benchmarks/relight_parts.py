"""What each estimated part costs a relit frame: the truth put in for one part after the other.

    python benchmarks/relight_parts.py WORK --truth DIR [--cameras front_camera left_camera]
                                       [--weights FILE]

Parts, added in this order: the source sky (base colour is divided anew), camera gains, geometry
with its base colour (light between true surfaces takes that of the twin). Beside them the network
(the package's weights, or those of FILE) on what is estimated, and on the true source sky; and what
needs no picture: Lambert's law from true geometry, base colour and target sky. Scores outside the
true sky, PSNR and LPIPS, mean over the frames that have exact buffers; and where the squared error
lies, by what happens to the sun.
"""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from lightsim.build.quality.metrics import fill_invalid, psnr
from lightsim.build.workspace import Workspace
from lightsim.core.buffers import GBuffers, ShadowBuffers
from lightsim.core.colour import linear_from_srgb8
from lightsim.core.mesh import TriMesh
from lightsim.core.sensors import CameraFrame
from lightsim.relighting.network.model import RelitNet
from lightsim.relighting.network.relight import relit_by_network
from lightsim.relighting.network.stored import network_for
from lightsim.relighting.physical.compose import camera_image
from lightsim.relighting.physical.ratio import (
    CameraAndSkies,
    RatioConfig,
    RelightInputs,
    relight_physical,
)
from lightsim.render.frame_renderer import FrameRenderer, TransportFrame
from lightsim.render.image import sky_image
from lightsim.scenario.replay import replay
from lightsim.simulation.relighter import RelightConfig
from lightsim.store.artefact import read_json
from lightsim.store.exr import read_exr
from lightsim.store.images import read_srgb8
from lightsim_lab.baselines.colour_transfer_tables import BASELINES
from lightsim_lab.metrics.lpips import lpips_features, lpips_of_features
from lightsim_lab.studies.true_surfaces import TrueSurfaces
from lightsim_lab.synthetic.reader import true_sky

PARTS = ("estimated", "+ sky", "+ gains", "+ geometry and base colour")
BY_NETWORK = {"network": "estimated", "network, + sky": "+ sky"}
LAMBERT = "Lambert from truth"


@dataclass(frozen=True)
class TracedFrame:
    """A frame with both its traced geometries and its truth."""

    frame: CameraFrame
    estimated: TransportFrame
    true: TransportFrame
    base_colour: np.ndarray
    visibility: np.ndarray
    is_surface: np.ndarray


class Street:
    """A built twin beside its truth."""

    def __init__(self, work: Path, truth: Path) -> None:
        self.workspace, self.truth = Workspace(work), truth
        self.log = self.workspace.log_at(1.0)
        self.surfaces = TrueSurfaces(truth / "scene.npz", self.workspace)
        twin = self.workspace.twin.assets
        transport = RelightConfig().transport
        self.estimated = FrameRenderer(
            twin.background, self.workspace.unobserved_occluders, transport, 0
        ).with_roofs(self.workspace.uncertain_roofs)
        coloured = _with_colour(self.surfaces.meshes["background"], twin.background)
        empty = replace(coloured, faces=coloured.faces[:0])
        self.true = FrameRenderer(coloured, empty, transport, 0)
        self.skies = {
            "source": true_sky(truth, "source"),
            "estimated": self.workspace.sky.dome,
            **{p.name: true_sky(truth, p.name) for p in sorted((truth / "relit").iterdir())},
        }
        self.gains = {
            name: np.array(gain, np.float32)
            for name, gain in read_json(truth / "truth.json")["camera_gains"].items()
        }

    def targets(self) -> list[str]:
        return [name for name in self.skies if name not in ("source", "estimated")]

    def frame(self, camera_name: str, stem: str) -> TracedFrame:
        frame = next(f for f in self.log.frames_of(camera_name) if f.stem == stem)
        camera = self.log.cameras[camera_name]
        scenario = replay(self.workspace.twin, "as recorded", (frame,), "recorded", 0)

        true = self.true.trace(self.surfaces.scenario, frame, camera)

        def read(what: str, traced: Callable[[], np.ndarray]) -> np.ndarray:
            """What the street wrote; of one without buffers these are the *twin's* base colours,
            moved onto true surfaces, which tells nothing of what true ones would give."""
            path = self.truth / what / camera_name / f"{stem}.exr"
            return read_exr(path) if path.is_file() else traced()

        return TracedFrame(
            frame,
            self.estimated.trace(scenario, frame, camera),
            true,
            read("base_colour", lambda: true.buffers.base_colour),
            read("sun_visibility", lambda: true.light(self.skies["source"]).sun_visibility).reshape(
                true.buffers.depth_z_m.shape
            ),
            true.buffers.has_surface,
        )

    def lambert(self, seen: TracedFrame, target: str) -> np.ndarray:
        """The frame under a target sky as Lambert's law has it, everything true."""
        light = seen.true.light(self.skies[target])
        radiance = (seen.base_colour * light.shaded).astype(np.float32)
        return camera_image(radiance, self.gains[seen.frame.camera_name], 0.0)

    def relit(
        self, seen: TracedFrame, part: str, target: str, network: RelitNet | None = None
    ) -> np.ndarray:
        """The frame under a target sky with the truth in all parts up to `part`, physically or by
        a network."""
        level = PARTS.index(part)
        name = seen.frame.camera_name
        source_sky = self.skies["source" if level >= 1 else "estimated"]
        gain = (
            self.gains[name] if level >= 2 else self.workspace.twin.assets.camera_gains[name]
        ).astype(np.float32)
        traced = seen.true if level >= 3 else seen.estimated
        source, wanted = traced.light(source_sky), traced.light(self.skies[target])
        buffers = traced.buffers
        if level >= 3:
            buffers = replace(buffers, base_colour=seen.base_colour)
        elif level >= 1:
            buffers = _divided_anew(buffers, seen.estimated.light(self.skies["estimated"]), source)
        srgb8 = seen.frame.load_srgb8()
        inputs = RelightInputs(
            radiance=(linear_from_srgb8(srgb8) / gain).astype(np.float32),
            is_clipped=np.any(srgb8 >= 254, axis=-1),
            sky_matte=(~seen.is_surface).astype(np.float32)
            if level >= 3
            else self.workspace.sky_matte(seen.frame),
            buffers=buffers,
            source=source,
            target=wanted,
            target_sky=sky_image(self.skies[target], self.log.cameras[name], seen.frame),
            source_sun=source_sky.sun,
            target_sun=self.skies[target].sun,
            found_visibility=None if level >= 3 else traced.found_visibility(source_sky.sun),
            camera_and_skies=CameraAndSkies(
                gain, seen.frame.world_from_camera, source_sky, self.skies[target]
            ),
        )
        made = (
            relight_physical(inputs, RatioConfig())
            if network is None
            else relit_by_network(network, inputs, RatioConfig()).radiance
        )
        return camera_image(made, gain, 0.0)


def _divided_anew(buffers: GBuffers, before: ShadowBuffers, now: ShadowBuffers) -> GBuffers:
    """Base colour of the same radiance under another source light."""
    factor = (before.shaded + 1e-3) / (now.shaded + 1e-3)
    colour = np.clip(buffers.base_colour * factor, 0.02, 0.95).astype(np.float32)
    return replace(buffers, base_colour=colour)


def _with_colour(mesh: TriMesh, coloured: TriMesh) -> TriMesh:
    """The mesh with the colours of the nearest vertices of another."""
    nearest = KDTree(coloured.vertices).query(mesh.vertices)[1]
    return replace(mesh, base_colour=coloured.base_colour[nearest])


def _error_classes(
    seen: TracedFrame, wanted: ShadowBuffers, has_sun: bool
) -> Mapping[str, np.ndarray]:
    """Surfaces by the true visibility of the sun under the source and under the target sky."""
    lit, after = seen.visibility > 0.5, wanted.sun_visibility > 0.5
    classes = {"lit": lit & seen.is_surface, "shadowed": ~lit & seen.is_surface}
    if not has_sun:
        return classes
    return {
        f"{name} -> {then}": members & (after == is_lit)
        for name, members in classes.items()
        for then, is_lit in (("lit", True), ("shadowed", False))
    }


def picture_scores(
    made: np.ndarray, truth: np.ndarray, is_valid: np.ndarray
) -> tuple[float, float]:
    """PSNR and LPIPS over the valid pixels."""
    filled = lpips_features(fill_invalid(made, truth, is_valid).astype(np.float32))
    distance = lpips_of_features(filled, lpips_features(truth), is_valid)
    return psnr(made, truth, is_valid), distance


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("work", type=Path)
    parser.add_argument("--truth", type=Path, required=True)
    parser.add_argument("--cameras", nargs="*")
    parser.add_argument("--weights", type=Path)
    options = parser.parse_args()
    network = network_for(RelitNet, options.weights).eval()
    street = Street(options.work, options.truth)
    scores: dict[tuple[str, str], list[tuple[float, float]]] = defaultdict(list)
    shares: dict[tuple[str, str, str], list[tuple[float, float, float]]] = defaultdict(list)
    for path in sorted((options.truth / "base_colour").glob("*/*.exr")):
        if options.cameras and path.parent.name not in options.cameras:
            continue
        seen = street.frame(path.parent.name, path.stem)
        source = (seen.frame.load_srgb8() / 255).astype(np.float32)
        for target in street.targets():
            file = options.truth / "relit" / target / path.parent.name / f"{path.stem}.jpg"
            truth = (read_srgb8(file) / 255).astype(np.float32)
            for name, baseline in BASELINES.items():
                made = np.clip(baseline(source, truth, seen.is_surface), 0.0, 1.0)
                scores[target, name].append(picture_scores(made, truth, seen.is_surface))
            others = {LAMBERT: street.lambert(seen, target)} | {
                name: street.relit(seen, part, target, network) for name, part in BY_NETWORK.items()
            }
            for name, picture in others.items():
                made = (picture / 255).astype(np.float32)
                scores[target, name].append(picture_scores(made, truth, seen.is_surface))
            sky = street.skies[target]
            classes = _error_classes(seen, seen.true.light(sky), sky.sun is not None)
            for part in PARTS:
                made = (street.relit(seen, part, target) / 255).astype(np.float32)
                scores[target, part].append(picture_scores(made, truth, seen.is_surface))
                error = made.astype(float) - truth
                square, bias = (error**2).mean(axis=-1), error.mean(axis=-1)
                total = square[seen.is_surface].sum()
                for name, members in classes.items():
                    if members.any():
                        shares[target, name, part].append(
                            (
                                float(members.sum() / seen.is_surface.sum()),
                                float(square[members].sum() / total),
                                float(bias[members].mean()),
                            )
                        )
    sys.stdout.write(_tables(street.targets(), scores, shares))


def _tables(
    targets: Sequence[str],
    scores: Mapping[tuple[str, str], Sequence[tuple[float, float]]],
    shares: Mapping[tuple[str, str, str], Sequence[tuple[float, float, float]]],
) -> str:
    names = [*BASELINES, *PARTS, *BY_NETWORK, LAMBERT]
    lines = ["| target | " + " | ".join(names) + " |", "|---|" + "---:|" * len(names)]
    for target in targets:
        means = [np.mean(scores[target, name], axis=0) for name in names]
        row = " | ".join(f"{psnr_db:.2f} / {lpips:.3f}" for psnr_db, lpips in means)
        lines.append(f"| {target} | {row} |")
    lines += ["", "Fraction of surface / of squared error / bias (sRGB, 0 to 1)", ""]
    lines += ["| target | sun | " + " | ".join(PARTS) + " |", "|---|---|" + "---:|" * len(PARTS)]
    for target, name in dict.fromkeys(key[:2] for key in shares):
        cells = []
        for part in PARTS:
            area, error, bias = np.mean(shares[target, name, part], axis=0)
            cells.append(f"{area:.2f} / {error:.2f} / {bias:+.3f}")
        lines.append(f"| {target} | {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
