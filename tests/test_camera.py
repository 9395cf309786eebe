"""The camera: distortion against OpenCV, its inverse and derivatives, folds, the half pixels of resampling."""

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes

from jcr.camera import (
    NORMALIZED,
    by_parameters,
    by_point,
    cropped,
    fold_distance_px,
    parameters,
    pinhole_inside,
    project,
    rays,
    resized,
    undistortion,
    unproject,
    with_parameters,
    without_distortion,
    zoomed,
)
from jcr.records import Intrinsics, IntrinsicsAndStd

WIDE = Intrinsics(634.6, 634.1, 641.95, 358.99, 1280, 720, (-0.0606, 0.0727, -0.00025, 0.00053, -0.0236))
BARREL = Intrinsics(300.0, 310.0, 322.0, 236.0, 640, 480, (-0.22, 0.04, 0.001, -0.002, -0.002))
PINCUSHION = Intrinsics(500.0, 500.0, 310.0, 245.0, 640, 480, (0.15, 0.05, -0.001, 0.001, 0.01))

RATIONAL = Intrinsics(
    612.4, 612.2, 636.8, 367.2, 1280, 720, (0.45, -2.6, 4e-4, -2e-4, 1.6, 0.33, -2.4, 1.5), "rational"
)
"""About an Azure Kinect's colour camera."""
PRISM = replace(RATIONAL, distortion=(*RATIONAL.distortion, 0.02, -0.004, -0.01, 0.003), model="thin_prism")
"""The same camera with a tilted sensor."""
FISHEYE = Intrinsics(286.0, 286.5, 423.0, 399.0, 848, 800, (-0.0078, 0.045, -0.042, 0.008), "fisheye")
"""About a tracking camera's: its corners see 80° off the axis."""
MODELS = [WIDE, BARREL, PINCUSHION, RATIONAL, PRISM, FISHEYE]

repeatable = settings(derandomize=True, deadline=None, max_examples=40)


def between(low: float, high: float):
    """Numbers of a camera."""
    return st.floats(low, high, allow_subnormal=False)


@st.composite
def cameras(draw) -> tuple[Any, ...]:
    """Arguments of cameras whose distortion, if any, is too weak to fold over at the radii (up to 0.9) in the images."""
    width, height = draw(st.integers(64, 2000)), draw(st.integers(48, 1500))
    focal = draw(between(0.8, 2.0)) * max(width, height)
    cx, cy = ((side - 1) / 2 + draw(between(-0.05, 0.05)) * side for side in (width, height))
    k1, k2, k3 = draw(between(-0.1, 0.3)), draw(between(0, 0.1)), draw(between(0, 0.02))
    p1, p2 = draw(between(-2e-3, 2e-3)), draw(between(-2e-3, 2e-3))
    distortion = draw(st.sampled_from([(0.0,) * 5, (k1, k2, p1, p2, k3)]))
    return focal, focal * draw(between(0.9, 1.1)), cx, cy, width, height, distortion


