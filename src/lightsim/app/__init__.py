"""The viewer, `lightsim view`: a twin, its sky, its actors and its pictures in a web browser."""
