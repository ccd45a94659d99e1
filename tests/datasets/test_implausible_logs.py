"""Logs that parse but cannot be: refused with the file, the value and the limit, or noted."""

from __future__ import annotations

import shutil
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from datasets.mini_log import (
    CALIBRATION,
    HEIGHT_PX,
    START_S,
    WIDTH_PX,
    cuboid_columns,
    sweep_columns,
    write_frame,
    write_mini_log,
)
from datasets.test_bad_logs import (
    FRONT,
    SWEEP,
    Break,
    change_boxes,
    change_json,
    read_everything,
    with_value,
    write_text,
)
from lightsim.core.reading import OWN_DATASETS, LogReading
from lightsim.datasets.layout import has_file
from lightsim.datasets.reader import check_layout, read_log
from lightsim.errors import InputError


def picture(kind: str, name: str = f"{FRONT}/01.jpg") -> Break:
    """Another picture of the right size under the name of a JPEG."""
    wide = (np.arange(HEIGHT_PX * WIDTH_PX, dtype=np.uint16) * 27).reshape(HEIGHT_PX, WIDTH_PX)

    def apply(log: Path) -> None:
        if kind == "png16":
            Image.fromarray(wide).save(log / name, format="PNG")
        elif kind == "float":
            Image.fromarray(wide.astype(np.float32)).save(log / name, format="TIFF")
        elif kind == "cmyk":
            Image.new("CMYK", (WIDTH_PX, HEIGHT_PX)).save(log / name, format="JPEG")
        else:
            Image.new("RGB", (WIDTH_PX, HEIGHT_PX)).save(log / name, format=kind)

    return apply


