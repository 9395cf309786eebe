"""Controllers with the protocols of their makers' packages, as far as reading poses needs."""

import json
import socket
import struct
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import numpy as np
from numpy import ndarray

from jcr.geometry import rotation_log


@contextmanager
def fake_xarm(host: str, pose: ndarray, joints: ndarray) -> Iterator[None]:
    """Run a controller in a process of its own: the makers' packages hold Python's lock while they wait for it."""
    numbers = [*pose.ravel().tolist(), *joints.tolist()]
    command = [sys.executable, __file__, host, json.dumps(numbers)]
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
    address, as_json = sys.argv[1:]
    numbers = np.array(json.loads(as_json))
    serve_each(address, 502, xarm(numbers[:16].reshape(4, 4), numbers[16:]))
