"""Where a twin has sky and where its held-out pictures do, beyond what was measured or inferred.

    python benchmarks/skyline.py WORK [WORK ...]

Rays of every other pixel of held-out frames that meet nothing, or the far field alone. Their mattes
say which fraction of them is sky: prints how much sky is shown as matter, and how much matter
(distant houses, but wires and cornices that have no mesh, too) as sky; Markdown.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from lightsim.build.workspace import Workspace
from lightsim.core.mesh import Provenance
from lightsim.render.casters.embree import make_embree_caster

_EVERY = 2


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("work", type=Path, nargs="+", help="built with --hold-out")
    sys.stdout.write("| twin | sky shown as matter | matter shown as sky |\n|---|---:|---:|\n")
    for folder in parser.parse_args().work:
        covered, sky, missing, matter = _counts(Workspace(folder, is_stale_allowed=True))
        sys.stdout.write(f"| {folder.name} | {covered / sky:.2%} | {missing / matter:.1%} |\n")


def _counts(work: Workspace) -> tuple[float, float, float, float]:
    """Pixels of sky that are covered, of all sky, of matter that is missing, of all matter."""
    log, background = work.log, work.twin.assets.background
    caster = make_embree_caster([background])
    is_far = background.has_provenance(Provenance.BACKGROUND_PROXY)
    covered = sky = missing = matter = 0.0
    for frame in log.frames:
        if frame.stem not in work.held_out:
            continue
        matte = work.sky_matte(frame)[::_EVERY, ::_EVERY].ravel()
        camera = log.cameras[frame.camera_name]
        centres = camera.pixel_centres()[::_EVERY, ::_EVERY].reshape(-1, 2)
        hits = caster.intersect(*frame.pixel_rays(camera, centres))
        is_beyond = ~hits.is_hit | is_far[hits.face_index]
        alpha, is_covered = matte[is_beyond], hits.is_hit[is_beyond]
        covered, sky = covered + alpha[is_covered].sum(), sky + alpha.sum()
        missing += (1 - alpha[~is_covered]).sum()
        matter += (1 - alpha).sum()
    return covered, sky, missing, matter


if __name__ == "__main__":
    main()
