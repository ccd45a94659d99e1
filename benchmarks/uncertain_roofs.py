"""What shadows of the mean over all roofs that may be bring, beside those of the likeliest roofs.

    python benchmarks/uncertain_roofs.py WORK --truth DIR [--weights FILE]

Heights of roofs that no view reaches, within 35 m of the path: how far off the likeliest profile
and the median over all are, and how often the truth lies between the tenth and the ninetieth
percentile (well told: 0.8). Then frames relit with either, physically and by the network (the
package's weights, or those of FILE), PSNR / LPIPS outside the true sky, mean over the frames that
have exact buffers. Source sky estimated, target sky known.
"""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict
from pathlib import Path

import numpy as np
from relight_parts import Street, picture_scores

from lightsim.geometry.completion.rooflines import height_prior, tops_at
from lightsim.geometry.surface import keep_faces
from lightsim.relighting.network.model import RelitNet
from lightsim.relighting.network.stored import network_for
from lightsim.render.casters.embree import make_embree_caster
from lightsim.store.images import read_srgb8
from lightsim_lab.synthetic.reader import read_true_meshes

_NEAR_M = 35.0
_HOUSE_M2, _HOUSE_M = 0.5, 3.0
"""True faces this large, this high over the ground, are houses'."""
_BEHIND_M, _PARAPET_M = 3.0, 0.5
"""The true roof is looked for so far behind its wall; walls of these streets end so far above."""


def heights(street: Street, truth: Path) -> str:
    """One line of a table."""
    true = read_true_meshes(truth / "scene.npz")["background"]
    houses = make_embree_caster([keep_faces(true, true.face_areas_m2() > _HOUSE_M2)])
    path = street.log.camera_positions_m
    found, prior = [], height_prior(street.workspace.rooflines)
    cell = street.workspace.rooflines[0].cell_m
    for roofline in street.workspace.rooflines:
        above = roofline.wall.at(roofline.s_m, np.full_like(roofline.s_m, 90.0), -_BEHIND_M)
        down = np.broadcast_to([0.0, 0.0, -1.0], above.shape).copy()
        height = 90.0 - houses.intersect(above, down).distance_m - roofline.ground_m + _PARAPET_M
        foot = roofline.wall.at(roofline.s_m, np.zeros_like(roofline.s_m))
        away = np.linalg.norm(foot[:, None, :2] - path[None, :, :2], axis=2).min(axis=1)
        asked = ~roofline.is_seen & (away < _NEAR_M) & (height > _HOUSE_M)
        asked &= np.isfinite(height) & (roofline.height_m > _HOUSE_M)
        tops = tops_at(roofline, prior, np.array([0.1, 0.5, 0.9]))
        floor = roofline.wall.height_m[0] - roofline.ground_m
        low, middle, high = floor + roofline.cell_m * tops
        rows = (roofline.height_m - height, middle - height, height - low, high - height)
        found.append(np.stack(rows)[:, asked])
    likely, middle, over, under = np.concatenate(found, axis=1)
    within = ((over > -cell) & (under > -cell)).mean()
    return (
        f"{len(likely)} columns, mean error of the likeliest {np.abs(likely).mean():.2f} m, "
        f"of the median {np.abs(middle).mean():.2f} m; {within:.2f} of the truth within 10-90 %\n"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("work", type=Path)
    parser.add_argument("--truth", type=Path, required=True)
    parser.add_argument("--weights", type=Path)
    options = parser.parse_args()
    network = network_for(RelitNet, options.weights).eval()
    street = Street(options.work, options.truth)
    sys.stdout.write(heights(street, options.truth))
    renderers = {"likely": street.estimated.with_roofs(None), "expected": street.estimated}
    scores: dict[tuple[str, str], list[tuple[float, float]]] = defaultdict(list)
    for path in sorted((options.truth / "base_colour").glob("*/*.exr")):
        for roofs, street.estimated in renderers.items():
            seen = street.frame(path.parent.name, path.stem)
            for target in street.targets():
                file = options.truth / "relit" / target / path.parent.name / f"{path.stem}.jpg"
                truth = (read_srgb8(file) / 255).astype(np.float32)
                for method, by in (("physical", None), ("network", network)):
                    made = (street.relit(seen, "estimated", target, by) / 255).astype(np.float32)
                    row = picture_scores(made, truth, seen.is_surface)
                    scores[target, f"{method}, {roofs}"].append(row)
    names = [f"{m}, {roofs}" for m in ("physical", "network") for roofs in ("likely", "expected")]
    lines = ["| target | " + " | ".join(names) + " |", "|---|" + "---:|" * len(names)]
    for target in street.targets():
        means = [np.mean(scores[target, name], axis=0) for name in names]
        lines.append(f"| {target} | " + " | ".join(f"{a:.2f} / {b:.3f}" for a, b in means) + " |")
    sys.stdout.write("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
