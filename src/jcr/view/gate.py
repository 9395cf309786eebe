"""A door before the viewer for other machines: who has the token in the address gets a cookie, all others nothing."""

import asyncio
import hmac
import secrets
import threading
from contextlib import suppress
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qs, urlsplit

from jcr.errors import InputError

MAX_HEAD = 16_384
"""Bytes of a request's head; browsers send two thousand."""
PATIENCE_S = 10.0
"""For a request's head to come."""
COOKIE = "jcr"
_REFUSED = b"HTTP/1.1 403 Forbidden\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"


class Gate:
    """Listens at host and port, and joins those who have the token with a port of this machine."""

    def __init__(self, host: str, port: int, inner_port: int) -> None:
        self.token = secrets.token_urlsafe(16)
        self._inner_port = inner_port
        self._loop = asyncio.new_event_loop()
        listening = asyncio.start_server(self._served, host, port, limit=MAX_HEAD)
        try:
            self._server = self._loop.run_until_complete(listening)
        except (OSError, OverflowError) as error:
            self._loop.close()
            raise InputError(
                f"cannot listen on port {port} of {host} ({error}); choose another with --port (0 takes any free "
                "one), or another --host"
            ) from None
        self.port: int = self._server.sockets[0].getsockname()[1]
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Hang up on everyone."""
        asyncio.run_coroutine_threadsafe(self._close(), self._loop).result()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    async def _close(self) -> None:
        self._server.close()
        others = asyncio.all_tasks() - {asyncio.current_task()}
        for task in others:
            task.cancel()
        await asyncio.gather(*others, return_exceptions=True)

    async def _served(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with suppress(OSError, TimeoutError, asyncio.LimitOverrunError, asyncio.IncompleteReadError):
            try:
                head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), PATIENCE_S)
                if self._is_known(head):
                    await self._joined(head, reader, writer)
                else:
                    writer.write(self._welcome(head))
                    await writer.drain()
            finally:
                writer.close()

    def _is_known(self, head: bytes) -> bool:
        """Whether a request carries the cookie."""
        for line in head.decode("latin-1").split("\r\n"):
            name, _, value = line.partition(":")
            if name.lower() == "cookie":
                with suppress(CookieError):
                    morsel = SimpleCookie(value).get(COOKIE)
                    if morsel is not None and hmac.compare_digest(morsel.value.encode(), self.token.encode()):
                        return True
        return False

    def _welcome(self, head: bytes) -> bytes:
        """The cookie for an address with the token, on the way to the page; for any other address a refusal."""
        target = head.decode("latin-1").split(" ")[1:2]
        try:
            given = parse_qs(urlsplit("".join(target)).query).get("token", [""])[0]
        except ValueError:
            return _REFUSED
        if not hmac.compare_digest(given.encode(), self.token.encode()):
            return _REFUSED
        cookie = f"Set-Cookie: {COOKIE}={self.token}; HttpOnly; SameSite=Strict; Path=/"
        lines = ("HTTP/1.1 303 See Other", "Location: /", cookie, "Content-Length: 0", "Connection: close")
        return ("\r\n".join(lines) + "\r\n\r\n").encode()

    async def _joined(self, head: bytes, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        inner_reader, inner_writer = await asyncio.open_connection("127.0.0.1", self._inner_port)
        try:
            inner_writer.write(head)
            await asyncio.gather(_poured(reader, inner_writer), _poured(inner_reader, writer))
        finally:
            inner_writer.close()


async def _poured(source: asyncio.StreamReader, sink: asyncio.StreamWriter) -> None:
    while data := await source.read(1 << 16):
        sink.write(data)
        await sink.drain()
    sink.close()