def pixels(draw, camera: Intrinsics) -> np.ndarray:
    """A batch of pixels of any shape, anywhere in the image."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    shape = draw(array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4))
    return rng.uniform([-0.5, -0.5], [camera.width - 0.5, camera.height - 0.5], (*shape, 2))


@repeatable
@given(st.data(), cameras(), st.integers(1, 3000), st.integers(1, 3000), between(0.1, 5))
def test_unprojected_resized_cropped_and_zoomed_pixels_are_the_same_point(
    data, arguments, width, height, factor
):
    camera = Intrinsics(*arguments)
    first_px = pixels(data.draw, camera)
    x = unproject(camera, first_px)
    x_px = project(camera, factor * x)
    assert x.shape == (*x_px.shape[:-1], 3) and (x[..., 2] == 1).all()
    np.testing.assert_allclose(x_px, first_px, rtol=0, atol=1e-7)
    ratio = np.array([width, height]) / [camera.width, camera.height]
    small = resized(camera, width, height)
    np.testing.assert_allclose(project(small, x), (x_px + 0.5) * ratio - 0.5, rtol=0, atol=1e-7 * width)
    np.testing.assert_allclose(
        parameters(resized(small, camera.width, camera.height)), parameters(camera), rtol=1e-12, atol=1e-9
    )
    left, top = width - 1500, height - 1500
    cut = cropped(camera, left, top, 320, 240)
    np.testing.assert_allclose(project(cut, x), x_px - [left, top], rtol=0, atol=1e-8)
    assert (cut.width, cut.height) == (320, 240)
    centre = [camera.cx, camera.cy]
    np.testing.assert_allclose(
        project(zoomed(camera, factor), x) - centre, factor * (x_px - centre), atol=1e-7
    )


def test_float32_stays_float32():
    x = np.array([[0.1, 0.2, 1.0]], np.float32)
    assert project(WIDE, x).dtype == by_point(WIDE, x).dtype == by_parameters(WIDE, x).dtype == np.float32
    np.testing.assert_allclose(project(NORMALIZED, x), x[:, :2])


def test_fold_is_found_where_the_radius_stops_growing() -> None:
    # r(1 - k r²) is largest at r = 1/√(3k), where it is two thirds of that.
    intrinsics = Intrinsics(400.0, 400.0, 639.5, 359.5, 1280, 720, (-0.4, 0.0, 0.0, 0.0, 0.0))
    fold = fold_distance_px(intrinsics)
    assert fold == pytest.approx(400 * 2 / 3 / np.sqrt(1.2), rel=1e-3)
    # The same fold is harmless when it lies outside the frame: a crop of the same camera.
    assert fold_distance_px(replace(intrinsics, width=300, height=200, cx=149.5, cy=99.5)) is None
    # Corners at 87° are beyond the 84° to which rays are followed.
    assert fold_distance_px(Intrinsics(20.0, 20.0, 319.5, 239.5, 640, 480)) is not None


@pytest.mark.parametrize("intrinsics", [WIDE, BARREL, PINCUSHION])
def test_pinhole_grid_stays_inside_the_frame_and_touches_it(intrinsics: Intrinsics) -> None:
    pinhole = pinhole_inside(intrinsics, 320)
    assert max(pinhole.width, pinhole.height) == 320
    edges = [-0.5, pinhole.width - 0.5], [-0.5, pinhole.height - 0.5]
    u, v = np.meshgrid(np.linspace(*edges[0], 50), np.linspace(*edges[1], 50))
    x_px = project(intrinsics, unproject(pinhole, np.stack([u, v], axis=-1)))
    inside = np.minimum(x_px + 0.5, [intrinsics.width - 0.5, intrinsics.height - 0.5] - x_px)
    assert -0.01 < inside.min() < 0.5
    straight = replace(intrinsics, distortion=(0.0,) * 5)
    grid = pinhole_inside(straight, 320)
    small = resized(straight, grid.width, grid.height)
    assert parameters(grid) == pytest.approx(parameters(small))


@pytest.mark.parametrize("factor", [1, 3])
def test_resampled_pixels_show_what_their_rays_see(factor: int) -> None:
    intrinsics = Intrinsics(220.0, 220.0, 120.0, 90.0, 252, 192, (-0.1, 0.02, 0.001, 0.001, 0.0))
    u, v = np.meshgrid(np.arange(252), np.arange(192))
    image = np.stack([u, v, 255 - u], axis=-1).astype(np.uint8)  # every pixel says where it is
    pinhole = pinhole_inside(intrinsics, 252 // factor)
    seen = undistortion(intrinsics, pinhole)(image).astype(float)
    expected = project(intrinsics, rays(pinhole))
    difference = (seen[..., :2] - expected)[2:-2, 2:-2]
    assert np.abs(difference.mean((0, 1))).max() < 0.05
    assert np.abs(difference).max() < 0.6


@pytest.mark.parametrize("camera", MODELS)
def test_each_model_is_opencvs_and_has_its_inverse_and_derivatives(camera: Intrinsics):
    u, v = np.meshgrid(np.linspace(5, camera.width - 6, 15), np.linspace(5, camera.height - 6, 11))
    x = 0.8 * unproject(camera, np.stack([u, v], -1))
    project_by = cv2.fisheye.projectPoints if camera.model == "fisheye" else cv2.projectPoints
    flat, origin = x.reshape(-1, 1, 3), np.zeros(3)
    expected = project_by(flat, origin, origin, camera.matrix, np.array(camera.distortion))[0]
    np.testing.assert_allclose(project(camera, flat[:, 0]), expected[:, 0], atol=1e-6)
    np.testing.assert_allclose(0.8 * unproject(camera, project(camera, x)), x, atol=1e-8)

    def slope(function, step: np.ndarray) -> np.ndarray:
        return (function(1e-6 * step) - function(-1e-6 * step)) / 2e-6

    for k, axis in enumerate(np.eye(3)):
        numeric = slope(lambda step: project(camera, x + step), axis)
        np.testing.assert_allclose(by_point(camera, x)[..., k], numeric, rtol=1e-5, atol=1e-4)
    values = parameters(camera)
    assert with_parameters(camera, values) == camera
    for k, axis in enumerate(np.eye(len(values))):
        numeric = slope(lambda step: project(with_parameters(camera, values + step), x), axis)
        np.testing.assert_allclose(by_parameters(camera, x)[..., k], numeric, rtol=1e-4, atol=1e-4)


def test_a_fisheye_is_smooth_on_its_axis_and_its_pinhole_grid_ends_before_its_border():
    axis = np.array([[0.0, 0.0, 1.0], [1e-7, 0.0, 1.0], [1e-3, 2e-3, 1.0]])
    assert np.isfinite(by_point(FISHEYE, axis)).all()
    np.testing.assert_allclose(project(FISHEYE, axis)[0], [FISHEYE.cx, FISHEYE.cy])
    np.testing.assert_allclose(unproject(FISHEYE, project(FISHEYE, axis)), axis, atol=1e-9)
    grid = pinhole_inside(FISHEYE, 512)
    assert grid.model == "pinhole" and np.abs(rays(grid)).max() < 1.8
    seen = project(FISHEYE, rays(grid))
    assert (seen > -0.5).all() and (seen < [FISHEYE.width - 0.5, FISHEYE.height - 0.5]).all()


def test_intrinsics_with_std_lose_distortion_and_std_together():
    """A camera with twelve coefficients and their standard deviations has a pinhole without these."""
    found = IntrinsicsAndStd(600.0, 601.0, 320.0, 240.0, 640, 480, (0.1,) * 12, "thin_prism", (1.0,) * 16)
    assert without_distortion(found) == Intrinsics(600.0, 601.0, 320.0, 240.0, 640, 480)
