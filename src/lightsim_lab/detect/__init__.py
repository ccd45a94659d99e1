"""Camera detector of vehicles in bird's-eye view (BEV): a measure of the use of relit pictures."""
