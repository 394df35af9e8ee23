"""glTF 2.0 documents: arrays and images collected into one ``.glb``, or a ``.gltf`` with its files beside it."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from seasonscapes.images import atomic_path

_COMPONENT = {"float32": 5126, "uint32": 5125, "uint16": 5123}
_TYPE = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
_VERTICES, _INDICES = 34962, 34963
_SUFFIX = {"image/png": ".png", "image/jpeg": ".jpg"}


@dataclass
class GltfFile:
    """A glTF document while it is put together.

    Parameters
    ----------
    about
        Plain values for ``asset.extras``; ``attribution`` among them also becomes ``asset.copyright``.
    table
        The document's other top-level properties; the methods append to its lists.
    """

    about: Mapping[str, Any]
    table: dict[str, Any] = field(default_factory=dict)
    _arrays: list[np.ndarray] = field(default_factory=list)
    _images: list[tuple[str, bytes, str]] = field(default_factory=list)

    def add(self, kind: str, value: dict[str, Any]) -> int:
        """Append to one of the document's lists, such as ``materials``, and return the index."""
        values = self.table.setdefault(kind, [])
        values.append(value)
        return len(values) - 1

    def use(self, extension: str) -> None:
        """Declare an extension that the document uses and readers may ignore."""
        self.table["extensionsUsed"] = sorted({*self.table.get("extensionsUsed", []), extension})

    def add_array(self, values: np.ndarray, *, bounds: bool = False) -> int:
        """Append an accessor of float32 vertex attributes ``(N,)`` or ``(N, C)``; see `add_faces` for indices.

        Parameters
        ----------
        values
            Converted to float32.
        bounds
            Also state the smallest and largest value of each component, as positions must.
        """
        values = np.ascontiguousarray(values, np.float32)
        accessor = self._accessor(values, _TYPE[1 if values.ndim == 1 else values.shape[1]], len(values), _VERTICES)
        if bounds:
            accessor |= {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
        return self.add("accessors", accessor)

    def add_faces(self, faces: np.ndarray) -> int:
        """Append an accessor of the vertex indices of triangles ``(F, 3)``."""
        # The largest value of a component type restarts primitives and is not allowed.
        kind = np.uint16 if faces.max(initial=0) < np.iinfo(np.uint16).max else np.uint32
        return self.add("accessors", self._accessor(np.ascontiguousarray(faces, kind), "SCALAR", faces.size, _INDICES))

    def _accessor(self, values: np.ndarray, kind: str, count: int, target: int) -> dict[str, Any]:
        self._arrays.append(values)
        view = {"buffer": 0, "byteLength": values.nbytes, "target": target}
        component = _COMPONENT[values.dtype.name]
        return {"bufferView": self.add("bufferViews", view), "componentType": component, "count": count, "type": kind}

    def add_image(self, name: str, encoded: bytes, mime: str) -> int:
        """Append an encoded image (``image/png`` or ``image/jpeg``) with a sampler, and return its texture's index."""
        self._images.append((name, encoded, mime))
        # Linear with mipmaps; clamped, since textures do not repeat.
        sampler = self.add("samplers", {"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071})
        return self.add("textures", {"source": len(self._images) - 1, "sampler": sampler})

    def write_glb(self, path: Path) -> None:
        """Write one binary file, atomically."""
        table = self._document()
        parts, images = list(self._arrays), []
        views = [dict(view) for view in table.get("bufferViews", [])]
        for name, encoded, mime in self._images:
            images.append({"name": name, "mimeType": mime, "bufferView": len(views)})
            views.append({"buffer": 0, "byteLength": len(encoded)})
            parts.append(np.frombuffer(encoded, np.uint8))
        body = _packed(parts, views)
        table |= {"bufferViews": views, "buffers": [{"byteLength": len(body)}]}
        if images:
            table["images"] = images
        text = json.dumps(table, separators=(",", ":"), default=float).encode()
        text += b" " * (-len(text) % 4)
        with atomic_path(path) as temporary, open(temporary, "wb") as file:
            file.write(struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(body)))
            file.write(struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(body), b"BIN\0") + body)

    def write_gltf(self, path: Path) -> list[Path]:
        """Write a text file with a ``.bin`` and images beside it, which share its stem; the text last, atomically."""
        table = self._document()
        views = [dict(view) for view in table.get("bufferViews", [])]
        body = _packed(self._arrays, views)
        files = {path.with_suffix(".bin"): body}
        images = []
        for name, encoded, mime in self._images:
            image = path.with_name(f"{path.stem}.{name}{_SUFFIX[mime]}")
            files[image] = encoded
            images.append({"name": name, "mimeType": mime, "uri": _uri(image.name)})
        table |= {"bufferViews": views, "buffers": [{"byteLength": len(body), "uri": _uri(path.stem + ".bin")}]}
        if images:
            table["images"] = images
        for beside, content in files.items():
            with atomic_path(beside) as temporary:
                temporary.write_bytes(content)
        with atomic_path(path) as temporary:
            temporary.write_text(json.dumps(table, indent=1, default=float) + "\n")
        return [path, *files]

    def _document(self) -> dict[str, Any]:
        from seasonscapes import __version__

        asset: dict[str, Any] = {"version": "2.0", "generator": f"seasonscapes {__version__}"}
        if self.about.get("attribution"):
            asset["copyright"] = self.about["attribution"]
        if self.about:
            asset["extras"] = dict(self.about)
        return {"asset": asset, **self.table}


def _packed(parts: list[np.ndarray], views: list[dict[str, Any]]) -> bytes:
    """The parts one after another, each beginning at a multiple of four bytes, which the views are told."""
    body = bytearray()
    for part, view in zip(parts, views, strict=True):
        view["byteOffset"] = len(body)
        body += part.tobytes()
        body += b"\0" * (-len(body) % 4)
    return bytes(body)


def _uri(name: str) -> str:
    from urllib.parse import quote

    return quote(name)


def read_gltf_table(path: Path) -> dict[str, Any]:
    """Read the JSON of a ``.glb`` or ``.gltf`` file.

    Raises
    ------
    ValueError
        Where it is none, or cut short.
    """
    content = path.read_bytes()
    if path.suffix.lower() == ".gltf":
        table = json.loads(content)
    else:
        if len(content) < 20 or content[:4] != b"glTF" or content[16:20] != b"JSON":
            raise ValueError("not a binary glTF file")
        length = int.from_bytes(content[12:16], "little")
        if int.from_bytes(content[8:12], "little") != len(content):
            raise ValueError("the file is cut short")
        table = json.loads(content[20 : 20 + length])
    if not isinstance(table, dict) or "asset" not in table:
        raise ValueError("not a glTF document")
    return table
