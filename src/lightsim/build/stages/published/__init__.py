"""Stages that do what the paper describes and nothing else (`lightsim build --preset paper`)."""
