"""Names of the relighting methods."""

from __future__ import annotations

from types import MappingProxyType
from typing import Literal

Method = Literal["network", "physical", "paper", "colour-transfer", "self-osr", "epe", "nerf-osr"]
NETWORKS: tuple[Method, ...] = ("network", "paper", "self-osr", "epe", "nerf-osr")
"""Methods that have weights."""
SHIPPED = MappingProxyType({m: f"relight-{m}" for m in NETWORKS if m != "nerf-osr"})
"""Weights of the package by method; `nerf-osr` has those of its street."""
FIELD_METHOD: Method = "nerf-osr"
FIELD_WEIGHTS = "nerf_osr/weights.safetensors"
"""In a work folder: of `nerf-osr` (`lightsim train nerf-osr`)."""
