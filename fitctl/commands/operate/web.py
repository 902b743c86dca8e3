"""`fitctl console --web`: the same console in a browser on this machine, and in no other."""

from __future__ import annotations

import os
import secrets
import shlex
import socket
import sys
from collections.abc import Awaitable, Callable, Sequence

from fitctl.config import ConfigError

HOST = "127.0.0.1"
# textual-serve's page takes no key, and so no STOP, before somebody has clicked on it.
_TAKE_KEYS = """<script>
const takeKeys = () => document.querySelector(".xterm-helper-textarea")?.focus();
addEventListener("focus", takeKeys);
const waiting = setInterval(() => {
    takeKeys();
    if (document.activeElement?.classList.contains("xterm-helper-textarea")) clearInterval(waiting);
}, 100);
</script>"""
_Handler = Callable[..., Awaitable]


def serve_console(rig_arguments: Sequence[str], port: int) -> None:
    """Serve consoles by textual-serve, one process for each page, until Ctrl-C.

    Whoever can open the page can command the instrument. A port of loopback is open to every user and to
    every page in a browser of this machine, so only who has the printed address is let in. The key is the
    first part of every path. It is no cookie, because browsers send the cookies of one port of 127.0.0.1 to
    all others: another user's server there would get it, and two consoles would log each other out.

    Raises
    ------
    ConfigError
        If textual-serve is not installed, or the port is taken.
    """
    try:
        from aiohttp import web
        from textual_serve.server import Server
    except ModuleNotFoundError as error:
        msg = f"console --web needs textual-serve ({error.name} is missing): pip install 'fitctl[web]'"
        raise ConfigError(msg) from None

    key = secrets.token_urlsafe(24)
    address = f"http://{HOST}:{port}"

    class GuardedServer(Server):
        """Lets in who has the key."""

        async def _make_app(self) -> web.Application:
            guarded = web.Application(middlewares=[web.middleware(_guard(web, address, key))])
            guarded.add_subapp(f"/{key}", await super()._make_app())
            return guarded

        def initialize_logging(self) -> None:
            """Nothing but the address is printed."""

        async def on_startup(self, app: web.Application) -> None:
            """Say where."""
            print(f"console: {address}/{key}/", flush=True)
            print("Ctrl-C ends it; each page is a console of its own.", flush=True)

    command = shlex.join([sys.executable, "-m", "fitctl", "console", *rig_arguments])
    try:
        # The server prints its address before it binds the port.
        socket.create_server((HOST, port)).close()
        GuardedServer(command, host=HOST, port=port, title="fitctl").serve()
    except OSError as error:
        why = os.strerror(error.errno or 0)
        msg = f"console --web: port {port}: {why}; choose another with --port"
        raise ConfigError(msg) from None


def _nothing_from_elsewhere(host: str) -> str:
    """A policy for browsers; textual-serve's page would get a font from the Internet."""
    inline = "'self' 'unsafe-inline'"
    return (
        f"default-src 'self'; style-src {inline}; script-src {inline}; font-src 'self' data:; "
        f"img-src 'self' data:; connect-src ws://{host} http://{host}; frame-ancestors 'none'"
    )


def _guard(web, address: str, key: str) -> _Handler:  # pyrefly: ignore[implicit-any-parameter]  # a module
    host = address.removeprefix("http://")

    async def guard(request, handler):  # pyrefly: ignore[implicit-any-parameter, unannotated-return]  # aiohttp's
        at_home = request.host == host and request.headers.get("Origin", address) == address
        # Of any characters, which strings are not compared with; a path may be "*".
        given = request.path.partition("/")[2].partition("/")[0]
        if at_home and secrets.compare_digest(given.encode(errors="replace"), key.encode()):
            response = await handler(request)
            if isinstance(response, web.Response) and response.content_type == "text/html":
                response.text = (response.text or "").replace("</body>", f"{_TAKE_KEYS}</body>")
            if not response.prepared:
                response.headers["Content-Security-Policy"] = _nothing_from_elsewhere(host)
                response.headers["Referrer-Policy"] = "no-referrer"  # the address is the key
            return response
        return web.Response(status=403, text="open the address that fitctl console --web printed\n")

    return guard
