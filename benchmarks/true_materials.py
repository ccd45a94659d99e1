"""What a synthetic street's true surfaces are made of, which its plan tells."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lightsim.core.mesh import TriMesh
from lightsim.store.artefact import read_json
from lightsim_lab.synthetic.plan import plan_street
from lightsim_lab.synthetic.street import build_background


def material_names(background: TriMesh, truth: Path) -> np.ndarray:
    """Name of the material of each face of the true background (`read_true_meshes`)."""
    facts = read_json(truth / "truth.json")
    # Truths made before there were styles are cities.
    parts = build_background(plan_street(facts["seed"], facts.get("style", "city")))
    counts = [len(part.faces) for part in parts]
    assert sum(counts) == len(background.faces)
    return np.repeat([part.material for part in parts], counts)
