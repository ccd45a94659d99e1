"""Extensions of LightSim: see pyproject.toml for the entry points."""
