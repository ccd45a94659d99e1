"""What each stage of the build does, on a work folder; the order stands in pipeline.py."""
