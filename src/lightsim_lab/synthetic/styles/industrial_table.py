"""Dimensions and finishes of the style `industrial`, chosen by eye after trading estates."""

from __future__ import annotations

from lightsim_lab.synthetic.styles.coatings import (
    Coating,
    RoadTable,
    concrete,
    gloss_paint,
    matt,
    metal,
    sheet,
    vertical_boards,
    window,
)
from lightsim_lab.synthetic.styles.fences import FenceTable
from lightsim_lab.synthetic.styles.vegetation import TreeTable
from lightsim_lab.synthetic.textures import Line, brick

# Half width of the road, in metres: a lane of 3.6 m, and 3 m for parked lorries.
ROAD_HALF_M = 6.6
# Distance of the middle of a lane from the centre line, in metres.
LANE_Y_M = 1.8
# Distance of the middle of a row of parked lorries from the centre line, in metres.
PARKED_Y_M = 5.2
# Height of the kerbs, in metres.
KERB_HEIGHT_M = 0.12
# Finishes and widths of the strips behind the kerb, in metres.
STRIPS = (("sidewalk", 1.7),)
# Distance of the fence behind the sidewalk, in metres.
FENCE_M = 0.35
# Width of a gate, in metres.
GATE_M = 8.0
# Least and greatest width of a plot, in metres.
PLOT_M = (38.0, 52.0)
# Distance of a hall with loading docks from the sidewalk, in metres.
DOCK_YARD_M = 16.5
# Least and greatest distance of a hall without docks from the sidewalk, in metres.
YARD_M = (10.5, 13.5)
# Depth of a hall, in metres.
HALL_DEPTH_M = 30.0
# Least and greatest height of a hall, in metres.
HALL_HEIGHT_M = (7.5, 10.5)
# Width and height of a roller door, in metres.
DOOR_M = (4.0, 4.3)
# Distance and depth of the ribs of wall sheets, in metres.
WALL_RIBS_M = (0.32, 0.045)
# Distance and depth of the ribs of roller doors, in metres.
DOOR_RIBS_M = (0.14, 0.02)
# Loading dock: height and depth, in metres; height is that of a lorry's floor.
DOCK_M = (1.15, 3.2)
# Saw-tooth roof: length and rise of a tooth, in metres.
TOOTH_M = (6.0, 2.3)
# Container of 20 feet: length, width and height, in metres.
CONTAINER_M = (6.06, 2.44, 2.59)
# Length of a place in the yard, in metres.
PLACE_M = 7.2

# Width, wheel tracks, lines and colour of the road.
ROAD = RoadTable(
    2 * ROAD_HALF_M,
    (-2.75, -0.85, 0.85, 2.75),
    # A continuous centre line and lines that separate the parking strips.
    (Line(0.0, 0.07, 1.0, 1.0), Line(-3.65, 0.06, 6.0, 3.0), Line(3.65, 0.06, 6.0, 3.0)),
    (0.205, 0.200, 0.194),
)
# Number of finishes of walls.
WALLS = 4
# Number of finishes of containers.
BOXES = 4
# Number of finishes of the boxes of lorries.
LORRIES = 4
# Texture and linear colour of each finish, and its variation between streets.
COATINGS = {
    "wall0": Coating(sheet, (0.52, 0.54, 0.55)),
    "wall1": Coating(sheet, (0.20, 0.32, 0.44)),
    "wall2": Coating(sheet, (0.62, 0.58, 0.46)),
    "wall3": Coating(sheet, (0.24, 0.34, 0.26)),
    "brick": Coating(brick, (0.35, 0.17, 0.12)),
    "office": Coating(gloss_paint, (0.66, 0.66, 0.64), 0.03),
    "roof": Coating(sheet, (0.34, 0.35, 0.36), 0.03),
    "plinth": Coating(concrete, (0.40, 0.39, 0.37), 0.03),
    "yard": Coating(concrete, (0.36, 0.35, 0.33), 0.03),
    "sidewalk": Coating(concrete, (0.42, 0.41, 0.39), 0.03),
    "paving": Coating(concrete, (0.30, 0.29, 0.28), 0.03),
    "shutter": Coating(sheet, (0.60, 0.61, 0.60), 0.03),
    "shutter1": Coating(sheet, (0.55, 0.20, 0.06)),
    "frame": Coating(gloss_paint, (0.70, 0.52, 0.04), 0.02),
    "glass0": Coating(window, (1.0, 1.0, 1.0), 0.02),
    "trim0": Coating(gloss_paint, (0.20, 0.21, 0.22), 0.03),
    "iron": Coating(gloss_paint, (0.06, 0.065, 0.07)),
    "zinc": Coating(metal, (0.52, 0.53, 0.54), 0.03),
    "mesh": Coating(metal, (0.45, 0.46, 0.46), 0.03),
    "pipe": Coating(metal, (0.60, 0.60, 0.60), 0.03),
    "pipe1": Coating(gloss_paint, (0.62, 0.40, 0.04)),
    "tank": Coating(gloss_paint, (0.72, 0.72, 0.70), 0.03),
    "pallet": Coating(vertical_boards, (0.40, 0.28, 0.16)),
    "drum": Coating(gloss_paint, (0.05, 0.13, 0.36)),
    "crate0": Coating(sheet, (0.40, 0.08, 0.05)),
    "crate1": Coating(sheet, (0.06, 0.14, 0.32)),
    "crate2": Coating(sheet, (0.10, 0.26, 0.16)),
    "crate3": Coating(sheet, (0.58, 0.30, 0.06)),
    "box0": Coating(gloss_paint, (0.76, 0.76, 0.74), 0.03),
    "box1": Coating(gloss_paint, (0.12, 0.24, 0.44)),
    "box2": Coating(gloss_paint, (0.60, 0.48, 0.10)),
    "box3": Coating(gloss_paint, (0.44, 0.10, 0.08)),
    "leaf": Coating(matt, (0.08, 0.14, 0.04), 0.03),
}
# Fence of bars.
BARS = FenceTable("iron", 2.0, (0.03, 0.03), 0.15, post_m=2.6, rails=(0.08, 0.92))
# Height of a chain-link fence, in metres.
MESH_HEIGHT_M = 2.2
# Distance of its wires, in metres.
MESH_M = 0.13
# Trees along the fences.
POPLAR = TreeTable((1.8, 2.4), (1.2, 1.7), (8.0, 11.0), 0.16, clusters=14, leaves=130, leaf_m=0.32)
