"""The laboratory of LightSim: synthetic streets with ground truth, training, metrics, the compared
methods, the benchmark and the tables of the paper.

It imports the product `lightsim`, never the reverse, and adds the commands `synthesize`, `train`,
`evaluate` and `demo` and the methods `colour-transfer`, `self-osr`, `epe` and `nerf-osr` to it
through entry points.
"""
