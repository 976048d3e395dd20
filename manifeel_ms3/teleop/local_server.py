"""viser's server, closed to everybody but those who were given the page's address.

viser itself accepts every connection: from any web page that is open in the same browser, through any name that points to this
machine, and from everybody who reaches the port. This server accepts a connection only if all of these hold:

- The path of the address begins with a token that is drawn anew at each start.
- The header `Host` names this machine, so that no foreign name leads here (DNS rebinding).
- The header `Origin`, which browsers send with the name of the page that connects, is the page's own.
"""

import hmac
import io
import ipaddress
import logging
import secrets
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from dataclasses import replace
from functools import partial
from http import HTTPStatus
from typing import Any
from urllib.parse import urlsplit

import viser
import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from manifeel_ms3.errors import MachineError
from manifeel_ms3.network import LOOPBACK_NAMES

log = logging.getLogger(__name__)
TOKEN_BYTES = 16
"""Length of the token in bytes: 128 bits, which nobody guesses."""
ANY_ADDRESS = frozenset({"0.0.0.0", "::", ""})
"""Values of `host` that stand for all addresses of this machine."""


class LocalServer(viser.ViserServer):
    """viser's server, with a token in its address, and without public tunnels.

    Args:
        host: Address to listen on.
        port: Port to listen on; the next free one if it is taken.
        label: Title of the page.

    Raises:
        MachineError: The host is no address of this machine, or the installed version of viser starts its server in another
            way, so that it cannot be closed to others.
    """

    def __init__(self, host: str, port: int, label: str):
        _require_address(host)  # viser would try one port after the other, and then wait for ever
        self._token, self._guarded = secrets.token_urlsafe(TOKEN_BYTES), False
        logging.getLogger("websockets").setLevel(logging.CRITICAL)  # it logs every page that opens or closes
        with _serving_with(self._serve_guarded), redirect_stdout(io.StringIO()):  # viser prints an address without the token
            super().__init__(host=host, port=port, label=label, verbose=False)
        if not self._guarded:
            self.stop()
            raise MachineError(
                f"viser {viser.__version__} cannot be closed to others; install the version of requirements.lock"
            )

    @property
    def address(self) -> str:
        """Address of the page, with the token."""
        host = self.get_host()
        name = socket.gethostname() if host in ANY_ADDRESS else host
        return f"http://{f'[{name}]' if ':' in name else name}:{self.get_port()}/{self._token}"

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Refuse the public address that a page asks for."""
        log.warning("a page asked for a public address of this server; it was refused")
        return None

    def disconnect_share_url(self) -> None:
        """Do nothing: there is no public address."""

    def _serve_guarded(self, serve: Any, *args: Any, process_request: Any, **kwargs: Any) -> Any:
        """Call websockets' `serve` so that every request is checked before viser is given it."""
        self._guarded = True

        def checked(connection: ServerConnection, request: Request) -> Response | None:
            if reason := self._reason_to_refuse(request):
                return connection.respond(HTTPStatus.FORBIDDEN, f"{reason}\n")
            rest = request.path.removeprefix(f"/{self._token}")
            return process_request(connection, replace(request, path=f"/{rest.lstrip('/')}"))

        return serve(*args, process_request=checked, **kwargs)

    def _reason_to_refuse(self, request: Request) -> str:
        """Why a request is refused; empty if it is not."""
        hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
        if len(hosts) != 1 or not self._is_own_name(urlsplit(f"//{hosts[0]}").hostname or ""):
            return "This address does not name the machine that serves the page."
        if len(origins) > 1 or any(urlsplit(origin).netloc != hosts[0] for origin in origins):
            return "Pages of other sites may not connect."
        token = urlsplit(request.path).path.split("/")[1]
        if not hmac.compare_digest(token.encode(), self._token.encode()):
            return "The address needs the token that the command printed when it started."
        return ""

    def _is_own_name(self, name: str) -> bool:
        """Whether a name leads to this server and to no other."""
        host = self.get_host().lower()
        if name in LOOPBACK_NAMES or name == host:
            return True
        return host in ANY_ADDRESS and (name == socket.gethostname().lower() or _is_ip_address(name))


def _require_address(host: str) -> None:
    """Raise a MachineError if this machine cannot listen on any address that a name or a number stands for."""
    reason: OSError | None = None
    try:
        for family, kind, _, _, address in socket.getaddrinfo(
            host or None, 0, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        ):
            try:
                with socket.socket(family, kind) as one:
                    one.bind(address)
                return
            except OSError as error:
                reason = error
    except socket.gaierror as error:
        reason = error
    raise MachineError(
        f"this machine cannot listen on the host {host!r} ({reason}); give one of its own addresses, or 127.0.0.1 for this "
        "machine alone, or 0.0.0.0 for all of its addresses"
    )


@contextmanager
def _serving_with(serve_guarded: Callable[..., Any]) -> Iterator[None]:
    """Context that replaces websockets' `serve` by a function, because viser has no argument for a check of connections.

    Args:
        serve_guarded: Function that takes websockets' `serve`, followed by the arguments of `serve`.
    """
    serve = websockets.asyncio.server.serve
    websockets.asyncio.server.serve = partial(serve_guarded, serve)
    try:
        yield
    finally:
        websockets.asyncio.server.serve = serve


def _is_ip_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True
