"""A fuzzer for everything LightSim reads: damaged, implausible and hostile files.

`python -m tools.fuzz LOG COUNT SEED` from the repository's root; docs/reference/reliability.md.
"""
