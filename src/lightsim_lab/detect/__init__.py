"""Camera detector of vehicles in bird's-eye view (BEV), which measures the use of relit pictures."""
