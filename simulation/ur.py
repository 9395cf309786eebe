"""A simulated Universal Robots arm: its real-time port on this machine, for trying a capture without a robot."""

import socket
import struct
import threading
import time

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.geometry import rotation_log

RATE_HZ = 125
REST_S = 0.8
"""On the arm's clock, at each stop; on its way to the next it is for a quarter of a second."""
PAUSE_S = 0.001
"""Between two packets on our clock: the arm lives eight times as fast."""


class SimulatedUr:
    """An arm that goes from stop to stop and rests at each; its clock stands while nobody listens.

    Used in a `with` statement, it serves packets of `length` bytes on `port` of 127.0.0.1, laid out as jcr.live.ur
    reads them; what is not the pose, the joint angles (zero where not given) or the time is noise.
    """

    def __init__(
        self,
        base_from_gripper: Float[ndarray, "n 4 4"],
        length: int = 1220,
        joints: Float[ndarray, "n 6"] | None = None,
    ) -> None:
        stops = np.hstack([base_from_gripper[:, :3, 3], rotation_log(base_from_gripper[:, :3, :3])])
        starts = np.vstack([stops[:1] + 0.05, stops[:-1]])
        moves = np.linspace(starts, stops, RATE_HZ // 4, axis=1)
        rests = np.repeat(stops[:, None], round(REST_S * RATE_HZ), axis=1)
        self._way = np.concatenate([moves, rests], axis=1)  # (stops, ticks, 6)
        self._joints = np.zeros((len(stops), 6)) if joints is None else joints
        self._length, self._offset = length, 588 if length < 1000 else 444
        self._tick, self._over = 0, threading.Event()
        self._server = socket.create_server(("127.0.0.1", 0))
        self._server.settimeout(0.2)
        self.port: int = self._server.getsockname()[1]
        self._thread = threading.Thread(target=self._serve)

    @property
    def stop(self) -> int:
        """Number of the stop that the arm rests at or moves to."""
        return min(self._tick // self._way.shape[1], len(self._way) - 1)

    def __enter__(self) -> "SimulatedUr":
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._over.set()
        self._thread.join()
        self._server.close()

    def _serve(self) -> None:
        while not self._over.is_set():
            try:
                connection, _ = self._server.accept()
            except TimeoutError:
                continue
            with connection:
                try:
                    while not self._over.is_set():
                        connection.sendall(self._packet())
                        time.sleep(PAUSE_S)
                except OSError:  # the listener hung up
                    continue

    def _packet(self) -> bytes:
        packet = bytearray(np.random.default_rng(self._tick).bytes(self._length))
        way = self._way.reshape(-1, 6)
        struct.pack_into("!id", packet, 0, self._length, self._tick / RATE_HZ)
        struct.pack_into("!6d", packet, self._offset, *way[min(self._tick, len(way) - 1)])
        struct.pack_into("!6d", packet, 252, *self._joints[self.stop])
        self._tick += 1
        return bytes(packet)
