"""Web server of the viewer: viser on one port of this machine, without its sharing through other machines."""

import io
from contextlib import redirect_stdout

import viser

from jcr.errors import InputError

HOST = "127.0.0.1"
"""Other machines must not reach viser, which has no password and no encryption."""


class LocalServer(viser.ViserServer):
    """viser server that never opens a tunnel to the internet."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Return no address: sharing is disabled."""
        return None

    def stop(self) -> None:
        """Stop without printing: standard output belongs to the command."""
        with redirect_stdout(io.StringIO()):
            super().stop()


def open_server(port: int, title: str) -> LocalServer:
    """Return a running server at a port of 127.0.0.1 (0: any free one); raise InputError where the port is taken."""
    if not 0 <= port <= 65535:
        raise InputError(f"--port {port}: no such port; take one from 1024 to 65535, or 0 for any free one")
    with redirect_stdout(io.StringIO()):
        server = LocalServer(host=HOST, port=port, label=title, verbose=False)
    if port not in (0, server.get_port()):  # viser takes the next free port silently
        server.stop()
        raise InputError(
            f"cannot listen on port {port} of {HOST}; choose another with --port (0 takes any free one)"
        )
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    return server
