"""LiDAR sweeps of an edited log: which beams meet something else now, and what comes back."""
