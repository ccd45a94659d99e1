"""LiDAR sweeps of an edited log: beams whose surface changed, and their simulated returns."""
