"""Dimensions and finishes of the style `suburban`, chosen by eye after common detached houses."""

from __future__ import annotations

from lightsim_lab.synthetic.styles.coatings import (
    Coating,
    RoadTable,
    blocks,
    clapboard,
    concrete,
    gloss_paint,
    lawn,
    matt,
    metal,
    tiles,
    vertical_boards,
    window,
)
from lightsim_lab.synthetic.styles.fences import FenceTable
from lightsim_lab.synthetic.styles.vegetation import TreeTable
from lightsim_lab.synthetic.textures import Line, brick, plaster, slabs

# Half width of the road between the kerbs, in metres: a lane of 3.2 m and room to park.
ROAD_HALF_M = 5.0
# Distance of the middle of a lane from the centre line, in metres.
LANE_Y_M = 1.65
# Distance of the middle of a row of parked cars from the centre line, in metres.
PARKED_Y_M = 4.0
# Height of the kerbs, in metres.
KERB_HEIGHT_M = 0.14
# Strips behind the kerb: a verge with trees, and a narrow sidewalk.
STRIPS = (("lawn", 1.5), ("sidewalk", 1.5))
# Least and greatest width of the garden on either side of a house, in metres.
SIDE_M = (1.3, 4.2)
# Least and greatest width of a house, in metres.
HOUSE_M = (9.5, 12.5)
# Widths of garages for one car and for two, in metres.
GARAGES_M = (3.6, 5.8)
# Least and greatest distance from the sidewalk to the house, in metres.
SETBACK_M = (7.0, 9.5)
# Least and greatest depth of a house, in metres.
DEPTH_M = (7.5, 9.5)
# Heights of floor, sill, lintel and next floor, in metres, per storey.
STOREYS = ((0.0, 1.2, 2.65, 3.1), (3.1, 4.0, 5.35, 5.8))
# Height of the ridge above the eaves over half the depth of the house: 32 to 42 degrees.
PITCH = (0.62, 0.9)
# Depth of the panes behind the wall, in metres; less than in the city, as timber walls are thin.
RECESS_M = 0.09

# Width, wheel tracks, lines and colour of the road.
ROAD = RoadTable(
    2 * ROAD_HALF_M,
    (-2.45, -0.85, 0.85, 2.45),
    # A continuous yellowed centre line is rare in such streets; one broken line remains.
    (Line(0.0, 0.06, 9.0, 3.0),),
    (0.225, 0.222, 0.218),
)
# Number of finishes of walls.
WALLS = 6
# Number of finishes of roofs.
ROOFS = 4
# Number of finishes of frames and corners.
TRIMS = 2
# Number of finishes of doors.
DOORS = 4
# Number of finishes of panes.
GLASSES = 2
# Texture and linear colour of each finish, and its variation between streets.
COATINGS = {
    "wall0": Coating(clapboard, (0.74, 0.74, 0.71)),
    "wall1": Coating(clapboard, (0.42, 0.50, 0.56)),
    "wall2": Coating(clapboard, (0.70, 0.62, 0.42)),
    "wall3": Coating(plaster, (0.70, 0.66, 0.58)),
    "wall4": Coating(brick, (0.40, 0.17, 0.12)),
    "wall5": Coating(brick, (0.48, 0.36, 0.25)),
    "roof0": Coating(tiles, (0.36, 0.14, 0.09)),
    "roof1": Coating(tiles, (0.13, 0.135, 0.14)),
    "roof2": Coating(tiles, (0.24, 0.17, 0.12)),
    "roof3": Coating(tiles, (0.19, 0.20, 0.18)),
    "trim0": Coating(gloss_paint, (0.80, 0.80, 0.78), 0.03),
    "trim1": Coating(gloss_paint, (0.30, 0.26, 0.22), 0.03),
    "door0": Coating(gloss_paint, (0.36, 0.05, 0.04)),
    "door1": Coating(gloss_paint, (0.05, 0.12, 0.22)),
    "door2": Coating(gloss_paint, (0.08, 0.20, 0.12)),
    "door3": Coating(gloss_paint, (0.26, 0.14, 0.07)),
    "garage": Coating(gloss_paint, (0.76, 0.75, 0.71), 0.03),
    "glass0": Coating(window, (1.0, 1.0, 1.0), 0.02),
    "glass1": Coating(window, (0.9, 1.0, 0.95), 0.02),
    "lawn": Coating(lawn, (0.105, 0.17, 0.05)),
    "hedge": Coating(matt, (0.03, 0.05, 0.02), 0.03),
    "leaf1": Coating(matt, (0.06, 0.115, 0.03), 0.03),
    "leaf": Coating(matt, (0.09, 0.165, 0.04), 0.03),
    "sidewalk": Coating(slabs, (0.46, 0.45, 0.42), 0.03),
    "paving": Coating(blocks, (0.33, 0.27, 0.23), 0.03),
    "drive": Coating(concrete, (0.44, 0.43, 0.41), 0.03),
    "fence0": Coating(gloss_paint, (0.80, 0.80, 0.78), 0.03),
    "fence1": Coating(vertical_boards, (0.30, 0.20, 0.12)),
    "zinc": Coating(metal, (0.50, 0.51, 0.52), 0.03),
    "bin": Coating(gloss_paint, (0.04, 0.07, 0.05)),
}
# Picket fence.
PICKETS = FenceTable("fence0", 1.0, (0.09, 0.02), 0.15)
# Fence of boards.
BOARDS = FenceTable("fence1", 1.8, (0.14, 0.02), 0.145)

# Trees of the verge.
VERGE_TREE = TreeTable(
    (2.1, 2.6), (1.5, 2.1), (3.4, 4.6), 0.12, clusters=13, leaves=170, leaf_m=0.21
)
# Trees of the gardens.
GARDEN_TREE = TreeTable(
    (1.9, 2.6), (2.4, 3.4), (4.6, 6.6), 0.19, clusters=17, leaves=145, leaf_m=0.31
)
# Trees behind the houses.
FAR_TREE = TreeTable((2.0, 3.0), (3.5, 5.0), (7.0, 10.0), 0.25, clusters=8, leaves=60, leaf_m=0.9)
