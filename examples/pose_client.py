"""Send gripper poses to `jcr capture OUT --camera 0 --poses tcp`; put your robot's own calls in the two functions."""

import json
import socket
import sys


def robot_poses():
    """Move the arm somewhere, let it rest, and give base_from_gripper there: 4 rows of 4, metres."""
    for x in (0.40, 0.45, 0.50):
        yield [[1, 0, 0, x], [0, -1, 0, 0.0], [0, 0, -1, 0.5], [0, 0, 0, 1]]


port = int(sys.argv[1]) if len(sys.argv) > 1 else 7464
with socket.create_connection(("127.0.0.1", port), timeout=60) as server, server.makefile("rw") as lines:
    for pose in robot_poses():
        print(json.dumps({"base_from_gripper": pose}), file=lines, flush=True)
        answer = json.loads(lines.readline())
        print(answer.get("image") or answer["reason"], "next:", answer.get("next_base_from_gripper"))
        if answer.get("done"):
            break
    else:
        print(json.dumps({"done": True}), file=lines, flush=True)
