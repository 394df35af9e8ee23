"""A STAC API and file server on loopback, run as a process of its own: ``python stac_server.py FOLDER``.

FOLDER holds ``items/COLLECTION/*.json``, ``files/**`` and ``faults.json``. It answers POST searches in pages of two items,
Range requests with entity tags, and fails as ``faults.json`` says: a list of [part of the path, what, how many times],
what being a status, ``cut`` (half of the body) or ``whole`` (no Range). Each request is a line of ``requests.log``. The
port is written to ``port``. Items' addresses begin with ``{base}``.

``/`` is a catalogue like Earth Search. ``/swisstopo/`` is one like data.geo.admin.ch: its landing page does not say that it
can be searched, pages hold at most 100 items, and a next page is named by what has to be added to the question (published
code of geoadmin/service-stac: ``models/general.py``, ``pagination.py``).
"""

from __future__ import annotations

import hashlib
import json
import sys
from datetime import datetime
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Lock

FOLDER = Path(sys.argv[1]) if len(sys.argv) > 1 else Path()
PAGE = 2
SWISS = "/swisstopo/"
LOCK = Lock()


def fault(path: str) -> str | int | None:
    with LOCK:
        file = FOLDER / "faults.json"
        faults = json.loads(file.read_text()) if file.exists() else []
        for each in faults:
            if each[0] in path and each[2] > 0:
                each[2] -= 1
                file.write_text(json.dumps(faults))
                return each[1]
    return None


def overlaps(a: list[float], b: list[float]) -> bool:
    wide = a[0] > a[2]  # an item across the antimeridian
    east_west = (b[2] >= a[0] or b[0] <= a[2]) if wide else (b[0] <= a[2] and b[2] >= a[0])
    return east_west and b[1] <= a[3] and b[3] >= a[1]


def matches(item: dict, question: dict) -> bool:
    if not overlaps(item["bbox"], question["bbox"]):
        return False
    if question.get("datetime"):
        first, last = map(datetime.fromisoformat, question["datetime"].split("/"))
        if not first <= datetime.fromisoformat(item["properties"]["datetime"]) <= last:
            return False
    for key, test in (question.get("query") or {}).items():
        if "lte" in test and item["properties"].get(key, 0.0) > test["lte"]:
            return False
    return True


class Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def log_message(self, *_: object) -> None:
        pass

    @property
    def base(self) -> str:
        return f"http://127.0.0.1:{self.server.server_address[1]}"

    def reply(self, status: int, body: bytes, headers: dict[str, str] | None = None, *, cut: bool = False) -> None:
        self.send_response(status)
        for key, value in (headers or {"Content-Type": "application/json"}).items():
            self.send_header(key, value)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        if cut:
            self.wfile.write(body[: len(body) // 2])
            self.wfile.flush()
            self.connection.close()
            self.close_connection = True
        else:
            self.wfile.write(body)

    def logged(self) -> str | int | None:
        with LOCK, open(FOLDER / "requests.log", "a") as file:
            file.write(f"{self.command} {self.path} {self.headers.get('Range', '')}\n")
        return fault(self.path)

    def do_GET(self) -> None:
        failing = self.logged()
        if isinstance(failing, int):
            return self.reply(failing, b"busy")
        if self.path in ("/", SWISS):
            return self.reply(200, json.dumps(self.landing()).encode(), cut=failing == "cut")
        file = FOLDER / self.path.split("?")[0].lstrip("/")
        if not self.path.startswith("/files/") or not file.is_file():
            return self.reply(404, b"no such file")
        content = file.read_bytes()
        headers = {"ETag": f'"{hashlib.md5(content).hexdigest()}"', "Accept-Ranges": "bytes"}
        wanted = self.headers.get("Range")
        if wanted is None or failing == "whole":
            return self.reply(200, content, headers, cut=failing == "cut")
        first, last = wanted.removeprefix("bytes=").split("-")
        part = content[int(first) : int(last) + 1]
        headers["Content-Range"] = f"bytes {first}-{int(first) + len(part) - 1}/{len(content)}"
        return self.reply(206, part, headers, cut=failing == "cut")

    def landing(self) -> dict:
        base = self.base + self.path
        conforms = ["https://api.stacspec.org/v1.0.0/core"]
        if self.path == SWISS:
            conforms += [
                f"http://www.opengis.net/spec/ogcapi-features-1/1.0/conf/{part}"
                for part in ("core", "oas30", "geojson")
            ]
        else:
            conforms += [f"https://api.stacspec.org/v1.0.0/item-search{part}" for part in ("", "#query")]
        search = {"rel": "search", "href": base + "search", "type": "application/geo+json", "method": "POST"}
        return {
            "type": "Catalog",
            "stac_version": "1.0.0",
            "id": "local",
            "description": "made by a test",
            "conformsTo": conforms,
            "links": [{"rel": "self", "href": base}, {"rel": "root", "href": base}, search],
        }

    def do_POST(self) -> None:
        question = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        failing = self.logged()
        if isinstance(failing, int):
            return self.reply(failing, b"busy")
        found = []
        for collection in question["collections"]:
            for path in sorted((FOLDER / "items" / collection).glob("*.json")):
                item = json.loads(path.read_text().replace("{base}", self.base))
                if matches(item, question):
                    found.append(item)
        swiss = self.path.startswith(SWISS)
        if swiss and int(question["limit"]) > 100:
            return self.reply(400, b'{"code": 400, "description": ["limit query parameter too big"]}')
        start = int(question.get("token") or question.get("cursor") or 0)
        page = {"type": "FeatureCollection", "features": found[start : start + PAGE], "links": []}
        if start + PAGE < len(found):
            more = {"rel": "next", "href": self.base + self.path, "method": "POST"}
            if swiss:
                more |= {"merge": True, "body": {"limit": "100", "cursor": str(start + PAGE)}}
            else:
                more |= {"body": question | {"token": str(start + PAGE)}}
            page["links"] = [more]
        return self.reply(200, json.dumps(page).encode(), cut=failing == "cut")


if __name__ == "__main__":
    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    (FOLDER / "port.part").write_text(str(server.server_address[1]))
    (FOLDER / "port.part").rename(FOLDER / "port")
    server.serve_forever()
