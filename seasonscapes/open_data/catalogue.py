"""STAC catalogues: which items of a collection show an area, asked once a day and kept on disk."""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from fnmatch import fnmatch
from typing import Any
from urllib.parse import urlsplit

from seasonscapes.errors import InputError
from seasonscapes.images import atomic_path
from seasonscapes.open_data import remote
from seasonscapes.open_data.remote import SEARCH_DAYS, TIMEOUT_S, TRIES, RemoteStore, is_older, short_hash
from seasonscapes.open_data.sources import Source

log = logging.getLogger(__name__)

Bounds = tuple[float, float, float, float]
# More items than any area of a single sun needs; a catalogue whose pages never end stops here.
_MOST_ITEMS = 4000
_PAGE_ITEMS = 100
# What errors of requests and urllib3 mean.
_WHY = {
    "NameResolutionError": "its name is unknown here: is there a network?",
    "NewConnectionError": "no connection",
    "ConnectionError": "no connection",
    "ConnectTimeoutError": "no answer in time",
    "ConnectTimeout": "no answer in time",
    "ReadTimeoutError": "no answer in time",
    "ReadTimeout": "no answer in time",
    "SSLError": "its certificate is not trusted",
    "ProtocolError": "the connection broke",
    "ChunkedEncodingError": "the connection broke",
}


@dataclass(frozen=True)
class Item:
    """An item of a catalogue.

    Parameters
    ----------
    id
        Its identifier.
    bounds_deg
        West, south, east and north bounds [deg] as the catalogue states them; west > east across the antimeridian.
    time
        When it was taken; ``None`` where the catalogue does not say.
    properties
        As the catalogue states them.
    assets
        Asset key to its fields, ``href`` among them.
    """

    id: str
    bounds_deg: Bounds
    time: datetime | None
    properties: dict[str, Any]
    assets: dict[str, dict[str, Any]]


def search(
    store: RemoteStore,
    catalogue_url: str,
    collection: str,
    boxes_deg: Sequence[Bounds],
    *,
    interval: str | None = None,
    query: dict[str, Any] | None = None,
) -> list[Item]:
    """Items of a collection that show an area, from the cache where it is younger than a day.

    Parameters
    ----------
    store
        Where answers are kept.
    catalogue_url, collection
        STAC API and collection.
    boxes_deg
        West, south, east, north [deg]; two of them across the antimeridian.
    interval
        ISO 8601 interval with a slash.
    query
        STAC query on properties.

    Returns
    -------
    list of Item
        Each once, sorted by id.

    Raises
    ------
    InputError
        The catalogue does not answer, is none, or answers what is no item; offline, it was not asked before.
    """
    found: dict[str, Item] = {}
    for box in boxes_deg:
        question = {
            "url": catalogue_url,
            "collection": collection,
            "bbox": [round(value, 6) for value in box],
            "datetime": interval,
            "query": query,
        }
        found |= {item.id: item for item in map(_item, _answer(store, question))}
    return [found[key] for key in sorted(found)]


def _answer(store: RemoteStore, question: dict[str, Any]) -> list[dict[str, Any]]:
    path = store.folder / "searches" / f"{short_hash(json.dumps(question, sort_keys=True))}.json"
    known = _kept_answer(path)
    if known is not None and (store.offline or not is_older(known["asked"], SEARCH_DAYS)):
        return known["items"]
    if store.offline:
        raise InputError(question["url"], "not asked about this area before", cure="leave out --offline once")
    try:
        items = _ask(store, question)
    except InputError as error:
        if known is None:
            raise
        log.warning("%s; its answer of %s is used", error, known["asked"][:10])
        return known["items"]
    with atomic_path(path) as temporary:
        asked = datetime.now(UTC).isoformat(timespec="seconds")
        temporary.write_text(json.dumps({"asked": asked, "question": question, "items": items}))
    return items


def _kept_answer(path: Any) -> dict[str, Any] | None:
    try:
        kept = json.loads(path.read_text())
        datetime.fromisoformat(kept["asked"])
        return kept if isinstance(kept["items"], list) else None
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError):
        log.info("%s: unreadable, asked again", path)
        return None


