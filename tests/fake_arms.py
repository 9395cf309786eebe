"""Controllers that speak the protocols of the makers' own packages, as far as reading poses needs."""

import json
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import numpy as np
from numpy import ndarray

from jcr.geometry import rotation_log


@contextmanager
def fake(name: str, host: str, pose: ndarray, joints: ndarray) -> Iterator[None]:
    """A controller in a process of its own: the makers' packages hold Python's lock while they wait for it."""
    numbers = [*pose.ravel().tolist(), *joints.tolist()]
    command = [sys.executable, __file__, name, host, json.dumps(numbers)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None and process.stdout.readline() == "ready\n"
            yield
        finally:
            process.terminate()


def serve_each(host: str, port: int, serve: Callable[[socket.socket], None]) -> None:
    """Serve each connection in a thread, without end."""

    def one(connection: socket.socket) -> None:
        with connection, suppress(OSError):
            serve(connection)

    server = socket.create_server((host, port))
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    while True:
        connection, _ = server.accept()
        threading.Thread(target=one, args=(connection,), daemon=True).start()


def exactly(connection: socket.socket, count: int) -> bytes:
    data = b""
    while len(data) < count:
        if not (more := connection.recv(count - len(data))):
            raise OSError("hung up")
        data += more
    return data


RTDE_TYPES = {"timestamp": ("DOUBLE", 1), "actual_q": ("VECTOR6D", 6), "actual_TCP_pose": ("VECTOR6D", 6)}


def rtde(pose: ndarray, joints: ndarray) -> Callable[[socket.socket], None]:
    """Universal Robots' Real-Time Data Exchange (port 30004), protocol 2, after the guide of Universal Robots."""
    values = {
        "actual_q": joints,
        "actual_TCP_pose": np.concatenate([pose[:3, 3], rotation_log(pose[None, :3, :3])[0]]),
    }

    def serve(connection: socket.socket) -> None:
        def send(kind: str, payload: bytes) -> None:
            connection.sendall(struct.pack("!Hc", 3 + len(payload), kind.encode()) + payload)

        names: list[str] = []
        while True:
            length, kind = struct.unpack("!Hc", exactly(connection, 3))
            payload = exactly(connection, length - 3)
            if kind == b"V":
                send("V", b"\x01")
            elif kind == b"v":
                send("v", struct.pack("!4I", 5, 13, 0, 0))
            elif kind == b"O":
                names = payload[8:].decode().strip(",").split(",")
                send("O", b"\x01" + ",".join(RTDE_TYPES[name][0] for name in names).encode())
            elif kind == b"S":
                send("S", b"\x01")
                break
        start = time.monotonic()
        while True:
            values["timestamp"] = np.array([time.monotonic() - start])
            numbers = np.concatenate([values[name] for name in names])
            send("U", b"\x01" + struct.pack(f"!{len(numbers)}d", *numbers))
            time.sleep(0.008)

    return serve


def xarm(pose: ndarray, joints: ndarray) -> Callable[[socket.socket], None]:
    """UFACTORY's private Modbus TCP (port 502): transaction, protocol 2, length, function | state, data."""
    aa = np.concatenate([1e3 * pose[:3, 3], rotation_log(pose[None, :3, :3])[0]])
    answers = {
        1: b"6,9,LI1300xxxx,AC1300xxxx,v2.3.0".ljust(40, b"\0"),
        91: struct.pack("<6f", *aa),
        42: struct.pack("<7f", *joints, 0.0),
    }

    def serve(connection: socket.socket) -> None:
        while True:
            transaction, protocol, length = struct.unpack("!3H", exactly(connection, 6))
            body = exactly(connection, length)
            data = b"\0" + answers.get(body[0], bytes(8))
            connection.sendall(struct.pack("!3HB", transaction, protocol, len(data) + 1, body[0]) + data)

    return serve


if __name__ == "__main__":
    which, address, told = sys.argv[1:]
    numbers = np.array(json.loads(told))
    makes, at = {"rtde": (rtde, 30004), "xarm": (xarm, 502)}[which]
    serve_each(address, at, makes(numbers[:16].reshape(4, 4), numbers[16:]))
