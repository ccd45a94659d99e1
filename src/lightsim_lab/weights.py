"""Weights that ship with the laboratory: LPIPS and the compared relighting networks."""

from __future__ import annotations

from pathlib import Path

LAB_WEIGHTS_FOLDER = Path(__file__).parent / "data" / "weights"
# Weights of the method `nerf-osr` in a work folder (`lightsim train nerf-osr`).
FIELD_WEIGHTS = "nerf_osr/weights.safetensors"