def _ask(store: RemoteStore, question: dict[str, Any]) -> list[dict[str, Any]]:
    try:
        from pystac_client import Client
        from pystac_client.exceptions import APIError
        from pystac_client.stac_api_io import StacApiIO
    except ImportError:
        cure = "pip install 'seasonscapes[data]'; files of your own need no extra"
        raise InputError("fetch", "pystac-client is not installed", cure=cure) from None
    import requests
    from pystac.errors import STACError
    from urllib3 import Retry

    url = question["url"]
    retry = Retry(
        total=TRIES - 1,
        backoff_factor=remote.FIRST_WAIT_S,
        backoff_max=20.0,
        status_forcelist=(429, 500, 502, 503, 504),
        allowed_methods=None,
    )
    later = "try again later, or name another catalogue with --stac"
    problem = ""
    for _ in range(2):  # the connection may break within an answer, which `Retry` does not see
        try:
            client = Client.open(url, stac_io=StacApiIO(max_retries=retry, timeout=TIMEOUT_S))
            # data.geo.admin.ch searches, and does not say so; one that cannot answers the question with a status.
            client.add_conforms_to("ITEM_SEARCH")
            found = client.search(
                collections=[question["collection"]],
                bbox=question["bbox"],
                datetime=question["datetime"],
                query=question["query"],
                limit=_PAGE_ITEMS,
                max_items=_MOST_ITEMS,
            )
            store.requests += 1
            return list(found.items_as_dicts())
        except APIError as error:
            status = getattr(error, "status_code", None)  # absent where no answer came at all
            if status == 404:
                raise InputError(url, f"has no collection {question['collection']}, or is no catalogue") from None
            problem = f"the catalogue does not answer ({status or _why(error)})"
        except (requests.exceptions.MissingSchema, requests.exceptions.InvalidURL):
            raise InputError("--stac", "not an address", got=url, expected="https://…") from None
        except requests.exceptions.RequestException as error:
            problem = f"the catalogue does not answer ({_WHY.get(type(error).__name__, type(error).__name__)})"
        except (STACError, ValueError, KeyError, TypeError, AttributeError, NotImplementedError) as error:
            raise InputError(
                url, f"no STAC catalogue that can be searched ({type(error).__name__})", cure=later
            ) from None
    raise InputError(url, problem, cure=later)


def _why(error: Exception) -> str:
    """In a few words why no answer came; pystac-client keeps the cause as the context of its own error alone."""
    cause = error.__context__
    first = cause.args[0] if cause is not None and cause.args else None
    reason = getattr(first, "reason", first)
    name = type(reason).__name__
    return str(reason) if name == "ResponseError" else _WHY.get(name, type(cause or error).__name__)


def _item(fields: Any) -> Item:
    try:
        bounds = [float(value) for value in fields["bbox"]]
        if len(bounds) == 6:
            bounds = [*bounds[:2], *bounds[3:5]]
        west, south, east, north = bounds
        properties = dict(fields["properties"])
        time = properties.get("datetime") or properties.get("start_datetime")
        assets = {str(key): dict(asset) for key, asset in fields["assets"].items() if asset.get("href")}
        moment = None if time is None else datetime.fromisoformat(str(time))
        if moment is not None and moment.tzinfo is None:
            moment = moment.replace(tzinfo=UTC)
        return Item(str(fields["id"]), (west, south, east, north), moment, properties, assets)
    except (KeyError, ValueError, TypeError, AttributeError) as error:
        name = fields.get("id") if isinstance(fields, dict) else None
        raise InputError(f"item {name}", f"not a STAC item ({error})", cure="report it to the catalogue") from None


def asset_of(item: Item, key: str, source: Source, *, finest_m: float) -> dict[str, Any]:
    """The asset of an item that a source declares; of several spacings the coarsest that is fine enough.

    Parameters
    ----------
    item
        The item.
    key
        Asset key, or a pattern with ``*``.
    source
        Names the region of ``s3://`` addresses.
    finest_m
        Spacing that is needed [m].

    Returns
    -------
    dict
        Fields of the asset; ``href`` is an ``http://`` or ``https://`` address.

    Raises
    ------
    InputError
        There is none, or its address is of another kind.
    """
    fitting = [asset for name, asset in item.assets.items() if fnmatch(name, key)]
    if not fitting:
        raise InputError(
            f"item {item.id}", f"has no asset '{key}'", expected=", ".join(list(item.assets)[:12]) or "assets"
        )
    fitting.sort(key=_spacing_m)
    fine_enough = [asset for asset in fitting if _spacing_m(asset) <= finest_m * 1.001]
    asset = (fine_enough or fitting[:1])[-1]
    return asset | {"href": _https(str(asset["href"]), source, item)}


def _spacing_m(asset: dict[str, Any]) -> float:
    value = asset.get("gsd", asset.get("eo:gsd", 0.0))
    return float(value) if isinstance(value, (int, float)) else 0.0


def _https(href: str, source: Source, item: Item) -> str:
    parts = urlsplit(href)
    if parts.scheme == "s3" and source.s3_region is not None and re.fullmatch(r"[a-z0-9][a-z0-9.-]+", parts.netloc):
        return f"https://{parts.netloc}.s3.{source.s3_region}.amazonaws.com{parts.path}"
    if parts.scheme not in ("http", "https") or not parts.netloc:
        raise InputError(
            f"item {item.id}",
            "leads to no web address",
            got=href[:120],
            expected="https://…",
            cure="choose another source",
        )
    return href
