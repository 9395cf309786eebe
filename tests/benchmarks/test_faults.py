"""Images with one fault: what is drawn is what its name says, and a row counts what it claims."""

from dataclasses import replace

import numpy as np

from benchmarks.faults import Case, Outcome, page
from jcr.findings import FindingKind
from jcr.geometry import inverse, step_between
from jcr.records import Intrinsics
from simulation import image_faults as make
from simulation.image_faults import IMAGES, Fault, draw
from simulation.poses import gripper_poses, random_hand_eye
from simulation.rendered import FOCAL_PX, POSES, SIZE, WIDE, Rendered


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
        images_pushed=(255 - wide,) * POSES,
        camera=camera,
        base_from_gripper=poses,
        distance=distance,
        gripper_from_camera=x,
        white=(0.0, 0.0),
    )


def test_a_camera_sees_its_part_of_the_wide_image_and_a_fault_of_it_another():
    one = scene()
    assert np.array_equal(one.seen(0, lambda px: px), one.images[0][120:600, 160:800])
    view = make.View(number=0, count=IMAGES, camera=one.camera, far=0.5, random=np.zeros(2))

    def red_at_edge(optics: make.Optics) -> float:
        """Column of the wide image that is seen at the right edge of the middle row."""
        return 4.0 * float(one.seen(0, lambda px: optics(view, px))[240, -1, 0])

    half, focal = SIZE[0] / 2, one.camera.fx
    for optics, column in (
        (make.zoomed(1.25), half / 1.25),
        (make.breathing(0.5), half / 1.25),
        (make.zoomed_midway(0.25), half),
        (make.off_centre(40.0, 0.0), half - 40.0),
        (make.rolling(40.0), half),
        # Barrel distortion shows more: an undistorted radius r is seen at r (1 - 0.1 r²).
        (make.distorted(-0.1), focal * np.roots([-0.1, 0.0, 1.0, -half / focal])[-1].real),
        (make.thin_prism(0.1), half + focal * 0.1 * (half / focal) ** 2),
    ):
        assert abs(red_at_edge(optics) - (480.0 + column)) < 8.0, column
    assert red_at_edge(make.mirrored) < 170.0


def test_poses_are_those_of_a_gripper_whose_camera_took_the_same_images():
    clean = draw(scene(), 1, Fault())
    cameras = clean.base_from_gripper @ clean.gripper_from_camera[0]
    slipped = draw(scene(), 1, Fault(change=make.slipped(3.0, 1.0)))
    before, after = slipped.gripper_from_camera
    assert np.allclose(
        np.linalg.norm(step_between(before, after).reshape(2, 3), axis=1), [3e-3, np.radians(1)]
    )
    mounted = np.where((np.arange(IMAGES) < IMAGES // 2)[:, None, None], before, after)
    assert np.allclose(slipped.base_from_gripper @ mounted, cameras)
    bumped = draw(scene(), 1, Fault(change=make.bumped(5.0, 1.0))).base_from_gripper @ inverse(
        clean.base_from_gripper
    )
    assert np.allclose(bumped[: IMAGES // 2], np.eye(4)) and np.allclose(bumped[IMAGES // 2 :], bumped[-1])
    assert not np.allclose(bumped[-1], np.eye(4), atol=1e-3)
    # Images in the order of their names as text: the poses stay, and are of other ones.
    text = draw(scene(), 1, Fault(change=make.sorted_as_text))
    assert list(text.names) == sorted(clean.names) != list(clean.names)
    assert np.array_equal(text.base_from_gripper, clean.base_from_gripper)
    # Objects are pushed midway.
    pushed = draw(scene(), 1, Fault(pushed=True))
    change = [
        np.abs(one.astype(int) - other).mean() for one, other in zip(pushed.images, clean.images, strict=True)
    ]
    assert max(change[: IMAGES // 2]) == 0.0 and min(change[IMAGES // 2 :]) > 20.0


def test_a_row_counts_silent_errors_apart_from_warned_and_stated_ones():
    within = Outcome(True, mm=1.0, deg=0.1, sigmas=2.0, joint_p=0.5)
    silent = replace(within, sigmas=8.0, joint_p=1e-9)
    jointly = replace(within, joint_p=1e-4)
    warned = replace(silent, kinds=frozenset({FindingKind.ZOOM}))
    rejected = replace(warned, accepted=False)
    case = Case("a zoom", Fault(make.zoomed(1.1)), frozenset({FindingKind.ZOOM}))
    text = page({}, {case: [within, silent, jointly, warned, rejected]}, [], [within, warned])
    assert "| a zoom | 5 | 2 | focal length changed once 2 | 1 | 1 | 1 | **2** |" in text
    assert (
        "2 silently wrong; silent anywhere: a zoom. Of 2 captures without a fault 1 are called faulty" in text
    )
    # A wrong image that is left out is as good as named.
    alone = Case("one pose", Fault(wrong=(3,)))
    assert replace(within, left_out=frozenset({3})).is_named(alone) and not within.is_named(alone)
