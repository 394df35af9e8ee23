"""A server on 127.0.0.1 for one page in one browser.

It answers only requests that name this host, come from its own page and carry the token of its address, so that other
pages in the same browser have no access. Every request is bounded in size and time, and every refusal is JSON with the
key ``error``.
"""

from __future__ import annotations

import errno
import hmac
import logging
import secrets
import socket
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, NamedTuple

from seasonscapes.errors import InputError
from seasonscapes.text_files import json_line

log = logging.getLogger(__name__)

_SECONDS_FOR_A_REQUEST = 20.0
_SECONDS_OF_THE_REFUSED, _MOST_PIECES_OF_THE_REFUSED = 1.0, 64
_HOSTS = ("127.0.0.1", "localhost")
_NO_TRACE = {
    "Cache-Control": "no-store",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}


class Refused(Exception):
    """A request that is answered with a status and a reason."""

    def __init__(self, status: int, reason: str):
        super().__init__(reason)
        self.status, self.reason = status, reason


class Reply(NamedTuple):
    """What is sent: status, media type, body, Content-Security-Policy; without ``ends`` more of the body follows."""

    status: int
    kind: str
    body: bytes
    policy: str = "default-src 'none'"
    ends: bool = True


class LocalServer(ThreadingHTTPServer):
    """A server on 127.0.0.1 that takes many requests at once and whose clients may go away."""

    daemon_threads = True
    request_queue_size = 256

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Tell what went wrong with a connection in one line, unless its client went away or fell silent."""
        error = sys.exc_info()[1]
        if not isinstance(error, (ConnectionError, TimeoutError)):
            log.error("a connection failed: %r", error)


class LocalHandler(BaseHTTPRequestHandler):
    """A request to a page; subclasses define ``do_GET`` and the like with `answer` and `require_access`."""

    # A client that sends half a request, or takes no answer, is not waited for.
    timeout = _SECONDS_FOR_A_REQUEST
    token = ""

    def log_message(self, format: str, *args: object) -> None:
        """Print nothing."""

    def version_string(self) -> str:
        """What the header ``Server`` says."""
        return "seasonscapes"

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """What `BaseHTTPRequestHandler` itself refuses: methods that there are not, lines that are too long."""
        self.close_connection = True
        self.send(json_reply(code, {"error": message or self.responses.get(code, ("refused",))[0]}))

    def refusal(self, error: Exception) -> Reply:
        """The reply to a request that failed; subclasses know more failures than `Refused`."""
        if isinstance(error, Refused):
            return json_reply(error.status, {"error": error.reason})
        log.exception("%s failed", self.path)
        return json_reply(500, {"error": f"a fault of seasonscapes: {error!r}; the terminal shows more"})

    def answer(self, reply: Callable[[], Reply]) -> None:
        """Send a reply, or why there is none."""
        try:
            sent = reply()
        except (ConnectionError, TimeoutError):
            raise
        except Exception as error:
            sent = self.refusal(error)
        self.send(sent)
        if sent.status >= 400:
            self._read_to_the_end()

    def _read_to_the_end(self) -> None:
        """Take what a refused client still sends: closed before, the connection would be reset and the answer lost."""
        with suppress(OSError):
            self.wfile.flush()
            self.connection.shutdown(socket.SHUT_WR)
            self.connection.settimeout(_SECONDS_OF_THE_REFUSED)
            for _ in range(_MOST_PIECES_OF_THE_REFUSED):
                if not self.connection.recv(65536):
                    break

    def send(self, reply: Reply) -> None:
        """Send a reply with the headers of all replies."""
        self.send_response(reply.status)
        headers = {"Content-Type": reply.kind, **_NO_TRACE}
        if reply.ends:
            headers["Content-Length"] = str(len(reply.body))
        for name, value in (headers | {"Content-Security-Policy": reply.policy}).items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(reply.body)

    def require_access(self, given: str) -> None:
        """Refuse what does not come from this page: another host, another page, no token."""
        port = self.connection.getsockname()[1]
        hosts = [f"{name}:{port}" for name in _HOSTS]
        origin = self.headers.get("Origin")
        if len(self.headers.get_all("Host", [])) != 1 or self.headers["Host"].lower() not in hosts:
            raise Refused(403, "another host")
        if origin is not None and origin.lower() not in [f"http://{host}" for host in hosts]:
            raise Refused(403, "another origin")
        if not hmac.compare_digest(given.encode("utf-8", "surrogatepass"), self.token.encode()):
            raise Refused(403, "wrong or missing token")


def json_reply(status: int, value: Any) -> Reply:
    """A reply of one JSON value."""
    return Reply(status, "application/json", json_line(value).encode())


def serve_locally(handler: type[LocalHandler], *, port: int = 0) -> tuple[LocalServer, str]:
    """Serve on 127.0.0.1 in a background thread.

    Parameters
    ----------
    handler
        Of the requests; its ``token`` is set here.
    port
        TCP port; 0 selects a free one.

    Returns
    -------
    server : LocalServer
        The running server; call ``shutdown`` to stop it.
    address : str
        ``http://127.0.0.1:PORT``, without the token.

    Raises
    ------
    InputError
        If the port is none, is taken, or may not be used.
    """
    if not 0 <= port <= 65535:
        raise InputError("--port", "not a port", got=port, expected="0 to 65535; 0 takes a free one")
    handler.token = secrets.token_urlsafe(16)
    try:
        server = LocalServer(("127.0.0.1", port), handler)
    except OSError as error:
        problem = "is taken" if error.errno == errno.EADDRINUSE else f"cannot be used: {error.strerror}"
        raise InputError(
            "--port", problem, got=port, cure="choose another, or leave it out to take a free one"
        ) from None
    threading.Thread(target=server.serve_forever, daemon=True).start()
    return server, f"http://127.0.0.1:{server.server_address[1]}"
