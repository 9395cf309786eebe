"""Gripper poses over TCP, one JSON object a line, from any program that can open a socket (jcr docs capture).

A line `{"base_from_gripper": [[…]×4]}` (or six, seven or sixteen numbers) means that the arm rests there now;
the answer, a line too, comes when the calibration with that image stands, with its accuracy, its findings and the pose
to go to next. `{"done": true}` ends the capture.
"""

import contextlib
import hmac
import ipaddress
import json
import select
import socket
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.errors import InputError
from jcr.live.asks import Answer, Ask, pose_of_numbers

MAX_LINE = 65_536
"""Bytes; a pose takes a few hundred."""
MOST_REFUSED = 100
"""Lines in a row, after which a client is no robot's program."""
LINE_S = 10.0
"""For a line that has begun to be whole, and for a stranger's first."""
ANSWER_S = 10.0
"""A client that does not take its answer within this is gone."""


@dataclass(frozen=True)
class Listen:
    """Where to listen, and to whom."""

    host: str = "127.0.0.1"
    port: int = 7464
    token: str | None = None
    """What a client's first line must carry, `{"token": "…"}`; required when others can reach us."""
    timeout_s: float = 600.0
    """Without a word for so long the capture ends."""


def served_poses(server: socket.socket, listen: Listen) -> Iterator[Ask]:
    """A request per good line, from one client at a time; a bad line is answered, a bad client dropped.

    Raises InputError when no line comes for `timeout_s`.
    """
    while True:
        try:
            client, _ = server.accept()
        except TimeoutError:
            raise _silence(listen) from None
        with client:
            client.settimeout(listen.timeout_s)
            if _gives_way(client, server, listen):
                _dismiss(client, f"silent for {LINE_S:.0f} s, and another client waits")
                continue
            done = yield from _served(client, listen)
        if done:
            return


def bound(listen: Listen) -> socket.socket:
    """The listening socket; InputError where it cannot be had, or is open to others without a token."""
    if not _is_loopback(listen.host) and not listen.token:
        raise InputError(
            f"--listen {listen.host}:{listen.port}: others can reach that address; give a --token that the "
            "client sends first, or listen on 127.0.0.1"
        )
    try:
        server = socket.create_server((listen.host, listen.port))
    except (OSError, OverflowError) as error:
        raise InputError(
            f"--listen {listen.host}:{listen.port}: {error}; choose an address of this machine and a free port"
        ) from None
    server.settimeout(listen.timeout_s)
    return server


def _gives_way(client: socket.socket, server: socket.socket, listen: Listen) -> bool:
    """Whether a client has sent nothing for LINE_S and another waits to connect; one that waits alone may."""
    end = time.monotonic() + listen.timeout_s
    if select.select([client], [], [], min(LINE_S, listen.timeout_s))[0]:
        return False
    ready, _, _ = select.select([client, server], [], [], max(end - time.monotonic(), 0.0))
    return client not in ready and server in ready


def _served(client: socket.socket, listen: Listen):
    """Requests of one client; returns whether it ended the capture."""
    received, refused = bytearray(), 0
    if listen.token is not None and not _has_token(client, received, listen.token):
        return False
    while True:
        try:
            line = _line(client, received, listen.timeout_s)
        except _SilentError:
            raise _silence(listen) from None
        if not line:
            return False
        if refused >= MOST_REFUSED:
            _dismiss(client, f"{MOST_REFUSED} lines in a row were refused")
            return False
        try:
            message = parsed(line)
            if message.get("done") is True:
                return True
            pose = pose_of(message)
        except InputError as error:
            refused += 1
            _answer(client, _refusal(str(error)))
        else:
            refused = 0
            answered = threading.Event()

            def answer(found: Answer, answered: threading.Event = answered) -> None:
                _answer(client, found)
                answered.set()

            yield Ask(pose, answer=answer, waits=True)
            answered.wait()


def _has_token(client: socket.socket, received: bytearray, token: str) -> bool:
    """Whether the first line of a client has the token; others are dismissed."""
    try:
        line = _line(client, received, LINE_S)
    except _SilentError:
        return False
    if not line:
        return False
    try:
        given = parsed(line).get("token")
    except InputError:
        given = None
    # JSON may have half of a surrogate pair, which is no UTF-8.
    known, sent = (str(one).encode("utf-8", "surrogatepass") for one in (token, given))
    if not hmac.compare_digest(known, sent):
        _dismiss(client, "the first line must be the right token")
        return False
    _answer(client, {"accepted": True})
    return True


class _SilentError(Exception):
    """No line began in time."""


def _line(client: socket.socket, received: bytearray, patience_s: float) -> bytes:
    """The next line; empty where the client is gone, or dismissed for a line that is too long or not whole in time.

    `received` is what came behind the line before. Raises _SilentError where none begins within `patience_s`.
    """
    deadline = time.monotonic() + (LINE_S if received else patience_s)
    while b"\n" not in received and len(received) <= MAX_LINE:
        client.settimeout(max(deadline - time.monotonic(), 1e-3))
        try:
            more = client.recv(MAX_LINE)
        except TimeoutError:
            if received:
                return b""
            raise _SilentError from None
        except OSError:
            return b""
        if not more:
            break
        if not received:
            deadline = time.monotonic() + LINE_S
        received += more
    line, end, rest = bytes(received).partition(b"\n")
    received[:] = rest
    if len(line + end) > MAX_LINE:
        _dismiss(client, f"a line of more than {MAX_LINE} bytes")
        return b""
    return line + end


def parsed(line: bytes) -> dict[str, Any]:
    """The object on a line; InputError where it has none."""
    try:
        message = json.loads(line)
    except (ValueError, RecursionError):
        raise InputError('not JSON; send {"base_from_gripper": [[…], […], […], […]]} on one line') from None
    if not isinstance(message, dict):
        raise InputError("not a JSON object")
    return message


def pose_of(message: dict[str, Any]) -> Float[ndarray, "4 4"]:
    """base_from_gripper of a message; InputError where it has none."""
    if "base_from_gripper" not in message:
        raise InputError('no "base_from_gripper" in the line; send 4 rows of 4 numbers in metres')
    try:
        numbers = np.array(message["base_from_gripper"], dtype=np.float64).ravel().tolist()
    except (TypeError, ValueError, OverflowError):
        raise InputError("base_from_gripper: not numbers; send 4 rows of 4 in metres") from None
    return pose_of_numbers(numbers, "base_from_gripper")


def _answer(client: socket.socket, answer: Answer) -> None:
    """Send a line; a client that has gone misses it, and the image is kept all the same."""
    before = client.gettimeout()
    client.settimeout(ANSWER_S)
    try:
        client.sendall(json.dumps(answer).encode() + b"\n")
    except OSError:
        return
    finally:
        client.settimeout(before)


def _dismiss(client: socket.socket, reason: str) -> None:
    """A last answer, which closing with unread bytes behind it would take back."""
    _answer(client, _refusal(reason))
    client.settimeout(0.2)
    with contextlib.suppress(OSError):
        client.shutdown(socket.SHUT_WR)
        for _ in range(16):
            if not client.recv(MAX_LINE):
                return


def _refusal(reason: str) -> Answer:
    return {"accepted": False, "reason": reason}


def _silence(listen: Listen) -> InputError:
    return InputError(
        f"--listen {listen.host}:{listen.port}: nobody sent a pose for {listen.timeout_s:.0f} s; the images "
        "taken are kept and the same command resumes"
    )


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