def png_rgb16(log: Path) -> None:
    """Colour of 16 bits, which Pillow reads but does not write."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    header = struct.pack(">IIBBBBB", WIDTH_PX, HEIGHT_PX, 16, 2, 0, 0, 0)
    rows = bytes((1 + 6 * WIDTH_PX) * HEIGHT_PX)
    (log / FRONT / "01.jpg").write_bytes(
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(rows))
        + chunk(b"IEND", b"")
    )


def file_instead(name: str) -> Break:
    def apply(log: Path) -> None:
        shutil.rmtree(log / name, ignore_errors=True)
        (log / name).write_text("not a folder")

    return apply


def folder_instead(name: str) -> Break:
    def apply(log: Path) -> None:
        (log / name).unlink()
        (log / name).mkdir()

    return apply


def moved(camera: str, metres: float, entries: slice = slice(1, 2)) -> Break:
    def change(poses: list[Any]) -> list[Any]:
        for pose in poses[entries]:
            pose["position"]["x"] += metres
        return poses

    return change_json(f"camera/{camera}/poses.json", change)


def retimed(name: str, change: Callable[[float], float]) -> Break:
    return change_json(f"{name}/timestamps.json", lambda times: [change(t) for t in times])


def calibration(old: str, new: str) -> Break:
    assert old in CALIBRATION
    return write_text("static_extrinsic_calibration.yaml", CALIBRATION.replace(old, new))


def rename_camera(name: str) -> Break:
    return lambda log: (log / "camera/back_camera").rename(log / "camera" / name) and None


def long_tram(log: Path) -> None:
    for i in range(3):
        table = {**cuboid_columns(START_S + 0.1 * i), "dimensions.y": [45.0, 4.2, 4.2]}
        write_frame(log / f"annotations/cuboids/{i:02d}.pkl.gz", table)


def far_sweep(log: Path) -> None:
    table = sweep_columns(START_S)
    table["x"] = table["x"] + 10_000.0
    write_frame(log / SWEEP, table)


def link_to_nowhere(log: Path) -> None:
    (log / "meta/gps.json").unlink()
    (log / "meta/gps.json").symlink_to(log / "gone.json")


def resized(factor: float) -> Break:
    """All pictures of the front camera at another size, its intrinsics as they were."""

    def apply(log: Path) -> None:
        size = (round(WIDTH_PX * factor), round(HEIGHT_PX * factor))
        for path in (log / FRONT).glob("*.jpg"):
            Image.new("RGB", size, (90, 120, 150)).save(path)

    return apply


INTRINSICS = f"{FRONT}/intrinsics.json"
CASES: list[tuple[str, Break, str]] = [
    ("16-bit grey", picture("png16"), r"01\.jpg: the picture cannot be read.*(I;16|16 bits)"),
    ("16-bit colour", png_rgb16, r"01\.jpg: the picture cannot be read.*(I;16|16 bits)"),
    ("float picture", picture("float"), r"01\.jpg: the picture cannot be read.*JPEG or PNG"),
    ("CMYK picture", picture("cmyk"), r"01\.jpg: the picture cannot be read.*CMYK"),
    ("EPS picture", picture("EPS"), r"01\.jpg: the picture cannot be read.*JPEG or PNG"),
    ("GIF picture", picture("GIF"), r"01\.jpg: the picture cannot be read.*JPEG or PNG"),
    ("tiny fx", change_json(INTRINSICS, with_value(("fx",), 1e-9)), r"intrinsics\.json: .*fit"),
    (
        "both focal lengths tiny",
        change_json(INTRINSICS, lambda k: {**k, "fx": 1e-9, "fy": 1e-9}),
        r"intrinsics\.json: the focal length .*170 degrees",
    ),
    (
        "both focal lengths huge",
        change_json(INTRINSICS, lambda k: {**k, "fx": 1e5, "fy": 1e5}),
        r"intrinsics\.json: the focal length .*2 to 170 degrees",
    ),
    ("one pose 10 km off", moved("front_camera", 1e4), r"poses\.json\[1\]: .*e\+0[45] m/s"),
    (
        "a world 1000 km off",
        moved("front_camera", 1e6, slice(None)),
        r"poses\.json\[2\]: .*world's origin",
    ),
    (
        "a camera on another car",
        moved("back_camera", 1e3, slice(None)),
        r"back_camera/poses\.json\[\d\]: .*too far from the other cameras",
    ),
    (
        "a pose turned round",
        change_json(
            f"{FRONT}/poses.json", with_value((1, "heading"), {"w": 1, "x": 0, "y": 0, "z": 0})
        ),
        r"poses\.json\[1\]: .*degrees in 0\.1 s",
    ),
    ("front a second late", retimed(FRONT, lambda t: t + 1), r"front_camera/times.*other sensors"),
    (
        "back a second late",
        retimed("camera/back_camera", lambda t: t + 1),
        r"back_camera/timestamps\.json: .*got 0\.9\d* s",
    ),
    ("front a day early", retimed(FRONT, lambda t: t - 86400), r"front_camera/times.*8.64e\+04 s"),
    (
        "front stretched",
        retimed(FRONT, lambda t: START_S + 10 * (t - START_S)),
        r"front_camera/timestamps\.json: the times differ",
    ),
    ("GPS of another day", retimed("meta", lambda t: t + 86400), r"meta/timestamps\.json: no GPS"),
    ("points 10 km away", far_sweep, r"lidar/00\.pkl\.gz: .*too far from the vehicle"),
    ("a box of 10 km", change_boxes(dimensions__y=1e4), r"cuboids/00.*row 0 .*too large.*60 m"),
    ("a box of 60 m", change_boxes(dimensions__x=60.0), r"cuboids/00.*row 0 .*too large"),
    ("a box 10 km away", change_boxes(position__y=1e4), r"cuboids/00.*row 0 .*LiDAR's range"),
    (
        "a box around the vehicle",
        change_boxes(position__x=0.0, position__y=0.0, dimensions__z=9.0),
        r"cuboids/00.*row 0 .*contains the recording LiDAR",
    ),
    (
        "pictures of half the size",
        resized(0.5),
        r"intrinsics\.json: .*another size, got pictures of 32x18 px.*about 64x36 px.*by 0\.5\.",
    ),
    ("pictures of a quarter", resized(0.25), r"intrinsics\.json: .*another size.*16x9 px"),
    ("pictures of twice the size", resized(2.0), r"intrinsics\.json: .*another size.*128x72 px"),
    (
        "PandaSet's lens for other pictures",
        change_json(INTRINSICS, lambda k: {"fx": 1970, "fy": 1970, "cx": 970, "cy": 483.3}),
        r"intrinsics\.json: .*got pictures of 64x36 px.*about 1920x1080 px.*by 0\.03333",
    ),
    (
        "slow readout",
        calibration("readout_s: 0.0", "readout_s: 0.5"),
        r"front_camera': the read",
    ),
    (
        "endless readout",
        calibration("readout_s: 0.0", "readout_s: 1e999"),
        r"incomplete, got s inf",
    ),
    ("negative readout", calibration("readout_s: 0.0", "readout_s: -0.01"), r"0 to 0\.1"),
    ("distant mount", calibration("z: -0.5", "z: -1e300"), r"the translation is incomplete"),
    ("endless mount", calibration("z: -0.5", "z: -1e999"), r"the translation is incomplete.*-inf"),
    ("mount in millimetres", calibration("z: -0.5", "z: -500"), r"got a translation of 500 m"),
    ("LiDAR is a file", file_instead("lidar"), r"lidar: the path has the wrong type"),
    (
        "boxes are a file",
        file_instead("annotations/cuboids"),
        r"cuboids: the path has the wrong",
    ),
    (
        "annotations are a file",
        file_instead("annotations"),
        r"annotations: the path has the",
    ),
    ("meta is a file", file_instead("meta"), r"meta: the path has the wrong type"),
    (
        "a camera is a file",
        file_instead("camera/left_camera"),
        r"left_camera: the path has",
    ),
    ("GPS is a folder", folder_instead("meta/gps.json"), r"gps\.json: .*got a folder"),
    ("a link to nowhere", link_to_nowhere, r"gps\.json: the target of the link does not exist"),
    (
        "longitude of 237 degrees",
        change_json("meta/gps.json", with_value((1, "long"), 237.6)),
        r"gps\.json\[1\]: the latitude or longitude of a GPS fix is out of range",
    ),
    ("an id that is None", change_boxes(uuid=["a", None, "b"]), r"cuboids/00.*row 1: .*id"),
    ("an id that is NaN", change_boxes(uuid=["a", float("nan"), "b"]), r"row 1: an actor's id"),
    ("ids that are fractions", change_boxes(uuid=[0.5, 1.5, 2.5]), r"row 0: an actor's id"),
    (
        "an id of bytes",
        change_boxes(uuid=[b"a", "b", "c"]),
        r"row 0: an actor's id",
    ),
    ("an empty id", change_boxes(uuid=["", "b", "c"]), r"row 0: an actor's id"),
    ("an id of two lines", change_boxes(uuid=["a\nb", "b", "c"]), r"row 0: an actor's id"),
    ("an endless id", change_boxes(uuid=["a" * 900, "b", "c"]), r"row 0: an actor's id"),
    ("camera with a space", rename_camera("back camera"), r"camera's name .*'back camera'"),
    ("camera like an option", rename_camera("-rf"), r"camera's name .*'-rf'"),
    ("camera of two lines", rename_camera("a\nb"), r"camera's name .*'a\\nb'"),
    ("camera outside ASCII", rename_camera("arrière"), r"camera's name"),
    ("cameras alike but for case", rename_camera("Front_Camera"), r"'Front_Camera' and 'front_ca"),
]


@pytest.fixture(scope="module")
def good_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_mini_log(tmp_path_factory.mktemp("mini") / "log")


@pytest.fixture
def log(good_log: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(good_log, tmp_path / "log"))


@pytest.mark.parametrize(
    ("break_log", "message"), [c[1:] for c in CASES], ids=[c[0] for c in CASES]
)
def test_what_cannot_be_is_refused(log: Path, break_log: Break, message: str) -> None:
    break_log(log)
    with pytest.raises(InputError, match=message) as caught:
        read_everything(log)
    assert str(log) in str(caught.value)
    assert "\n" not in str(caught.value)


NOTED: list[tuple[str, Break, str]] = [
    (
        "a long lens",
        change_json(INTRINSICS, lambda k: {**k, "fx": 800.0, "fy": 800.0}),
        "front_camera sees 5 degrees",
    ),
    (
        "a crop of the lower half",
        change_json(INTRINSICS, lambda k: {**k, "cy": 35.0}),
        "front_camera: the optical axis at 31.5, 35 px is far from the centre of 64x36 px",
    ),
    (
        "a clock a little late",
        retimed("camera/back_camera", lambda t: t + 0.35),
        "back_camera: times are up to 0.25 s from",
    ),
    (
        "a long tram",
        long_tram,
        "actor parked (Car) 45 m: very long",
    ),
    (
        "an id twice in one sweep",
        change_boxes(uuid=["parked", "parked", "moving-b"], cuboids__sensor_id=[-1, -1, 1]),
        "1 boxes repeat an actor of the same sweep",
    ),
    (
        "an actor that jumps",
        change_boxes(position__y=[66.0, 0.0, 0.0]),
        "actor parked (Car) 539 m/s: very fast: two actors may have one id",
    ),
]


@pytest.mark.parametrize(("change_log", "note"), [c[1:] for c in NOTED], ids=[c[0] for c in NOTED])
def test_what_might_be_is_noted(log: Path, change_log: Break, note: str) -> None:
    change_log(log)
    notes = read_log(LogReading(source=str(log))).notes
    assert any(note in said for said in notes), notes


def test_a_fast_drive_is_noted(tmp_path: Path) -> None:
    log = write_mini_log(tmp_path / "log", speed_m_s=100.0)
    notes = read_log(LogReading(source=str(log))).notes
    assert any("front_camera moves at 100 m/s" in note for note in notes)


def test_odd_ids_and_hidden_folders_are_only_data(log: Path) -> None:
    ids = ["../../../x", "a" * 300, 7]
    for i in range(3):
        table = cuboid_columns(START_S + 0.1 * i)
        del table["cuboids.sibling_id"]
        write_frame(log / f"annotations/cuboids/{i:02d}.pkl.gz", {**table, "uuid": ids})
    (log / "camera/.partial").mkdir()
    read = read_log(LogReading(source=str(log)))
    assert {actor.actor_id for actor in read.actors} == {"../../../x", "a" * 300, "7"}
    assert set(read.cameras) == {"front_camera", "back_camera"}


def test_the_layout_is_told_without_a_walk(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for dataset in ("auto", "pandaset"):
        assert check_layout(LogReading(source=str(log), dataset=dataset)) == "pandaset"

    def walk(*_: Any) -> None:
        raise AssertionError("the folder was walked")

    monkeypatch.setattr(Path, "rglob", walk)
    for source in (Path("/"), tmp_path):
        for dataset in ("auto", *OWN_DATASETS):
            with pytest.raises(InputError, match="layout of a supported data set"):
                check_layout(LogReading(source=str(source), dataset=dataset))
    for source in (tmp_path / "none", log / SWEEP, log / SWEEP / "x"):
        with pytest.raises(InputError):
            check_layout(LogReading(source=str(source)))


def test_what_one_may_not_look_at_is_said(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def refuse(*_: Any, **__: Any) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "stat", refuse)
    with pytest.raises(InputError, match="is not accessible"):
        has_file(tmp_path / "x")
