"""The web server of the viewer: viser, held to one address and port, its sharing through others' machines off."""

import io
import socket
from contextlib import redirect_stdout

import viser

from jcr.errors import InputError


class LocalServer(viser.ViserServer):
    """A viser server that never opens a tunnel: what a page asks for must not send a workplace to the internet."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """No address: sharing is off."""
        return None

    def stop(self) -> None:
        """Stop without a word; standard output is the command's."""
        with redirect_stdout(io.StringIO()):
            super().stop()


def open_server(host: str, port: int, title: str) -> LocalServer:
    """A running server at host and port (0: any free one); InputError where it cannot listen there."""
    if not 0 <= port <= 65535:
        raise InputError(f"--port {port}: no such port; take one from 1024 to 65535, or 0 for any free one")
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    # viser would silently take the next port, and try for ever on an address that is not this machine's.
    try:
        with socket.create_server((host, port), family=family):
            pass
    except OSError as error:
        cure = "choose another with --port (0 takes any free one), or another --host"
        raise InputError(f"cannot listen on port {port} of {host} ({error.strerror}); {cure}") from None
    with redirect_stdout(io.StringIO()):
        server = LocalServer(host=host, port=port, label=title, verbose=False)
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    return server


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach a server that listens there."""
    return host == "localhost" or host == "::1" or host.startswith("127.")
