"""Views from recorded pictures against the closed form of a painted wall with a post before it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from lightsim.core.camera import PinholeCamera
from lightsim.core.colour import srgb8_from_linear
from lightsim.core.frames import RigidTransform
from lightsim.core.sensors import CameraFrame
from lightsim.render.image_based import (
    BlendedView,
    RecordedView,
    ViewRays,
    blended,
    recorded_view,
)

CAMERA = PinholeCamera("front", 96, 64, 80.0, 80.0, 48.0, 32.0)
WALL_M, POST_M, POST_HALF_M, TOP_M = 10.0, 5.0, 0.3, 3.0
GAIN = np.array([1.2, 1.0, 0.8], dtype=np.float32)
POST = np.array([0.6, 0.05, 0.05])
# Camera axes (right, down, ahead) in frame world, which looks along x.
AXES = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def frame_at(y_m: float, stem: str = "00", time_ns: int = 0) -> CameraFrame:
    pose = RigidTransform.from_rotation("world", "camera", AXES, np.array([0.0, y_m, 0.0]))
    return CameraFrame("front", stem, time_ns, pose, lambda: srgb8_from_linear(seen(y_m)[1] * GAIN))


def paint(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    y, z = points[:, 1], points[:, 2]
    return np.column_stack([0.4 + 0.03 * y, 0.4 - 0.02 * y + 0.03 * z, 0.3 + 0.02 * z])


def seen(
    y_m: float, *, has_post: bool = True
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w 3"]]:
    """Distance and radiance from a place on the y axis; above the wall is sky."""
    uv = CAMERA.pixel_centres().reshape(-1, 2)
    d = CAMERA.directions(uv) @ AXES.T
    start = np.array([0.0, y_m, 0.0])
    wall, post = (start + x / d[:, :1] * d for x in (WALL_M, POST_M))
    is_post = (np.abs(post[:, 1]) < POST_HALF_M) & has_post
    is_sky = (wall[:, 2] > TOP_M) & ~is_post
    points = np.where(is_post[:, None], post, wall)
    distance = np.where(is_sky, np.inf, np.linalg.norm(points - start, axis=1))
    radiance = np.where(is_post[:, None], POST, paint(wall))
    radiance[is_sky] = 0.7
    shape = CAMERA.height_px, CAMERA.width_px
    return distance.reshape(shape), radiance.reshape(*shape, 3)


def picture(y_m: float, time_ns: int = 0) -> RecordedView:
    distance = seen(y_m)[0].astype(np.float32)
    matte = np.isinf(distance).astype(np.float32)
    usable = np.ones(distance.shape, dtype=bool)
    frame = frame_at(y_m, time_ns=time_ns)
    return recorded_view(frame, frame.load_srgb8(), CAMERA, GAIN, matte, distance, usable)


def view(y_m: float, pictures: list[RecordedView]) -> BlendedView:
    distance = seen(y_m)[0]
    origins, directions = frame_at(y_m).pixel_rays(CAMERA, CAMERA.pixel_centres().reshape(-1, 2))
    rays = ViewRays("front", 0, CAMERA.fx, origins, directions, distance.reshape(-1))
    return blended(rays, ((p, rays.points_world) for p in pictures))


def away_from_edges(y_m: float, *others: float) -> Bool[np.ndarray, " n"]:
    """Pixels two or more from any outline, in the view and where other places see the same."""
    from scipy.ndimage import maximum_filter, minimum_filter

    distance = seen(y_m)[0]
    kind = np.digitize(np.nan_to_num(distance, posinf=1e3), [7.0, 500.0])
    is_away = np.asarray(maximum_filter(kind, 5) == minimum_filter(kind, 5))
    result = is_away.reshape(-1)
    origins, directions = frame_at(y_m).pixel_rays(CAMERA, CAMERA.pixel_centres().reshape(-1, 2))
    points = origins + np.minimum(distance.reshape(-1, 1), 1e5) * directions
    for other in others:
        uv, is_inside = frame_at(other).project(CAMERA, points)
        columns, rows = np.where(is_inside[:, None], uv, 0.0).astype(int).T
        is_far_from_edges = away_from_edges(other).reshape(kind.shape)[rows, columns]
        result = result & (is_far_from_edges | ~is_inside)
    return result


def test_a_place_between_two_cameras_shows_what_would_be_seen_there() -> None:
    found = view(0.0, [picture(-1.0), picture(1.0)])
    truth = seen(0.0)[1].reshape(-1, 3)
    at = away_from_edges(0.0, -1.0, 1.0)
    assert found.is_observed[at].all()
    # 8 bits of the pictures.
    assert np.abs(found.radiance - truth)[at].max() < 0.006
    is_sky = np.isinf(seen(0.0)[0]).reshape(-1)
    np.testing.assert_allclose(found.sky_matte[at], is_sky[at], atol=1 / 255)


def test_what_hides_a_wall_in_a_picture_is_not_painted_on_it() -> None:
    """The one picture has the post before the wall that the view sees beside it."""
    found = view(1.5, [picture(-1.0)])
    truth = seen(1.5)[1].reshape(-1, 3)
    at = away_from_edges(1.5, -1.0)
    assert np.abs(found.radiance - truth)[at & found.is_observed].max() < 0.006
    hidden = (~found.is_observed & at).reshape(CAMERA.height_px, CAMERA.width_px)
    assert hidden[40].sum() >= 3
    with_both = view(1.5, [picture(-1.0), picture(2.5)])
    assert (with_both.is_observed | ~at).sum() > (found.is_observed | ~at).sum()


def test_the_picture_of_the_same_place_and_moment_wins() -> None:
    own, other = picture(0.5), picture(0.0, time_ns=500_000_000)
    found = view(0.5, [other, own])
    codes = srgb8_from_linear(found.radiance * GAIN).reshape(own.srgb8.shape)
    assert found.is_observed.all()
    at = away_from_edges(0.5).reshape(own.near_m.shape)
    assert np.abs(codes.astype(int) - own.srgb8)[at].max() <= 1


def test_a_wire_without_a_surface_is_shown_once() -> None:
    """Each picture has one before its sky; the next is a tenth of a second away."""
    sky = np.isinf(seen(0.0)[0])
    pictures = []
    for column, tenths in ((30, 0), (60, 1), (70, -1)):
        plain = picture(0.0, time_ns=tenths * 100_000_000)
        codes = plain.srgb8.copy()
        codes[:, column][sky[:, column]] = 0
        pictures.append(replace(plain, srgb8=codes))
    radiance = view(0.0, pictures).radiance.reshape(*sky.shape, 3)
    row = radiance[3, :, 1] / 0.7
    assert sky[3, [30, 60, 70]].all()
    assert row[30] < 0.1
    assert row[[60, 70]].min() > 0.9


def test_ego_vehicles_are_not_looked_at() -> None:
    distance = seen(0.0)[0].astype(np.float32)
    nowhere = np.zeros(distance.shape, dtype=bool)
    matte = np.zeros(distance.shape, dtype=np.float32)
    frame = frame_at(0.0)
    blind = recorded_view(frame, frame.load_srgb8(), CAMERA, GAIN, matte, distance, nowhere)
    assert not view(0.0, [blind]).is_observed.any()
