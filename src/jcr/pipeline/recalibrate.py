"""Verification without the calibrated scene, and calibration again after a verification."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from jcr.capture.folder import require_decided
from jcr.capture.formats import capture_json
from jcr.errors import InputError, RejectedError
from jcr.files import IMAGES, as_path, path_inside, write_bytes
from jcr.geometry import step_between
from jcr.pipeline.options import TOLERANCE
from jcr.pipeline.run import calibrate
from jcr.pipeline.stages import write_state
from jcr.pipeline.verify import Move, Verification, of_two_poses
from jcr.progress import Progress, silent
from jcr.records import Capture
from jcr.result import RunResult


def verify_by_new_scene(
    out: str | Path,
    name: str,
    new: Capture,
    tolerance: tuple[float, float] = TOLERANCE,
    progress: Progress = silent,
) -> Verification:
    """Test with images of another scene whether the camera of the run folder `out` has moved since its calibration.

    The capture `new`, called `name`, is calibrated by itself with the options of the run, and its hand-eye transform is
    compared with that of the run; changes smaller than `tolerance` (mm, degrees) raise no alarm. Raises RejectedError if
    the new images give no calibration that is sound.
    """
    run = RunResult(out)
    before = run.found
    with TemporaryDirectory(prefix="jcr-verify-") as scratch:
        now = calibrate(require_decided(new), scratch, run.state.options, progress=progress).found
    if not now.converged:
        raise RejectedError(f"cannot tell: the calibration of {name} is rejected: {now.doubt}")
    offset = step_between(before.gripper_from_camera, now.gripper_from_camera)
    covariance = (before.covariance + now.covariance)[:6, :6]
    used = [image.image for image in now.images if image.used]
    found = of_two_poses(offset, covariance, tolerance, used, ())
    moves = (Move(("camera",), 0, name, offset),) if found.moved else ()
    return replace(found, name=name, moves=moves)


def recalibrate(
    out: str | Path,
    captures: Mapping[str, Capture],
    into: str | Path,
    found: Verification,
    progress: Progress = silent,
) -> RunResult:
    """Calibrate again after the verification `found` of the run folder `out`, into the new run folder `into`.

    If nothing has moved, the images of the run and of `captures` are calibrated together; otherwise those of the
    captures since the last change. The new run has the options of the run, the next version, and the run as predecessor.
    """
    run, into = RunResult(out), as_path(into, "into")
    if (into / "run.json").exists():
        raise InputError(f"{into}: holds a run already; name a new folder")
    if found.moves:
        since = max(move.first for move in found.moves)
        names = [row.name for row in found.history[since:]]
        parts = [one for name, one in captures.items() if name in names]
    else:
        parts = [run.capture, *captures.values()]
    merged = _merged(parts, run.capture, into / "capture")
    result = calibrate(merged, into, run.state.options, progress=progress)
    own = {"version": run.state.version + 1, "predecessor": str(run.out.resolve())}
    result = result.with_parts(state=result.state.model_copy(update=own))
    write_state(result)
    return result


def _merged(parts: Sequence[Capture], first: Capture, folder: Path) -> Capture:
    """Write the images and poses of several captures into a new capture folder; return its capture.

    Intrinsics and robot are those of the capture `first`. Joint angles are kept if all parts have them.
    """
    if not parts:
        raise InputError(f"{folder}: no images since the change; name captures taken after it")
    images = list[str]()
    for part in map(require_decided, parts):
        for image in part.images:
            images.append(f"{IMAGES}/{len(images):03d}{Path(image).suffix.lower()}")
            write_bytes(path_inside(folder, images[-1], str(folder)), (part.folder / image).read_bytes())
    joints = [part.joints for part in parts if part.joints is not None]
    merged = replace(
        first,
        folder=folder,
        source=None,
        images=tuple(images),
        base_from_gripper=np.concatenate([part.base_from_gripper for part in parts]),
        joints=np.concatenate(joints) if len(joints) == len(parts) else None,
        depths=None,
        others=(),
        reading=None,
        untaken=(),
        notes=(),
    )
    capture_json.write(folder, merged)
    return capture_json.read(folder)
