"""Twin, scenario and skies to frames, films and labels. `lightsim.simulate` is the function."""
