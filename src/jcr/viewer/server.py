"""The web server of the viewer: viser on this machine and one port alone, its sharing through others' machines off."""

import io
import socket
from contextlib import redirect_stdout

import viser

from jcr.errors import InputError

HOST = "127.0.0.1"
"""viser has no password and no encryption, so that no other machine may reach it."""


class LocalServer(viser.ViserServer):
    """A viser server that never opens a tunnel: what a page asks for must not send a workplace to the internet."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """No address: sharing is off."""
        return None

    def stop(self) -> None:
        """Stop without a word; standard output is the command's."""
        with redirect_stdout(io.StringIO()):
            super().stop()


def open_server(port: int, title: str) -> LocalServer:
    """A running server at a port of 127.0.0.1 (0: any free one); InputError where it cannot listen there."""
    if not 0 <= port <= 65535:
        raise InputError(f"--port {port}: no such port; take one from 1024 to 65535, or 0 for any free one")
    # viser would silently take the next port.
    try:
        with socket.create_server((HOST, port)):
            pass
    except OSError as error:
        remedy = "choose another with --port (0 takes any free one)"
        raise InputError(f"cannot listen on port {port} of {HOST} ({error.strerror}); {remedy}") from None
    with redirect_stdout(io.StringIO()):
        server = LocalServer(host=HOST, port=port, label=title, verbose=False)
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    return server
