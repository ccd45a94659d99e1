"""What ships with LightSim to be inserted: cars, a person, and what stands on road works."""
