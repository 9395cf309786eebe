"""Take a capture live from a Universal Robots arm: an image whenever it has come to rest in a new place.

    python examples/04_ur_robot.py [ROBOT_ADDRESS [CAMERA]]

Drive the arm by its program or by hand; nothing is sent to it, its poses are read from port 30003. CAMERA is a
V4L2 number or a stream (default 0). Without an address an arm and a camera over the bundled table are simulated.
The command line does the same: `jcr capture captures/table --camera 0 --poses ur:ADDRESS`.
"""

import shutil
import sys
import time
from contextlib import ExitStack, closing
from pathlib import Path

import jcr
from jcr.capture.images import read_image
from jcr.live.arm_words import ArmWords
from jcr.live.camera import Camera, Frame, Recorded
from jcr.live.collect import CollectOptions, LiveCapture
from jcr.live.devices import opened
from jcr.live.folder import LiveFolder
from jcr.live.rest import asks_at_rest
from jcr.live.ur import states

sys.path.append(str(Path(__file__).resolve().parents[1]))  # of the checkout, for what is simulated
from simulation.ur import SimulatedUr


def simulated_camera(table, arm):
    """What a camera on the simulated arm's wrist sees at 20 images a second."""
    while True:
        yield Frame(read_image(table.folder / table.images[arm.stop]), time.monotonic())
        time.sleep(0.05)


with ExitStack() as until_done:
    if len(sys.argv) > 1:
        out, host, port, images = Path("captures/ur"), sys.argv[1], 30003, 12
        camera = until_done.enter_context(opened(sys.argv[2] if len(sys.argv) > 2 else "0"))
    else:
        table = jcr.read_capture("examples/tabletop")
        arm = until_done.enter_context(SimulatedUr(table.base_from_gripper))
        out, host, port, images = Path("out/ur_robot"), "127.0.0.1", arm.port, 5
        seen = Recorded(simulated_camera(table, arm))
        camera = Camera(seen, seen.latest)
        shutil.rmtree(out, ignore_errors=True)  # a real one is resumed

    def tell(answer, lines):
        """Which image was kept or why not, how exact the calibration is now, and the pose to add next."""
        print("\n".join(lines))

    print("move the arm; an image is taken whenever it rests")
    asks = asks_at_rest(lambda: states(host, port))
    calibration = until_done.enter_context(closing(jcr.LiveCalibration(LiveFolder(out))))
    LiveCapture(calibration, camera, CollectOptions(images=images), tell, ArmWords("ur")).run(asks)

capture = jcr.read_capture(out)
print(f"{len(capture)} images in {out}; next: jcr run {out} out/ur_run")
