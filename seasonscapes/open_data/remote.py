"""Files of other machines: ranges of bytes over HTTP, kept on disk, so that nothing is loaded twice.

A raster on a server is read through a file object whose blocks are loaded when GDAL asks for them and stored beside a
checksum each; what an interrupted run has loaded is there for the next one. GDAL itself never uses the network.
"""

from __future__ import annotations

import hashlib
import io
import json
import logging
import time
import zlib
from collections.abc import Callable
from dataclasses import asdict, dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar
from urllib.parse import urlsplit

import numpy as np

from seasonscapes import __version__
from seasonscapes.errors import InputError
from seasonscapes.images import atomic_path

if TYPE_CHECKING:
    from rasterio.io import DatasetReader
    from requests import Response, Session

log = logging.getLogger(__name__)
Value = TypeVar("Value")

BLOCK_BYTES = 65536
TRIES = 5
TIMEOUT_S = (10.0, 60.0)
# Before the second try, twice as long before each further one.
FIRST_WAIT_S = 0.5
# Servers are asked again whether a file of theirs has changed after so many days, a catalogue for new items after one.
FILE_DAYS, SEARCH_DAYS = 30.0, 1.0
_BUSY = (429, 500, 502, 503, 504)
_LONGEST_WAIT_S = 20.0
# A server without ranges sends a whole file; more than this is not loaded for a window of it.
_LARGEST_WHOLE_BYTES = 256 * 2**20
# Code and length of SHA-256 at the start of a multihash.
_SHA256 = "1220"
_GDAL: dict[str, Any] = {"GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR", "GDAL_PAM_ENABLED": "NO"}


class MissingFile(InputError):
    """A server does not have the file that a catalogue names."""


class FileChanged(Exception):
    """A file is another one than the part of it that was loaded before."""


@dataclass(frozen=True)
class FileState:
    """What is known of a remote file.

    Parameters
    ----------
    url
        Address.
    tag
        Entity tag, or what stands for it.
    size
        Bytes.
    asked
        When the server was last asked, ISO 8601 in UTC.
    """

    url: str
    tag: str
    size: int
    asked: str


def short_hash(text: str) -> str:
    """16 hexadecimal digits that stand for a text."""
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def is_older(asked: str, days: float) -> bool:
    """Whether an ISO 8601 time lies more than so many days in the past."""
    return datetime.now(UTC) - datetime.fromisoformat(asked) > timedelta(days=days)


