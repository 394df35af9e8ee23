"""The page of a place in a browser as files: one binary of arrays, pictures of the albedo, a description, the program.

The program (``seasonscapes/viewer_page/viewer.js``) is built from ``viewer/`` and needs neither a server of its own nor
anything from elsewhere: addresses are relative, and the page's Content-Security-Policy permits its own files alone.
"""

from __future__ import annotations

import base64
import hashlib
import io
import json
import struct
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np

from seasonscapes.images import linear_from_srgb, srgb8_from_linear

PAGE = Path(__file__).parents[1] / "viewer_page"
PROGRAM, STYLE, NOTICES = "viewer.js", "viewer.css", "NOTICES.txt"
GAUSSIANS = "gaussians.bin"
_FORMAT = 1
_KINDS = {"uint8": "u8", "uint16": "u16", "float16": "f16", "float32": "f32", "int32": "i32", "float64": "f64"}
_TILE_ARRAYS = ("keys", "heights", "low_m", "scale_m")
_QUALITY = 82


@dataclass(frozen=True)
class AlbedoPicture:
    """The albedo of a date, seen from above.

    Parameters
    ----------
    day
        The date.
    content
        A WebP picture of the sRGB-encoded albedo; row 0 is the northern edge of the grid.
    size_px
        Rows and columns.
    gain_rgb
        What the decoded linear values are multiplied with: the coder's levels of luma shift the mean by up to 2 %.
    """

    day: date
    content: bytes
    size_px: tuple[int, int]
    gain_rgb: tuple[float, float, float]


@dataclass(frozen=True)
class HeightTiles:
    """T tiles of heights that are finer than the page's grid.

    Parameters
    ----------
    cells
        Cells along a side of a tile.
    keys
        ``(T, 3)`` int32: level L (the grid's step over 2^L), column and row of tiles from the south-west.
    heights
        ``(T, cells + 3, cells + 3)`` uint16, row 0 in the south, one node more on each side than the tile.
    low_m, scale_m
        ``(T,)``: a height is low + stored · scale [m].
    """

    cells: int
    keys: np.ndarray
    heights: np.ndarray
    low_m: np.ndarray
    scale_m: np.ndarray

    def files(self) -> dict[str, bytes]:
        """The tiles as files by name."""
        little = self.heights.astype("<u2", copy=False)
        return {f"tile-{level}-{c}-{r}.bin": little[k].tobytes() for k, (level, c, r) in enumerate(self.keys.tolist())}

    def about(self) -> dict[str, Any]:
        """What the page knows of the tiles before it loads one."""
        rows = zip(self.keys.tolist(), self.low_m.tolist(), self.scale_m.tolist(), strict=True)
        return {"cells": self.cells, "list": [[*key, round(low, 4), float(f"{scale:.9g}")] for key, low, scale in rows]}


@dataclass(frozen=True)
class ViewerScene:
    """Everything that the page knows of a place.

    Parameters
    ----------
    about
        Plain values: names, frame, grid, cameras, sky.
    arrays
        Arrays by name; uint8, uint16, float16 or float32, which the page reads.
    albedo
        Pictures of the albedo by date.
    gaussians
        Facts and arrays of a distilled model, which the page reads when it is asked for.
    tiles
        Finer heights, which the page reads near its viewer; single files have none.
    """

    about: dict[str, Any]
    arrays: dict[str, np.ndarray]
    albedo: Sequence[AlbedoPicture]
    gaussians: tuple[dict[str, Any], dict[str, np.ndarray]] | None = None
    tiles: HeightTiles | None = None


def albedo_picture(day: date, values: np.ndarray, *, quality: int = _QUALITY) -> AlbedoPicture:
    """Encode albedo ``(R, S, 3)``, row 0 in the north, as a picture."""
    from PIL import Image

    encoded = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(srgb8_from_linear(values))).save(
        encoded, format="WEBP", quality=quality, method=4
    )
    decoded = linear_from_srgb(np.asarray(Image.open(encoded).convert("RGB")) / 255.0)
    red, green, blue = values.mean(axis=(0, 1)) / np.maximum(decoded.mean(axis=(0, 1)), 1e-6)
    return AlbedoPicture(
        day, encoded.getvalue(), (values.shape[0], values.shape[1]), (float(red), float(green), float(blue))
    )


def viewer_files(scene: ViewerScene, *, view: dict[str, Any] | None = None) -> dict[str, bytes]:
    """The files of a static folder by name.

    Parameters
    ----------
    scene
        The place.
    view
        What the page shows at first: ``camera`` and ``time``.
    """
    description, binary, pictures = _packed(scene, view)
    style, program = f'<link rel="stylesheet" href="{STYLE}">', f'<script defer src="{PROGRAM}"></script>'
    policy = "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src 'self' data:; " + (
        "base-uri 'none'; form-action 'none'"
    )
    return {
        "index.html": _page(scene, policy, style, program, "").encode(),
        PROGRAM: (PAGE / PROGRAM).read_bytes(),
        STYLE: (PAGE / STYLE).read_bytes(),
        NOTICES: (PAGE / NOTICES).read_bytes(),
        "scene.json": description.encode(),
        "scene.bin": binary,
        **pictures,
        **(scene.tiles.files() if scene.tiles is not None else {}),
    }


