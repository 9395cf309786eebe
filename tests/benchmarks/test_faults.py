"""Images with one fault: what is drawn is what its name says, and a row counts what it claims."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.faults import Case, Outcome, page
from jcr.camera import project
from jcr.findings import FindingKind
from jcr.geometry import inverse, step_between
from jcr.records import Intrinsics
from simulation import image_faults as make
from simulation import scene_faults as scenes
from simulation.faults import Faults, optics_of
from simulation.image_faults import FOCAL_PX, IMAGES, POSES, SIZE, WIDE, ImageFault, Rendered, draw
from simulation.poses import gripper_poses, random_hand_eye
from simulation.scenes import make_scene


def scene() -> Rendered:
    """Images whose red grows along x and green along y, by a level every 4 px; poses without errors."""
    rng = np.random.default_rng(0)
    x = random_hand_eye(rng)
    column, row = np.meshgrid(np.arange(WIDE[0]), np.arange(WIDE[1]))
    wide = np.stack([column / 4, row / 4, 0 * row], axis=-1).astype(np.uint8)
    camera = Intrinsics(FOCAL_PX[0], FOCAL_PX[0], (SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2, *SIZE)
    poses = gripper_poses("varied", POSES, np.array([0.5, 0.0, 0.0]), x, rng)
    distance = np.linalg.norm((poses @ x)[:, :3, 3] - [0.5, 0.0, 0.0], axis=1)
    return Rendered(
        images=(wide,) * POSES,
        scene=make_scene("tabletop", 0),
        base_from_camera=poses @ x,
        camera=camera,
        base_from_gripper=poses,
        distance=distance,
        gripper_from_camera=x,
        white=(0.0, 0.0),
    )


OPTICAL = {
    "none": Faults(),
    "zoom": Faults(zoom=0.25),
    "grows": Faults(focal_by_distance=0.1),
    "principal point": Faults(intrinsics=(("cx", 40.0), ("cy", -10.0))),
    "barrel": Faults(intrinsics=(("k1", -0.1),)),
    "shutter": Faults(rolling_px=24.0),
    "prism": Faults(prism=(0.04, 0.0, 0.02, 0.0)),
    "springs": Faults(centre_sags_px=12.0),
    "stabiliser": Faults(centre_scatter_px=3.0),
}


@pytest.mark.parametrize("name", OPTICAL)
def test_images_show_a_point_where_observations_of_the_same_fault_have_it(name: str):
    """The warp of an image and the projection of points are two forms of one camera."""
    one, ray = scene(), np.random.default_rng(1).uniform(-0.3, 0.3, (200, 2))
    x_in_camera = np.column_stack([ray, np.ones(200)])
    poses = one.base_from_gripper @ one.gripper_from_camera
    optics = optics_of(OPTICAL[name], one.camera, poses, one.distance, np.random.default_rng(2))
    believed, moved = project(one.camera, x_in_camera), 0.0
    for camera in (optics[0], optics[-1]):
        x_px = camera.taken(x_in_camera)
        moved = max(moved, float(np.abs(x_px - believed).max()))
        # The prism is inverted to first order, which leaves its square.
        np.testing.assert_allclose(
            camera.believed_from_px(x_px), believed, atol=0.3 if name == "prism" else 1e-6
        )
    assert (moved > 2.0) == (name != "none")


def test_poses_are_those_of_a_gripper_whose_camera_took_the_same_images():
    one, clean = scene(), draw(scene(), 1, ImageFault())
    assert np.array_equal(make.taken(one.images[0], lambda px: px), one.images[0][120:600, 160:800])
    cameras, half = clean.base_from_gripper @ clean.gripper_from_camera[0], IMAGES // 2
    slipped = draw(one, 1, ImageFault(faults=Faults(slip=(3e-3, np.radians(1.0)))))
    before, after = slipped.gripper_from_camera
    assert np.allclose(
        np.linalg.norm(step_between(before, after).reshape(2, 3), axis=1), [3e-3, np.radians(1)]
    )
    mounted = np.where((np.arange(IMAGES) < half)[:, None, None], before, after)
    assert np.allclose(slipped.base_from_gripper @ mounted, cameras)
    pushed_base = draw(one, 1, ImageFault(faults=Faults(base_moved=(5e-3, 0.02)))).base_from_gripper
    bumped = pushed_base @ inverse(clean.base_from_gripper)
    assert np.allclose(bumped[:half], np.eye(4)) and np.allclose(bumped[half:], bumped[-1])
    assert not np.allclose(bumped[-1], np.eye(4), atol=1e-3)
    # Images in the order of their names as text: the poses stay, and are of other ones.
    text = draw(one, 1, ImageFault(change=make.sorted_as_text))
    assert list(text.names) == sorted(clean.names) != list(clean.names)
    assert np.array_equal(text.base_from_gripper, clean.base_from_gripper)


@pytest.mark.gl
def test_objects_are_pushed_midway():
    same, pushed = (
        scene().changed(np.arange(6), change) for change in (lambda scene, row, pose: scene, scenes.pushed)
    )
    change = [np.abs(a.astype(int) - b).mean() for a, b in zip(pushed, same, strict=True)]
    assert max(change[: scenes.MIDWAY]) == 0.0 and min(change[scenes.MIDWAY :]) > 0.5


def test_a_row_counts_silent_errors_apart_from_warned_and_stated_ones():
    within = Outcome(True, mm=1.0, deg=0.1, sigmas=2.0, joint_p=0.5)
    silent = replace(within, sigmas=8.0, joint_p=1e-9)
    jointly = replace(within, joint_p=1e-4)
    warned = replace(silent, kinds=frozenset({FindingKind.ZOOM}))
    rejected = replace(warned, accepted=False)
    case = Case("a zoom", ImageFault(faults=Faults(zoom=0.1)), frozenset({FindingKind.ZOOM}))
    text = page({}, {case: [within, silent, jointly, warned, rejected]}, [], [within, warned])
    assert "| a zoom | 5 | 2 | focal length changed once 2 | 1 | 1 | 1 | **2** |" in text
    assert (
        "2 silently wrong; silent anywhere: a zoom. Of 2 captures without a fault 1 are called faulty" in text
    )
    # A wrong image that is left out is as good as named.
    alone = Case("one pose", ImageFault(wrong=(3,)))
    assert replace(within, left_out=frozenset({3})).is_named(alone) and not within.is_named(alone)
