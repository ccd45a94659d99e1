"""Dimensions and finishes of the style `boulevard`, chosen by eye after European avenues."""

from __future__ import annotations

from lightsim_lab.synthetic.styles.coatings import (
    Coating,
    RoadTable,
    ashlar,
    blocks,
    gloss_paint,
    lawn,
    matt,
    metal,
    polished_metal,
    tiles,
    wall_tiles,
    window,
)
from lightsim_lab.synthetic.styles.fences import FenceTable
from lightsim_lab.synthetic.styles.vegetation import TreeTable
from lightsim_lab.synthetic.textures import Line, brick, plaster, slabs

# y of the edges of the two roads, frame `street`, in metres: the ego vehicle drives in the inner
# lane of the near road, whose path is at y = -1.7. Median and tracks are to its left.
NEAR_ROAD_M = (-8.9, 0.25)
# y of the edges of the road beyond the tracks, in metres.
FAR_ROAD_M = (13.25, 22.4)
# Height of the kerbs, in metres.
KERB_HEIGHT_M = 0.15
# Strips of the median, from the near road to the far one: trees, tracks, trees.
MEDIAN = (("gravel", 2.9), ("trackbed", 6.84), ("gravel", 2.9))
# y of the rows of trees, in metres.
TREE_ROWS_Y_M = (1.75, 11.75)
# Distance of the trees of a row, in metres.
TREE_PITCH_M = 9.8
# y of the middles of the two tracks, in metres.
TRACKS_Y_M = (5.1, 8.4)
# Half the gauge of a track, in metres: standard gauge.
HALF_GAUGE_M = 0.7175
# Height of the contact wires, in metres.
WIRE_M = 5.6
# Distance of the masts of the wires, in metres.
MAST_PITCH_M = 30.0
# Width of the sidewalk, in metres.
SIDEWALK_M = 4.8
# y of the middles of the lanes of the near road, in metres.
LANES_Y_M = (-1.7, -5.0)
# y of the middles of the lanes beyond the tracks, in metres.
FAR_LANES_Y_M = (15.2, 18.5)
# y of the middles of the parking rows, in metres.
PARKED_Y_M = (-7.75, 21.25)

# Width, wheel tracks, lines and colour of each road.
ROAD = RoadTable(
    9.15,
    (3.4, 1.8, 0.1, -1.5),
    # A broken line between the lanes, one to the parking row, and the inner edge line.
    (Line(0.975, 0.06, 9.0, 3.0), Line(-2.33, 0.06, 2.0, 1.0), Line(4.3, 0.06, 1.0, 1.0)),
    (0.165, 0.163, 0.162),
)
# Least and greatest width of a building, in metres.
WIDTH_M = (14.0, 24.0)
# Numbers of floors, drawn with equal probability.
FLOORS = (5, 6, 6, 7, 8)
# Height of the ground floor, in metres.
GROUND_FLOOR_M = 4.6
# Height of each upper floor, in metres.
FLOOR_M = 3.4
# Depth of the buildings, in metres.
DEPTH_M = 14.0
# Depth of the panes behind the wall by kind of facade, in metres.
RECESS_M = {"stone": 0.36, "brick": 0.26, "tile": 0.14}

# Number of finishes of awnings.
AWNINGS = 4
# Number of finishes of signs.
SIGNS = 3
# Number of finishes of panes.
GLASSES = 2
# Finishes of the walls by kind of facade.
WALLS = {
    "stone": ("wall0", "wall1", "wall2"),
    "brick": ("wall3", "wall4"),
    "tile": ("wall5", "wall6"),
}
# Finishes of the roofs.
ROOFS = ("roof0", "roof1")
# Texture and linear colour of each finish, and its variation between streets.
COATINGS = {
    "wall0": Coating(ashlar, (0.66, 0.60, 0.48), 0.03),
    "wall1": Coating(ashlar, (0.56, 0.53, 0.47), 0.03),
    "wall2": Coating(plaster, (0.72, 0.64, 0.46)),
    "wall3": Coating(brick, (0.36, 0.14, 0.10)),
    "wall4": Coating(brick, (0.30, 0.20, 0.15)),
    "wall5": Coating(wall_tiles, (0.16, 0.30, 0.30)),
    "wall6": Coating(wall_tiles, (0.62, 0.61, 0.57)),
    "trim0": Coating(matt, (0.70, 0.66, 0.56), 0.03),
    "trim1": Coating(matt, (0.55, 0.53, 0.49), 0.03),
    "roof0": Coating(tiles, (0.12, 0.13, 0.15)),
    "roof1": Coating(metal, (0.40, 0.43, 0.46), 0.03),
    "glass0": Coating(window, (1.0, 1.0, 1.0), 0.02),
    "glass1": Coating(window, (0.85, 0.95, 1.0), 0.02),
    "shop": Coating(gloss_paint, (0.07, 0.10, 0.09), 0.3),
    "iron": Coating(gloss_paint, (0.035, 0.04, 0.04)),
    "awning0": Coating(matt, (0.40, 0.05, 0.05), 0.03),
    "awning1": Coating(matt, (0.06, 0.20, 0.13), 0.03),
    "awning2": Coating(matt, (0.62, 0.58, 0.48), 0.03),
    "awning3": Coating(matt, (0.08, 0.12, 0.30), 0.03),
    "sign0": Coating(gloss_paint, (0.55, 0.10, 0.06)),
    "sign1": Coating(gloss_paint, (0.08, 0.22, 0.50)),
    "sign2": Coating(gloss_paint, (0.75, 0.65, 0.20)),
    "zinc": Coating(metal, (0.50, 0.51, 0.52), 0.03),
    "rail": Coating(polished_metal, (0.55, 0.54, 0.52), 0.03),
    "gravel": Coating(matt, (0.46, 0.40, 0.31), 0.03),
    "trackbed": Coating(lawn, (0.11, 0.16, 0.055)),
    "sidewalk": Coating(slabs, (0.48, 0.46, 0.42), 0.03),
    "paving": Coating(blocks, (0.30, 0.29, 0.28), 0.03),
    "leaf": Coating(matt, (0.075, 0.15, 0.035), 0.03),
    "bench": Coating(gloss_paint, (0.20, 0.11, 0.05)),
    "livery": Coating(gloss_paint, (0.52, 0.06, 0.05), 0.5),
    "livery1": Coating(gloss_paint, (0.72, 0.71, 0.67), 0.03),
}
# Railing of the balconies.
RAILING = FenceTable("iron", 1.0, (0.025, 0.025), 0.21, post_m=2.4, rails=(0.08, 0.96))
# Trees of the median.
ROW_TREE = TreeTable((3.4, 4.0), (2.3, 3.0), (7.0, 9.0), 0.22, clusters=13, leaves=125, leaf_m=0.36)
# Trees of the sidewalks.
SIDEWALK_TREE = TreeTable((2.6, 3.0), (1.5, 1.9), (4.0, 5.0), 0.14, clusters=11, leaves=100)
