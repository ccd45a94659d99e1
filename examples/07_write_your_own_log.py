"""Write a recording of your own as a lightsim-log/1 folder, here from made arrays.

Run: python examples/07_write_your_own_log.py [folder]; then: lightsim check folder/my-log
"""

import csv
import json
import sys
from pathlib import Path

import numpy as np
from PIL import Image

out = Path(sys.argv[1] if len(sys.argv) > 1 else "out/example") / "my-log"
(out / "images" / "front").mkdir(parents=True, exist_ok=True)
(out / "sweeps" / "top").mkdir(parents=True, exist_ok=True)
# x right, y down, z forward of a camera that looks ahead, 1.6 m above the road.
ego_from_camera = [[0, 0, 1, 1.5], [-1, 0, 0, 0], [0, -1, 0, 1.6], [0, 0, 0, 1]]
ego_from_lidar = [[1, 0, 0, 0.9], [0, 1, 0, 0], [0, 0, 1, 1.9], [0, 0, 0, 1]]
front = {"model": "pinhole", "size_px": [64, 48], "fx": 60, "fy": 60, "cx": 31.5, "cy": 23.5}
front |= {"first_pixel_centre": 0.0, "ego_from_camera": ego_from_camera}
front |= {"readout_s": 0.02, "readout": "top_to_bottom", "time": "start"}
top = {"ego_from_lidar": ego_from_lidar, "points": "raw, at their own times"}
top |= {"time": "start", "intensity_max": 255}
log = {"format": "lightsim-log/1", "clock": "utc", "place": [48.137, 11.575]}
log |= {"world_x_azimuth_deg": 90.0, "cameras": {"front": front}, "lidars": {"top": top}}
(out / "log.json").write_text(json.dumps(log, indent=1))

turn = np.linspace(0, 2 * np.pi, 1000, endpoint=False)
xyz = np.stack([8 * np.cos(turn), 8 * np.sin(turn), np.full(1000, -1.9)], axis=1)
sweep = {"xyz": xyz.astype("f4"), "intensity": np.full(1000, 51, "u1")}
rows = [["time_ns", "x", "y", "z", "qw", "qx", "qy", "qz"]]
for i in range(20):
    # Ten poses a second; the vehicle drives along world +x at 10 m/s.
    time_ns = 1_600_000_000_000_000_000 + i * 100_000_000
    rows.append([time_ns, 1.0 * i, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    picture = Image.fromarray(np.full((48, 64, 3), 120, np.uint8))
    picture.save(out / "images" / "front" / f"{time_ns}.png")
    np.savez(out / "sweeps" / "top" / f"{time_ns}.npz", time_offset_s=turn / 62.8, **sweep)
with (out / "ego.csv").open("w", newline="") as file:
    csv.writer(file).writerows(rows)
