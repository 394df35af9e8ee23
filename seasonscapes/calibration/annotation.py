"""Picking matches by hand: photograph left, rendered terrain right, on a local web page.

The work is done here, in plain functions on a session; the page only shows it. The server answers on 127.0.0.1 alone,
and only to those who know the token of the address it prints: other pages in the same browser do not.
"""

from __future__ import annotations

import json
import secrets
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import parse_qs, urlparse

import cv2
import numpy as np

from seasonscapes.calibration.calibration_file import write_calibration
from seasonscapes.calibration.evidence import Correspondences, Priors, write_points
from seasonscapes.calibration.pose_model import View, project_values, values_of
from seasonscapes.calibration.resection import Calibration, report_lines, resect
from seasonscapes.calibration.terrain_view import TerrainView, scaled_view, shaded_relief
from seasonscapes.frames import LocalFrame, geodetic_from_enu, local_axes

_LARGEST_REQUEST = 10_000


@dataclass
class AnnotationSession:
    """One webcam being matched; the only mutable thing here.

    Parameters
    ----------
    webcam
        Its id, for the saved files.
    image
        Photograph ``(H, W, 3)`` uint8 sRGB.
    start
        Where it is thought to be.
    frame
        The scene's frame.
    look
        What a view sees of the terrain: `terrain_view.look_at_rasters`, or `look_with` a renderer, made ready.
    folder
        Where ``<webcam>_points.csv`` and ``<webcam>_calibration.json`` are saved.
    """

    webcam: str
    image: np.ndarray
    start: View
    frame: LocalFrame
    look: Callable[[View], TerrainView]
    folder: Path
    priors: Priors = field(default_factory=Priors)
    k1: float = 0.0
    width_px: int = 1400
    pixel: list = field(default_factory=list)
    position_m: list = field(default_factory=list)
    terrain_pixel: list = field(default_factory=list)
    solution: Calibration | None = None
    version: int = 0
    shown: View = field(init=False)
    seen: TerrainView = field(init=False)
    relief: np.ndarray = field(init=False)

    def __post_init__(self):
        if self.image.shape[:2] != (self.start.height_px, self.start.width_px):
            raise ValueError(
                f"PickSession: the picture is {self.image.shape[1]} x {self.image.shape[0]} px, the view "
                f"{self.start.width_px} x {self.start.height_px}"
            )
        render_terrain(self)

    @property
    def view(self) -> View:
        """The best view so far."""
        return self.start if self.solution is None else self.solution.view


def render_terrain(session: AnnotationSession) -> None:
    """Look at the terrain from the best view so far; marks in it move along."""
    session.shown = scaled_view(session.view, min(session.width_px, session.view.width_px))
    session.seen = session.look(session.shown)
    session.relief = shaded_relief(session.seen)
    session.version += 1
    if session.position_m:
        axes = np.eye(3)
        pixel, _ = project_values(session.shown, axes, values_of(session.shown, axes), np.array(session.position_m))
        session.terrain_pixel = pixel.tolist()


def position_at(session: AnnotationSession, terrain_pixel) -> np.ndarray:
    """The point of the terrain ``(3,)`` behind a pixel of its picture; `ValueError` in the sky or outside.

    It is the first surface along the ray, so what a ridge hides cannot be picked.
    """
    x, y = (int(np.floor(v)) for v in terrain_pixel)
    height, width = session.seen.distance_m.shape
    if not (0 <= x < width and 0 <= y < height):
        raise ValueError("outside the terrain picture")
    position = session.seen.position_m[y, x]
    if not np.isfinite(position).all():
        raise ValueError("that is sky; pick a point on the terrain")
    return position


def describe_position(session: AnnotationSession, terrain_pixel) -> list[float] | None:
    """Where a point of the terrain picture falls in the photograph by the best view so far; ``None`` in the sky."""
    try:
        position = position_at(session, terrain_pixel)
    except ValueError:
        return None
    return _projected(session, position[None])[0]


def add_match(session: AnnotationSession, photo_pixel, terrain_pixel) -> None:
    """Add a pair."""
    x, y = (float(v) for v in photo_pixel)
    height, width = session.image.shape[:2]
    if not (0 <= x <= width and 0 <= y <= height):
        raise ValueError("outside the photograph")
    position = position_at(session, terrain_pixel)
    session.pixel.append([x, y])
    session.position_m.append(position.tolist())
    session.terrain_pixel.append([float(v) for v in terrain_pixel])


def remove_last_match(session: AnnotationSession) -> None:
    """Take the last pair back."""
    if not session.pixel:
        raise ValueError("there is no pair to take back")
    for pairs in (session.pixel, session.position_m, session.terrain_pixel):
        pairs.pop()


def matched_points(session: AnnotationSession) -> Correspondences:
    """The pairs so far."""
    return Correspondences(np.array(session.pixel).reshape(-1, 2), np.array(session.position_m).reshape(-1, 3))


def solve_session(session: AnnotationSession) -> None:
    """Calibrate from the pairs, always about the original start, and look again."""
    latitude, longitude, _ = geodetic_from_enu(session.frame, session.start.position_m)
    axes = local_axes(session.frame, float(latitude), float(longitude))
    session.solution = resect(session.start, matched_points(session), priors=session.priors, k1=session.k1, axes=axes)
    render_terrain(session)