class RemoteStore:
    """Loads files of other machines into a folder and reads them from there.

    Parameters
    ----------
    folder
        Cache; created when needed.
    offline
        Use what the folder holds, and nothing else.

    Attributes
    ----------
    loaded_bytes
        Bytes received so far.
    requests
        Requests sent so far.
    """

    def __init__(self, folder: Path, *, offline: bool = False):
        self.folder, self.offline = folder, offline
        self.loaded_bytes = self.requests = 0
        self._session: Session | None = None
        self._tokens: dict[str, str] = {}

    def read(self, url: str, read: Callable[[DatasetReader], Value], *, token_url: str | None = None) -> Value:
        """Open a remote GeoTIFF and apply a function to it; only the bytes that it needs are loaded.

        Parameters
        ----------
        url
            ``http://`` or ``https://`` address.
        read
            Called with the open dataset.
        token_url
            Address of a token to add to the file's address; see `Source.token_url`.

        Raises
        ------
        InputError
            One line: the file does not exist, is damaged, the server does not answer; offline, it was not loaded before.
        """
        for _ in range(2):
            try:
                return self._read_once(url, read, token_url)
            except FileChanged:
                log.info("%s: changed since it was loaded; loading it again", url)
        raise InputError(url, "changes while it is being loaded", cure="try again later")

    def _read_once(self, url: str, read: Callable[[DatasetReader], Value], token_url: str | None) -> Value:
        import rasterio
        from rasterio.errors import RasterioError

        remote = RemoteFile(self, url, token_url)
        name = f"remote/{short_hash(url)}.tif"

        def opener(path: str, *_: Any, **__: Any) -> RemoteFile:
            # GDAL also looks for .aux.xml, .ovr and .msk beside the file.
            if not path.endswith(name):
                raise FileNotFoundError(path)
            return remote

        try:
            with rasterio.Env(**_GDAL), rasterio.open(name, driver="GTiff", opener=opener, sharing=False) as dataset:
                return read(dataset)
        except RasterioError as error:
            if remote.problem is not None:
                raise remote.problem from None
            raise InputError(
                url,
                f"damaged, cut short or no GeoTIFF ({error})",
                cure="leave it out with another --date or source, or report it to the catalogue",
            ) from None

    def state(self, url: str, token_url: str | None = None) -> FileState:
        """Size and tag of a file: those on disk, or the server's where they are old or none."""
        known = self.known_state(url)
        if known is not None and (self.offline or not is_older(known.asked, FILE_DAYS)):
            return known
        if self.offline:
            raise InputError(url, "not loaded before", cure="leave out --offline once")
        state, content = self._first_block(url, token_url)
        with atomic_path(self._folder(url) / "state.json") as path:
            path.write_text(json.dumps(asdict(state)))
        if known is None or known.tag != state.tag:
            blocks = BlockFile(self._folder(url), state)
            blocks.write(0, content)
        return state

    def known_state(self, url: str) -> FileState | None:
        """What an earlier request has told of a file; ``None`` where there was none."""
        path = self._folder(url) / "state.json"
        try:
            return FileState(**json.loads(path.read_text()))
        except FileNotFoundError:
            return None
        except (OSError, ValueError, TypeError):
            log.info("%s: unreadable, loaded again", path)
            return None

    def verify(self, url: str, multihash: str | None) -> bool:
        """Compare a file that is wholly on disk with the checksum that its catalogue states.

        Parameters
        ----------
        url
            Its address.
        multihash
            Hexadecimal multihash; kinds other than SHA-256 are not compared.

        Returns
        -------
        bool
            Whether it was compared: only a part of most files is loaded.

        Raises
        ------
        InputError
            The file is another one.
        """
        state = self.known_state(url)
        if state is None or multihash is None or not multihash.lower().startswith(_SHA256):
            return False
        blocks = self.blocks(state)
        if blocks.share < 1.0:
            return False
        if hashlib.sha256(blocks.read(0, state.size)).hexdigest() != multihash.lower().removeprefix(_SHA256):
            self.forget(url)
            raise InputError(url, "not the file whose checksum the catalogue states", cure="report it to the catalogue")
        return True

    def forget(self, url: str) -> None:
        """Ask the server again about a file."""
        (self._folder(url) / "state.json").unlink(missing_ok=True)

    def blocks(self, state: FileState) -> BlockFile:
        """The part of a file that is on disk."""
        return BlockFile(self._folder(state.url), state)

    def range(self, state: FileState, start: int, stop: int, token_url: str | None = None) -> bytes:
        """Load bytes ``start`` to ``stop`` of a file.

        Raises
        ------
        InputError
            As in `read`.
        FileChanged
            The server has another file than ``state`` tells.
        """
        if self.offline:
            raise InputError(state.url, "not all of what is needed was loaded before", cure="leave out --offline once")
        headers = {"Range": f"bytes={start}-{stop - 1}"}
        response = self.get(state.url, headers=headers, token_url=token_url)
        _, _, size = _content_range(response)
        if response.status_code != 206 or _tag(response, size) != state.tag or size != state.size:
            self.forget(state.url)
            raise FileChanged
        if len(response.content) != stop - start:
            raise InputError(state.url, "the server sends another part than was asked for", cure="try again later")
        return response.content

    def _first_block(self, url: str, token_url: str | None) -> tuple[FileState, bytes]:
        response = self.get(url, headers={"Range": f"bytes=0-{BLOCK_BYTES - 1}"}, token_url=token_url)
        if response.status_code == 206:
            _, _, size = _content_range(response)
        else:
            size = len(response.content)  # a server without ranges: the whole file
        if size <= 0:
            raise InputError(url, "the server does not tell the file's size", cure="report it to the catalogue")
        now = datetime.now(UTC).isoformat(timespec="seconds")
        return FileState(url, _tag(response, size), size, now), response.content

    def get(self, url: str, *, headers: dict[str, str] | None = None, token_url: str | None = None) -> Response:
        """GET with patience: busy servers and broken connections are asked `TRIES` times.

        Raises
        ------
        InputError
            One line: which server, what it answered, the cure.
        """
        host = urlsplit(url).netloc
        if self.offline:
            raise InputError(url, "not loaded before", cure="leave out --offline once")
        address = url if token_url is None else f"{url}{'&' if '?' in url else '?'}{self._token(token_url)}"
        headers = {"Accept-Encoding": "identity"} | (headers or {})
        problem, wait_s = "", 0.0
        for attempt in range(TRIES):
            if attempt:
                log.info("%s: %s; trying again", host, problem)
                time.sleep(min(max(wait_s, FIRST_WAIT_S * 2.0 ** (attempt - 1)), _LONGEST_WAIT_S))
            response, problem = self._get_once(address, headers)
            if response is None:
                continue
            if response.status_code in _BUSY:
                problem = f"the server answers {response.status_code} {response.reason}"
                wait_s = _seconds(response.headers.get("Retry-After"))
                continue
            told = f"the server answers {response.status_code} {response.reason}"
            if response.status_code in (403, 404, 410):
                # Buckets that do not list their files answer 403 for those that are not there.
                cure = "the catalogue names a file that is not there; choose another --date or source"
                raise MissingFile(url, told, cure=cure)
            if response.status_code >= 400:
                raise InputError(url, told, cure="choose another source")
            return response
        raise InputError(
            url, f"{problem}, {TRIES} times", cure="run the same command again later: what is loaded is kept"
        )

    def _get_once(self, address: str, headers: dict[str, str]) -> tuple[Response | None, str]:
        """One request: the response with its content, or what went wrong."""
        import requests

        self.requests += 1
        try:
            with self.session().get(address, headers=headers, timeout=TIMEOUT_S, stream=True) as response:
                if int(response.headers.get("Content-Length") or 0) > _LARGEST_WHOLE_BYTES:
                    raise InputError(
                        urlsplit(address)._replace(query="").geturl(),
                        "the server sends whole files only, and this one is too large",
                        got=f"{int(response.headers['Content-Length']) / 1e6:.0f} MB",
                        cure="choose another source",
                    )
                self.loaded_bytes += len(response.content)  # reads it: a cut connection is noticed here
                return response, ""
        except requests.exceptions.Timeout:
            return None, "no answer in time"
        except (requests.exceptions.ConnectionError, requests.exceptions.ChunkedEncodingError) as error:
            return None, f"no connection, or it broke ({type(error).__name__})"
        except requests.exceptions.RequestException as error:
            raise InputError(address, f"cannot be asked: {error}", cure="check the address") from None

    def session(self) -> Session:
        """The HTTP session that keeps connections open."""
        from requests import Session

        if self._session is None:
            self._session = Session()
            self._session.headers["User-Agent"] = f"seasonscapes/{__version__}"
        return self._session

    def _token(self, token_url: str) -> str:
        if token_url not in self._tokens:
            try:
                self._tokens[token_url] = str(json.loads(self.get(token_url).content)["token"])
            except (ValueError, KeyError, TypeError):
                raise InputError(token_url, "gives no token", cure="choose another source") from None
        return self._tokens[token_url]

    def _folder(self, url: str) -> Path:
        return self.folder / "files" / short_hash(url)


