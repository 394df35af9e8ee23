"""The local page of an annotation session: photograph on the left, rendered terrain on the right.

The server listens on 127.0.0.1. It answers only requests that name this host, come from its own page and carry the token
in the address that `serve_session` returns, so that other pages in the same browser have no access. Every request is
bounded in size and time, and every refusal is JSON with the key ``error``.
"""

from __future__ import annotations

import errno
import hmac
import logging
import os
import re
import secrets
import socket
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import parse_qs, urlsplit

import cv2

from seasonscapes.calibration.annotation import (
    AnnotationSession,
    add_match,
    project_to_photograph,
    remove_last_match,
    save_session,
    session_state,
    solve_session,
)
from seasonscapes.errors import InputError, SeasonscapesError
from seasonscapes.text_files import json_line, parse_json

log = logging.getLogger(__name__)

_MOST_BODY_BYTES = 10_000
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

_Json = dict[str, Any]


class _Refused(Exception):
    """A request that is answered with a status and a reason."""

    def __init__(self, status: int, reason: str):
        super().__init__(reason)
        self.status, self.reason = status, reason


class _Reply(NamedTuple):
    status: int
    kind: str
    body: bytes
    policy: str = "default-src 'none'"


class LocalServer(ThreadingHTTPServer):
    """A server on 127.0.0.1 that takes many requests at once and whose clients may go away."""

    daemon_threads = True
    request_queue_size = 256

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Tell what went wrong with a connection in one line, unless its client went away or fell silent."""
        error = sys.exc_info()[1]
        if not isinstance(error, (ConnectionError, TimeoutError)):
            log.error("annotate: a connection failed: %r", error)


def serve_session(session: AnnotationSession, *, port: int = 0) -> tuple[LocalServer, str]:
    """Serve the page of a session on 127.0.0.1 in a background thread.

    Parameters
    ----------
    session
        Session.
    port
        TCP port; 0 selects a free one.

    Returns
    -------
    server : LocalServer
        The running server; call ``shutdown`` to stop it.
    address : str
        URL of the page with its access token.

    Raises
    ------
    InputError
        If the port is none, is taken, or may not be used.
    """
    if not 0 <= port <= 65535:
        raise InputError("--port", "not a port", got=port, expected="0 to 65535; 0 takes a free one")
    token, lock = secrets.token_urlsafe(16), threading.Lock()
    try:
        server = LocalServer(("127.0.0.1", port), _handler(session, token, lock))
    except OSError as error:
        problem = "is taken" if error.errno == errno.EADDRINUSE else f"cannot be used: {error.strerror}"
        raise InputError(
            "--port", problem, got=port, cure="choose another, or leave it out to take a free one"
        ) from None
    threading.Thread(target=server.serve_forever, daemon=True).start()
    return server, f"http://127.0.0.1:{server.server_address[1]}/?token={token}"


def _pixel(body: _Json, key: str) -> tuple[float, float]:
    """The pixel ``[x, y]`` of a request; `ValueError` unless it is two finite numbers."""
    values = body.get(key)
    if isinstance(values, list) and len(values) == 2:
        x, y = (v if isinstance(v, (int, float)) and not isinstance(v, bool) and abs(v) < 1e9 else None for v in values)
        if x is not None and y is not None:
            return float(x), float(y)
    raise ValueError(f"not a request of this page: {key} is not a pixel [x, y]")


def _actions(session: AnnotationSession) -> dict[str, Callable[[_Json], _Json]]:
    def returning_state(action: Callable[[_Json], None]) -> Callable[[_Json], _Json]:
        def run(body: _Json) -> _Json:
            action(body)
            return session_state(session)

        return run

    return {
        "/state": lambda body: session_state(session),
        "/where": lambda body: {"photo": project_to_photograph(session, _pixel(body, "terrain"))},
        "/pick": returning_state(lambda body: add_match(session, _pixel(body, "photo"), _pixel(body, "terrain"))),
        "/undo": returning_state(lambda body: remove_last_match(session)),
        "/solve": returning_state(lambda body: solve_session(session)),
        "/save": lambda body: {"files": [str(path) for path in save_session(session)]},
    }


def _json_reply(status: int, value: Any) -> _Reply:
    return _Reply(status, "application/json", json_line(value).encode())


def _handler(session: AnnotationSession, token: str, lock: threading.Lock) -> type[BaseHTTPRequestHandler]:
    actions = _actions(session)

    class Handler(BaseHTTPRequestHandler):
        # A client that sends half a request, or takes no answer, is not waited for.
        timeout = _SECONDS_FOR_A_REQUEST

        def log_message(self, format: str, *args: object) -> None:
            pass

        def version_string(self) -> str:
            return "seasonscapes"

        def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
            """What `BaseHTTPRequestHandler` itself refuses: methods that there are not, lines that are too long."""
            self.close_connection = True
            self._send(_json_reply(code, {"error": message or self.responses.get(code, ("refused",))[0]}))

        def do_GET(self) -> None:
            self._answer(self._page_or_picture)

        def do_POST(self) -> None:
            self._answer(self._action)

        def _answer(self, reply: Callable[[], _Reply]) -> None:
            """Send a reply, or why there is none."""
            try:
                sent = reply()
            except _Refused as refused:
                sent = _json_reply(refused.status, {"error": refused.reason})
            except (ValueError, SeasonscapesError) as error:
                sent = _json_reply(400, {"error": str(error)})
            except (ConnectionError, TimeoutError):
                raise
            except OSError as error:
                # Of saving: the page must know that nothing was written.
                where = f" ({os.fspath(error.filename)})" if isinstance(error.filename, (str, os.PathLike)) else ""
                sent = _json_reply(500, {"error": f"not saved: {(error.strerror or str(error)).lower()}{where}"})
            except Exception as error:
                log.exception("annotate: %s failed", self.path)
                sent = _json_reply(500, {"error": f"a fault of seasonscapes: {error!r}; the terminal shows more"})
            self._send(sent)
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

        def _send(self, reply: _Reply) -> None:
            self.send_response(reply.status)
            headers = {"Content-Type": reply.kind, "Content-Length": str(len(reply.body)), **_NO_TRACE}
            for name, value in (headers | {"Content-Security-Policy": reply.policy}).items():
                self.send_header(name, value)
            self.end_headers()
            if self.command != "HEAD":
                self.wfile.write(reply.body)

        def _require_access(self, given: str) -> None:
            """Refuse what does not come from this page: another host, another page, no token."""
            port = self.connection.getsockname()[1]
            hosts = [f"{name}:{port}" for name in _HOSTS]
            origin = self.headers.get("Origin")
            if len(self.headers.get_all("Host", [])) != 1 or self.headers["Host"].lower() not in hosts:
                raise _Refused(403, "another host")
            if origin is not None and origin.lower() not in [f"http://{host}" for host in hosts]:
                raise _Refused(403, "another origin")
            if not hmac.compare_digest(given.encode("utf-8", "surrogatepass"), token.encode()):
                raise _Refused(403, "wrong or missing token")

        def _page_or_picture(self) -> _Reply:
            address = urlsplit(self.path)
            query = parse_qs(address.query, max_num_fields=8)
            self._require_access(query.get("token", [""])[0])
            if address.path == "/":
                return _page(token)
            if address.path not in ("/photo.jpg", "/terrain.png"):
                raise _Refused(404, "no such page")
            with lock:
                image = session.image if address.path == "/photo.jpg" else session.relief
            suffix = address.path[-4:]
            encoded = cv2.imencode(suffix, image[..., ::-1])[1].tobytes()
            return _Reply(200, "image/jpeg" if suffix == ".jpg" else "image/png", encoded)

        def _action(self) -> _Reply:
            self._require_access(self.headers.get("X-Token", ""))
            action = actions.get(urlsplit(self.path).path)
            if action is None:
                raise _Refused(404, "no such action")
            body = self._body()
            with lock:
                return _json_reply(200, action(body))

        def _body(self) -> _Json:
            """The JSON object of a request; its length is stated and bounded."""
            stated: Sequence[str] = self.headers.get_all("Content-Length", [])
            if "Transfer-Encoding" in self.headers or len(stated) > 1:
                raise _Refused(400, "the length of the request is not stated once")
            length = stated[0] if stated else "0"
            if not re.fullmatch(r"[0-9]{1,18}", length):
                raise _Refused(400, "the length of the request is no number")
            if int(length) > _MOST_BODY_BYTES:
                raise _Refused(413, f"the request is longer than {_MOST_BODY_BYTES:,} bytes")
            content = self.rfile.read(int(length))
            if len(content) < int(length):
                raise _Refused(400, "the request ends before its stated length")
            table = parse_json(content or b"{}", where="request")
            if not isinstance(table, dict):
                raise _Refused(400, "not a request of this page: not a JSON object")
            return table

    return Handler


def _page(token: str) -> _Reply:
    """The page; only its own script and style may run, marked by a number that is new each time."""
    nonce = secrets.token_urlsafe(16)
    page = Path(__file__).with_name("annotation.html").read_text(encoding="utf-8")
    policy = (
        f"default-src 'none'; script-src 'nonce-{nonce}'; style-src 'nonce-{nonce}'; img-src 'self'; connect-src 'self'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )
    text = page.replace("@TOKEN@", token).replace("@NONCE@", nonce)
    return _Reply(200, "text/html; charset=utf-8", text.encode(), policy)
