"""Write a ROS 2 bag (or MCAP) as a lightsim-log/1 folder: a pattern to edit, not a converter.

Needs `pip install rosbags`. Edit topics, mounting and column names. Odometry must give the pose of
frame `ego` (x forward, y left, z up, on the road) in a fixed frame.
Run: python examples/ros2_to_log.py BAG FOLDER; then: lightsim check FOLDER
"""

import csv
import json
import sys
from pathlib import Path

import numpy as np
from rosbags.highlevel import AnyReader

# Topic: name of the sensor.
CAMERAS = {"/front/image_raw/compressed": "front"}
INFOS = {"/front/camera_info": "front"}
LIDARS = {"/lidar/points": "top"}
ODOMETRY = "/odometry"
# ego_from_camera and ego_from_lidar, from your calibration or /tf_static.
FRONT = [[0, 0, 1, 1.5], [-1, 0, 0, 0], [0, -1, 0, 1.6], [0, 0, 0, 1]]
TOP = [[1, 0, 0, 0.9], [0, 1, 0, 0], [0, 0, 1, 1.9], [0, 0, 0, 1]]
MODELS = {"plumb_bob": "brown", "rational_polynomial": "brown", "equidistant": "kannala_brandt"}
TYPES = ["", "i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8"]

out = Path(sys.argv[2])
top = {"ego_from_lidar": TOP, "points": "raw, at their own times", "time": "start"}
log = {"format": "lightsim-log/1", "clock": "utc", "cameras": {}, "lidars": {"top": top}}
rows = [["time_ns", "x", "y", "z", "qw", "qx", "qy", "qz"]]
for name in (*(f"images/{n}" for n in CAMERAS.values()), *(f"sweeps/{n}" for n in LIDARS.values())):
    (out / name).mkdir(parents=True, exist_ok=True)
with AnyReader([Path(sys.argv[1])]) as reader:
    wanted = {*CAMERAS, *INFOS, *LIDARS, ODOMETRY}
    links = [link for link in reader.connections if link.topic in wanted]
    for link, _, data in reader.messages(connections=links):
        m = reader.deserialize(data, link.msgtype)
        # The sensor's own stamp, not the time of arrival.
        time_ns = m.header.stamp.sec * 10**9 + m.header.stamp.nanosec
        if link.topic == ODOMETRY:
            p, q = m.pose.pose.position, m.pose.pose.orientation
            rows.append([time_ns, p.x, p.y, p.z, q.w, q.x, q.y, q.z])
        elif link.topic in INFOS:
            camera = {"model": MODELS[m.distortion_model], "distortion": m.d.tolist()}
            camera |= {"fx": m.k[0], "fy": m.k[4], "cx": m.k[2], "cy": m.k[5]}
            camera |= {"size_px": [m.width, m.height], "first_pixel_centre": 0.0}
            log["cameras"][INFOS[link.topic]] = camera | {"ego_from_camera": FRONT}
        elif link.topic in CAMERAS:
            path = out / "images" / CAMERAS[link.topic] / f"{time_ns}.jpg"
            path.write_bytes(m.data.tobytes())
        else:
            names, types = [f.name for f in m.fields], [TYPES[f.datatype] for f in m.fields]
            form = {"names": names, "formats": types, "offsets": [f.offset for f in m.fields]}
            points = np.frombuffer(m.data, np.dtype({**form, "itemsize": m.point_step}))
            xyz = np.stack([points[a] for a in "xyz"], axis=1)
            path = out / "sweeps" / LIDARS[link.topic] / f"{time_ns}.npz"
            np.savez(path, xyz=xyz, intensity=points["intensity"])
(out / "log.json").write_text(json.dumps(log, indent=1))
with (out / "ego.csv").open("w", newline="") as file:
    csv.writer(file).writerows(rows)