def _content_range(response: Response) -> tuple[int, int, int]:
    """First byte, last byte and size of the whole file; zeros where the server does not say."""
    unit, _, rest = response.headers.get("Content-Range", "").partition(" ")
    span, _, size = rest.partition("/")
    first, _, last = span.partition("-")
    if unit != "bytes" or not (first.isdigit() and last.isdigit() and size.isdigit()):
        return 0, 0, 0
    return int(first), int(last), int(size)


def _tag(response: Response, size: int) -> str:
    return response.headers.get("ETag") or f"{response.headers.get('Last-Modified', '')}/{size}"


def _seconds(text: str | None) -> float:
    return float(text) if text is not None and text.strip().isdigit() else 0.0


class BlockFile:
    """The blocks of a remote file that are on disk, each with a checksum.

    Parameters
    ----------
    folder
        Folder of the file.
    state
        Which file; another tag is another file on disk.
    """

    def __init__(self, folder: Path, state: FileState):
        name = short_hash(state.tag)
        self.path, self.index_path = folder / f"{name}.blocks", folder / f"{name}.index.npy"
        self.size, self.count = state.size, -(-state.size // BLOCK_BYTES)
        self.index = self._read_index()

    def _read_index(self) -> np.ndarray:
        """Checksum of each block, −1 where it is missing."""
        try:
            index = np.load(self.index_path, allow_pickle=False)
            if index.shape == (self.count,) and index.dtype == np.int64:
                return index
        except FileNotFoundError:
            pass
        except (OSError, ValueError, EOFError):
            log.info("%s: unreadable, loaded again", self.index_path)
        return np.full(self.count, -1, np.int64)

    def missing(self, start: int, stop: int) -> list[tuple[int, int]]:
        """Runs of blocks ``[first, last)`` within the bytes ``start`` to ``stop`` that are not on disk."""
        first, last = start // BLOCK_BYTES, -(-stop // BLOCK_BYTES)
        absent = np.flatnonzero(self.index[first:last] < 0) + first
        if not len(absent):
            return []
        runs = np.split(absent, np.flatnonzero(np.diff(absent) > 1) + 1)
        return [(int(run[0]), int(run[-1]) + 1) for run in runs]

    def write(self, first: int, content: bytes) -> None:
        """Keep consecutive blocks from number ``first`` on."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with open(self.path, "r+b" if self.path.exists() else "w+b") as file:
            file.seek(first * BLOCK_BYTES)
            file.write(content)
        for number, start in enumerate(range(0, len(content), BLOCK_BYTES)):
            self.index[first + number] = zlib.crc32(content[start : start + BLOCK_BYTES])
        with atomic_path(self.index_path) as path:
            np.save(path, self.index)

    def read(self, start: int, stop: int) -> bytes:
        """Bytes that are on disk; damaged blocks are struck off, see `missing`, and nothing is returned."""
        first, last = start // BLOCK_BYTES, -(-stop // BLOCK_BYTES)
        try:
            with open(self.path, "rb") as file:
                file.seek(first * BLOCK_BYTES)
                content = file.read((last - first) * BLOCK_BYTES)
        except FileNotFoundError:
            content = b""
        for number in range(first, last):
            at = (number - first) * BLOCK_BYTES
            if zlib.crc32(content[at : at + BLOCK_BYTES]) != self.index[number]:
                self.index[number] = -1
        if (self.index[first:last] < 0).any():
            return b""
        return content[start - first * BLOCK_BYTES : stop - first * BLOCK_BYTES]

    @property
    def share(self) -> float:
        """Share of the file that is on disk."""
        return float((self.index >= 0).mean())


class RemoteFile(io.RawIOBase):
    """A file of a server as a file object: what is read is loaded block by block and kept.

    GDAL cannot pass an exception on: it is kept in ``problem``, and the read returns nothing.

    Parameters
    ----------
    store
        Where it is kept.
    url, token_url
        As in `RemoteStore.read`.
    """

    def __init__(self, store: RemoteStore, url: str, token_url: str | None = None):
        self._store, self._token_url = store, token_url
        self._state = store.state(url, token_url)
        self._blocks = store.blocks(self._state)
        self._position = 0
        self.problem: Exception | None = None

    def readable(self) -> bool:
        """True."""
        return True

    def seekable(self) -> bool:
        """True."""
        return True

    def close(self) -> None:
        """Nothing: GDAL opens and closes the file several times."""

    def tell(self) -> int:
        """Position of the next read."""
        return self._position

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Set the position of the next read."""
        base = {io.SEEK_SET: 0, io.SEEK_CUR: self._position, io.SEEK_END: self._state.size}[whence]
        self._position = base + offset
        return self._position

    def read(self, size: int = -1) -> bytes:
        """Read from the present position; loads what is not on disk."""
        start = min(self._position, self._state.size)
        stop = self._state.size if size < 0 else min(start + size, self._state.size)
        if self.problem is not None or stop <= start:
            return b""
        try:
            content = self._load(start, stop)
        except (InputError, FileChanged, OSError) as problem:
            self.problem = problem
            return b""
        self._position = stop
        return content

    def _load(self, start: int, stop: int) -> bytes:
        for _ in range(2):  # once more where a block on disk is damaged
            for first, last in self._blocks.missing(start, stop):
                span = first * BLOCK_BYTES, min(last * BLOCK_BYTES, self._state.size)
                self._blocks.write(first, self._store.range(self._state, *span, self._token_url))
            if content := self._blocks.read(start, stop):
                return content
        raise OSError(f"{self._blocks.path}: blocks on disk cannot be read back")