def save_session(session: AnnotationSession) -> list[Path]:
    """Write the points, and the calibration where there is one; the files written."""
    files = [session.folder / f"{session.webcam}_points.csv"]
    write_points(files[0], matched_points(session), session.frame)
    if session.solution is not None:
        files.append(session.folder / f"{session.webcam}_calibration.json")
        write_calibration(files[1], session.webcam, session.solution, session.frame)
    return files


def _projected(session: AnnotationSession, position: np.ndarray) -> list:
    axes = np.eye(3)
    k1 = session.k1 if session.solution is None else session.solution.k1
    pixel, front = project_values(session.view, axes, values_of(session.view, axes, k1), position)
    return [p.tolist() if ok else None for p, ok in zip(pixel, front, strict=True)]


def session_state(session: AnnotationSession) -> dict:
    """The session as the page shows it."""
    projected = _projected(session, np.array(session.position_m)) if session.position_m else []
    solution = session.solution
    aside = [] if solution is None else solution.outlier.tolist()
    pairs = [
        {
            "name": str(i + 1),
            "photo": session.pixel[i],
            "terrain": session.terrain_pixel[i],
            "projected": projected[i],
            "set_aside": bool(i < len(aside) and aside[i]),
        }
        for i in range(len(session.pixel))
    ]
    summary = (
        ""
        if solution is None
        else (f"heading {solution.values[0]:.2f} ± {solution.sigma['heading_deg']:.2f}°, RMS {solution.rms_px:.1f} px")
    )
    return {
        "pairs": pairs,
        "solved": solution is not None,
        "version": session.version,
        "summary": summary,
        "report": [] if solution is None else list(report_lines(solution)),
    }


def serve_session(session: AnnotationSession, *, port: int = 0) -> tuple[ThreadingHTTPServer, str]:
    """Start the page in a thread of its own; the server (call ``shutdown``) and its address with the token."""
    token, lock = secrets.token_urlsafe(16), threading.Lock()
    server = ThreadingHTTPServer(("127.0.0.1", port), _handler(session, token, lock))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    return server, f"http://127.0.0.1:{server.server_address[1]}/?token={token}"


def _actions(session: AnnotationSession) -> dict[str, Callable[[dict], dict]]:
    def then_describe(action):
        def run(body):
            action(body)
            return session_state(session)

        return run

    return {
        "/state": lambda body: session_state(session),
        "/where": lambda body: {"photo": describe_position(session, body["terrain"])},
        "/pick": then_describe(lambda body: add_match(session, body["photo"], body["terrain"])),
        "/undo": then_describe(lambda body: remove_last_match(session)),
        "/solve": then_describe(lambda body: solve_session(session)),
        "/save": lambda body: {"files": [str(path) for path in save_session(session)]},
    }


def _handler(session: AnnotationSession, token: str, lock: threading.Lock) -> type[BaseHTTPRequestHandler]:
    actions = _actions(session)

    class Handler(BaseHTTPRequestHandler):
        def log_message(self, *args):
            pass

        def _allowed(self, given: str | None) -> bool:
            host = (self.headers.get("Host") or "").rsplit(":", 1)[0]
            if host in ("127.0.0.1", "localhost") and secrets.compare_digest(given or "", token):
                return True
            self._send(403, "application/json", json.dumps({"error": "wrong or missing token"}).encode())
            return False

        def _send(self, code: int, kind: str, body: bytes) -> None:
            self.send_response(code)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(body)))
            self.send_header("Cache-Control", "no-store")
            self.end_headers()
            self.wfile.write(body)

        def do_GET(self):
            address = urlparse(self.path)
            if not self._allowed(parse_qs(address.query).get("token", [""])[0]):
                return
            if address.path == "/":
                page = Path(__file__).with_name("annotation.html").read_text(encoding="utf-8")
                self._send(200, "text/html; charset=utf-8", page.replace("@TOKEN@", token).encode())
            elif address.path in ("/photo.jpg", "/terrain.png"):
                with lock:
                    picture = session.image if address.path == "/photo.jpg" else session.relief
                suffix = address.path[-4:]
                self._send(
                    200,
                    f"image/{'jpeg' if suffix == '.jpg' else 'png'}",
                    cv2.imencode(suffix, picture[..., ::-1])[1].tobytes(),
                )
            else:
                self._send(404, "application/json", b'{"error": "no such page"}')

        def do_POST(self):
            if not self._allowed(self.headers.get("X-Token")):
                return
            action = actions.get(urlparse(self.path).path)
            length = int(self.headers.get("Content-Length") or 0)
            if action is None or length > _LARGEST_REQUEST:
                self._send(404, "application/json", b'{"error": "no such action"}')
                return
            try:
                body = json.loads(self.rfile.read(length) or b"{}")
                with lock:
                    answer = action(body)
            except (ValueError, KeyError, TypeError) as error:
                # What the person did wrong, as a sentence on the page.
                text = str(error) if isinstance(error, ValueError) else f"not a request of this page: {error!r}"
                self._send(400, "application/json", json.dumps({"error": text}).encode())
                return
            self._send(200, "application/json", json.dumps(answer).encode())

    return Handler
