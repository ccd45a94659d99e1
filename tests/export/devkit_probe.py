"""Run by an interpreter with nuscenes-devkit: DATAROOT VERSION OUT writes what the devkit reads."""

# The devkits are in another environment.
# pyright: reportMissingImports=false, reportMissingParameterType=false

import json
import sys
from pathlib import Path

import numpy as np
from nuscenes.nuscenes import NuScenes
from nuscenes.utils.data_classes import LidarPointCloud
from nuscenes.utils.geometry_utils import BoxVisibility, view_points
from nuscenes.utils.splits import get_scenes_of_split


def main(root: str, version: str, out: str) -> None:
    nusc = NuScenes(version=version, dataroot=root, verbose=False)
    boxes, points = [], {}
    for data in nusc.sample_data:
        if data["sensor_modality"] == "lidar":
            cloud = LidarPointCloud.from_file(str(Path(root) / data["filename"]))
            points[data["filename"]] = cloud.points.tolist()
            continue
        _, found, lens = nusc.get_sample_data(data["token"], box_vis_level=BoxVisibility.ANY)
        for box in found:
            row = nusc.get("sample_annotation", box.token)
            corners = view_points(box.corners(), lens, normalize=True)[:2].T
            boxes.append(
                {
                    "file": data["filename"],
                    "is_key_frame": data["is_key_frame"],
                    "instance": row["instance_token"],
                    "category": row["category_name"],
                    "level": nusc.get("visibility", row["visibility_token"])["level"],
                    "lidar": row["num_lidar_pts"],
                    "attributes": [
                        nusc.get("attribute", t)["name"] for t in row["attribute_tokens"]
                    ],
                    "is_front": bool((box.corners()[2] > 0).all()),
                    "corners_px": corners.tolist(),
                    "velocity": np.nan_to_num(nusc.box_velocity(box.token), nan=-99.0).tolist(),
                }
            )
    sample = nusc.sample[0]
    for channel, token in sample["data"].items():
        nusc.render_sample_data(token, out_path=f"{out}.{channel}.png", verbose=False)
    if "LIDAR_TOP" in sample["data"]:
        nusc.render_pointcloud_in_image(
            sample["token"],
            camera_channel=next(c for c in sample["data"] if "CAM" in c),
            out_path=f"{out}.points.png",
            verbose=False,
        )
    scenes = get_scenes_of_split("all", nusc)
    text = json.dumps(
        {
            "boxes": boxes,
            "points": points,
            "scenes": scenes,
            "names": [s["name"] for s in nusc.scene],
        }
    )
    Path(out).write_text(text)


if __name__ == "__main__":
    main(*sys.argv[1:])
