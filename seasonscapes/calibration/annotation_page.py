"""The local page of an annotation session: photograph on the left, rendered terrain on the right; see `local_server`."""

from __future__ import annotations

import os
import re
import secrets
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any
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
from seasonscapes.errors import SeasonscapesError
from seasonscapes.local_server import LocalHandler, LocalServer, Refused, Reply, json_reply, serve_locally
from seasonscapes.text_files import parse_json

_MOST_BODY_BYTES = 10_000

_Json = dict[str, Any]


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
    handler = _handler(session, threading.Lock())
    server, address = serve_locally(handler, port=port)
    return server, f"{address}/?token={handler.token}"


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


def _handler(session: AnnotationSession, lock: threading.Lock) -> type[LocalHandler]:
    actions = _actions(session)

    class Handler(LocalHandler):
        def do_GET(self) -> None:
            self.answer(self._page_or_picture)

        def do_POST(self) -> None:
            self.answer(self._action)

        def refusal(self, error: Exception) -> Reply:
            if isinstance(error, (ValueError, SeasonscapesError)):
                return json_reply(400, {"error": str(error)})
            if isinstance(error, OSError):
                # Of saving: the page must know that nothing was written.
                where = f" ({os.fspath(error.filename)})" if isinstance(error.filename, (str, os.PathLike)) else ""
                return json_reply(500, {"error": f"not saved: {(error.strerror or str(error)).lower()}{where}"})
            return super().refusal(error)

        def _page_or_picture(self) -> Reply:
            address = urlsplit(self.path)
            query = parse_qs(address.query, max_num_fields=8)
            self.require_access(query.get("token", [""])[0])
            if address.path == "/":
                return _page(self.token)
            if address.path not in ("/photo.jpg", "/terrain.png"):
                raise Refused(404, "no such page")
            with lock:
                image = session.image if address.path == "/photo.jpg" else session.relief
            suffix = address.path[-4:]
            encoded = cv2.imencode(suffix, image[..., ::-1])[1].tobytes()
            return Reply(200, "image/jpeg" if suffix == ".jpg" else "image/png", encoded)

        def _action(self) -> Reply:
            self.require_access(self.headers.get("X-Token", ""))
            action = actions.get(urlsplit(self.path).path)
            if action is None:
                raise Refused(404, "no such action")
            body = self._body()
            with lock:
                return json_reply(200, action(body))

        def _body(self) -> _Json:
            """The JSON object of a request; its length is stated and bounded."""
            stated: Sequence[str] = self.headers.get_all("Content-Length", [])
            if "Transfer-Encoding" in self.headers or len(stated) > 1:
                raise Refused(400, "the length of the request is not stated once")
            length = stated[0] if stated else "0"
            if not re.fullmatch(r"[0-9]{1,18}", length):
                raise Refused(400, "the length of the request is no number")
            if int(length) > _MOST_BODY_BYTES:
                raise Refused(413, f"the request is longer than {_MOST_BODY_BYTES:,} bytes")
            content = self.rfile.read(int(length))
            if len(content) < int(length):
                raise Refused(400, "the request ends before its stated length")
            table = parse_json(content or b"{}", where="request")
            if not isinstance(table, dict):
                raise Refused(400, "not a request of this page: not a JSON object")
            return table

    return Handler


def _page(token: str) -> Reply:
    """The page; only its own script and style may run, marked by a number that is new each time."""
    nonce = secrets.token_urlsafe(16)
    page = Path(__file__).with_name("annotation.html").read_text(encoding="utf-8")
    policy = (
        f"default-src 'none'; script-src 'nonce-{nonce}'; style-src 'nonce-{nonce}'; img-src 'self'; connect-src 'self'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )
    text = page.replace("@TOKEN@", token).replace("@NONCE@", nonce)
    return Reply(200, "text/html; charset=utf-8", text.encode(), policy)
