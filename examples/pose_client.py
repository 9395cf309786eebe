"""Send gripper poses to `jcr capture OUT --camera 0 --poses http`.

    python examples/pose_client.py http://127.0.0.1:40123 KEY

Address and key are printed by `jcr capture`. Put the calls of your robot into `robot_poses`.
"""

import json
import sys
import urllib.error
import urllib.request


def robot_poses():
    """Move the arm, let it rest, and yield base_from_gripper there: 4 rows of 4 numbers, metres."""
    for x in (0.40, 0.45, 0.50):
        yield [[1, 0, 0, x], [0, -1, 0, 0.0], [0, 0, -1, 0.5], [0, 0, 0, 1]]


def sample(address, key, content):
    """Post one sample and return the answer, which comes when its image is calibrated."""
    headers = {"Authorization": f"Bearer {key}", "Content-Type": "application/json"}
    request = urllib.request.Request(f"{address}/sample", json.dumps(content).encode(), headers)
    try:
        with urllib.request.urlopen(request, timeout=600) as answer:
            return json.load(answer)
    except urllib.error.HTTPError as refused:
        answer = json.load(refused)
        if refused.code != 422:  # 422: this image is not kept; the capture goes on
            sys.exit(f"{refused.code}: {answer['reason']}")
        return answer


address, key = sys.argv[1:]
for pose in robot_poses():
    answer = sample(address, key, {"base_from_gripper": pose})
    print(answer.get("image") or answer["reason"], "95 %, mm:", answer.get("translation_95_mm"))
    if answer["done"]:
        break
else:
    sample(address, key, {"done": True})