def single_file(scene: ViewerScene, *, view: dict[str, Any] | None = None) -> bytes:
    """The page with all its data in one HTML file, which opens from the file system.

    Parameters
    ----------
    scene
        The place.
    view
        As in `viewer_files`.
    """
    description, binary, pictures = _packed(replace(scene, tiles=None), view)
    program = (PAGE / PROGRAM).read_text(encoding="utf-8").replace("</script", "<\\/script")
    style = (PAGE / STYLE).read_text(encoding="utf-8")
    policy = (
        f"default-src 'none'; script-src '{_digest(program)}'; style-src '{_digest(style)}'; img-src data:; "
        "base-uri 'none'; form-action 'none'"
    )
    escaped = description.replace("<", "\\u003c")
    blocks = [f'<script type="application/json" id="scene.json">{escaped}</script>']
    for name, content in {"scene.bin": binary, **pictures}.items():
        text = base64.b64encode(content).decode()
        blocks.append(f'<script type="application/octet-stream" id="{name}">{text}</script>')
    notices = (PAGE / NOTICES).read_text(encoding="utf-8").replace("--", "- -")
    blocks.append(f"<!--\n{notices}-->")
    # The program is no module here: it runs where it stands, after all that it reads.
    return _page(scene, policy, f"<style>{style}</style>", f"<script>{program}</script>", "\n".join(blocks)).encode()


def _digest(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def _page(scene: ViewerScene, policy: str, style: str, program: str, data: str) -> str:
    from html import escape

    template = (PAGE / "index.html").read_text(encoding="utf-8")
    parts = {
        "@POLICY@": escape(policy, quote=True).replace("&#x27;", "'"),
        "@TITLE@": escape(str(scene.about["title"])),
        "@ATTRIBUTION@": escape(str(scene.about["attribution"])),
        "@STYLE@": style,
        "@DATA@": data,
        "@PROGRAM@": program,
    }
    for name, text in parts.items():
        template = template.replace(name, text)
    return template


def _packed(scene: ViewerScene, view: dict[str, Any] | None) -> tuple[str, bytes, dict[str, bytes]]:
    """The description as JSON, the arrays one behind the other, and by name the pictures and the Gaussians."""
    binary, table = _binary(scene.arrays)
    pictures, dated = {}, []
    for picture in scene.albedo:
        name = f"albedo-{picture.day.isoformat()}.webp"
        pictures[name] = picture.content
        entry = {"date": picture.day.isoformat(), "file": name, "size_px": list(picture.size_px)}
        dated.append(entry | {"gain_rgb": [round(gain, 5) for gain in picture.gain_rgb]})
    description = {"format": _FORMAT, **scene.about, "arrays": table, "albedo": dated, "view": view or {}}
    if scene.gaussians is not None:
        facts, layer = scene.gaussians
        pictures[GAUSSIANS], entries = _binary(layer)
        description["gaussians"] = {**facts, "file": GAUSSIANS, "arrays": entries}
    if scene.tiles is not None:
        description["tiles"] = scene.tiles.about()
    return json.dumps(description, separators=(",", ":"), allow_nan=False), binary, pictures


def _binary(arrays: dict[str, np.ndarray]) -> tuple[bytes, dict[str, Any]]:
    """Arrays one behind the other, and where each lies."""
    binary, table = bytearray(), {}
    for name, values in arrays.items():
        binary += b"\0" * (-len(binary) % 4)
        kind = _KINDS[values.dtype.name]
        table[name] = {"offset": len(binary), "shape": list(values.shape), "type": kind}
        binary += np.ascontiguousarray(values).astype(values.dtype.newbyteorder("<"), copy=False).tobytes()
    return bytes(binary), table


def save_scene(scene: ViewerScene, path: Path) -> None:
    """Write a scene without its Gaussians to one file."""
    arrays = dict(scene.arrays)
    if scene.tiles is not None:
        arrays |= {f"tiles.{name}": getattr(scene.tiles, name) for name in _TILE_ARRAYS}
    description, binary, pictures = _packed(replace(scene, arrays=arrays, gaussians=None, tiles=None), None)
    names = list(pictures)
    head = json.dumps([description, len(binary), [[name, len(pictures[name])] for name in names]]).encode()
    path.write_bytes(struct.pack("<Q", len(head)) + head + binary + b"".join(pictures[name] for name in names))


def load_scene(path: Path) -> ViewerScene:
    """Read a scene of `save_scene`."""
    content = path.read_bytes()
    (length,) = struct.unpack_from("<Q", content)
    text, size, sizes = json.loads(content[8 : 8 + length])
    about, start = json.loads(text), 8 + length
    kinds = {short: name for name, short in _KINDS.items()}
    arrays = {}
    for name, entry in about.pop("arrays").items():
        count = int(np.prod(entry["shape"]))
        values = np.frombuffer(
            content, np.dtype(kinds[entry["type"]]).newbyteorder("<"), count, start + entry["offset"]
        )
        arrays[name] = values.reshape(entry["shape"])
    start += size
    albedo = []
    for dated, (_, bytes_) in zip(about.pop("albedo"), sizes, strict=True):
        day, shape = date.fromisoformat(dated["date"]), dated["size_px"]
        picture = AlbedoPicture(day, content[start : start + bytes_], (shape[0], shape[1]), tuple(dated["gain_rgb"]))
        albedo.append(picture)
        start += bytes_
    del about["format"], about["view"]
    tiles = {name: arrays.pop(f"tiles.{name}") for name in _TILE_ARRAYS if f"tiles.{name}" in arrays}
    kept = HeightTiles(tiles["heights"].shape[1] - 3, **tiles) if tiles else None
    return ViewerScene(about, arrays, albedo, tiles=kept)
