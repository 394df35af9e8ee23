"""Albedo textures that come from elsewhere: ``.npz`` files of this program, and pictures of the atlas that were edited.

A picture is the texture of a place laid out in its atlas: PNG (sRGB), OpenEXR (linear) or the base colour of a glTF
file. What this program writes states what it holds and of which atlas; an editor may drop that, and then the size alone
is checked and the picture is taken for an albedo.
"""

from __future__ import annotations

import json
import logging
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import asdict
from datetime import date, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from seasonscapes.array_files import read_arrays
from seasonscapes.errors import AtlasMismatch, InputError, SeasonscapesError
from seasonscapes.sky.models import SkyModel, sky_model_from_table
from seasonscapes.terrain.surface import Texture, load_texture
from seasonscapes.workflows.terrain_building import MeshOptions

if TYPE_CHECKING:
    from seasonscapes.relighting.lit_texture import LitTexture
    from seasonscapes.workflows.place import Place

log = logging.getLogger(__name__)

# No natural surface reflects more; beyond it the texture holds something else than albedo.
_MOST_ALBEDO = 1.5
# A picture's highlights above this display value are compressed so far that 8 bits no longer tell their luminance.
_CLIPPED = 0.995


def texture_facts(
    place: Place, holds: str, *, utc: datetime | None = None, sky: SkyModel | None = None, **more: Any
) -> dict[str, Any]:
    """What a picture of a texture states about itself, for its metadata.

    Parameters
    ----------
    place
        The place whose atlas it is laid out in.
    holds
        ``albedo``, ``lit`` (radiance of an hour), or ``figure``, which is not read back.
    utc, sky
        Of lit textures: the hour and its sky.
    more
        Of lit textures: ``exposure_ev100`` of a developed picture, ``rays`` and ``seed`` of its light. ``tilted``: true where
        the albedo has normals of its own (``albedo --normals``), which a picture does not hold.
    """
    facts: dict[str, Any] = {"holds": holds, "atlas_id": place.atlas_id, "mesh": asdict(place.options), **more}
    if utc is not None:
        facts["time_utc"] = utc.isoformat()
    if sky is not None:
        facts["sky"] = sky.model_dump(mode="json")
    return facts


def require_albedo_file(path: Path) -> None:
    """`InputError` where a file is missing, of an unknown kind, or no texture."""
    if not path.is_file():
        raise InputError("--albedo", "no such file", got=str(path))
    kind = path.suffix.lower()
    if kind not in _PICTURES and kind != ".npz":
        expected = "an .npz, .png, .exr or .glb file of this place's atlas"
        raise InputError("--albedo", "not an albedo texture", got=str(path), expected=expected)
    if kind != ".npz":
        return
    cure = "give a .npz file of `seasonscapes albedo`"
    read_arrays(path, ["values", "weight"], what="an albedo texture", cure=cure)


def albedo_date(path: Path) -> date | None:
    """The date that an albedo file states, or ``None``; `InputError` where it is missing or no texture."""
    require_albedo_file(path)
    if path.suffix.lower() == ".npz":
        stored = read_arrays(path, [], optional=["date"], what="an albedo texture")
        return _stated_date(path, stored["date"]) if "date" in stored else None
    facts = _facts(path)
    stated = facts.get("date", facts.get("time_utc"))
    return None if stated is None else _stated_date(path, stated)


def _stated_date(path: Path, stated: object) -> date:
    try:
        return datetime.fromisoformat(str(stated)).date()
    except ValueError:
        raise InputError(path, "states no date", got=str(stated), expected="ISO 8601, such as 2024-07-20") from None


def stated_mesh(paths: Sequence[Path]) -> MeshOptions | None:
    """How the terrain and atlas of albedo files were built; ``None`` where a file does not say, or they differ.

    Raises
    ------
    InputError
        Where a file is missing or no texture, or states options that do not exist.
    """
    found = []
    for path in paths:
        require_albedo_file(path)
        if path.suffix.lower() == ".npz":
            stored = read_arrays(path, [], optional=["mesh"], what="an albedo texture")
            found.append(json.loads(str(stored["mesh"])) if "mesh" in stored else None)
        else:
            found.append(_facts(path).get("mesh"))
    if not found or any(each is None or each != found[0] for each in found):
        return None
    try:
        return MeshOptions(**found[0])
    except (TypeError, InputError) as error:
        raise InputError(paths[0], f"states options of a mesh that do not exist ({error})") from None


def read_albedo(place: Place, path: Path) -> Texture:
    """Read an albedo texture of a place.

    Parameters
    ----------
    place
        The place.
    path
        ``.npz``; or a picture of the whole atlas: ``.png`` (8 or 16 bits, sRGB), ``.exr`` (linear Rec.709) or ``.glb``.
        Where it states that it holds the light of an hour, as those of ``seasonscapes lit-texture`` do, that light is
        computed again and taken out.

    Returns
    -------
    Texture
        Linear reflectance. ``weight`` of pictures is 1, and 0 where a lit picture's highlights are clipped.

    Raises
    ------
    InputError
        Where it is no albedo: a figure, radiance, transparent texels, values that are not finite or beyond 1.5; or lit on
        normals of its own, whose light cannot be computed again from a picture.
    AtlasMismatch
        Where it is of another atlas or size.
    """
    require_albedo_file(path)
    kind = path.suffix.lower()
    if kind == ".npz":
        texture = place.require_texture(load_texture(path), what=str(path))
    else:
        values, facts = _PICTURES[kind](path), _facts(path)
        texture = Texture(values, np.ones(values.shape[:2], np.float32), facts.get("atlas_id"))
        place.require_texture(texture, what=str(path))
        if facts.get("holds") == "figure":
            cure = "edit what `seasonscapes albedo`, `lit-texture` or `export` write"
            raise InputError(path, "is a figure, not an albedo", cure=cure)
        if facts.get("holds") == "lit":
            texture = _without_light(place, path, texture, facts)
        elif facts.get("tilted"):
            log.warning(
                "%s: the normals that photographs told stay behind in the .npz; this one has those of the heights", path
            )
        elif not facts:
            log.info("%s: states nothing about itself; taken for an albedo of this place's atlas", path)
    _require_albedo_values(path, texture)
    return texture


def _require_albedo_values(path: Path, texture: Texture) -> None:
    if not np.isfinite(texture.values).all():
        raise InputError(path, "not an albedo", got="values that are not finite", expected="reflectance in [0, 1]")
    low, high = float(texture.values.min()), float(texture.values.max())
    if low < 0.0 or high > _MOST_ALBEDO:
        got = f"values from {low:.4g} to {high:.4g}"
        cure = "a painted or completed texture holds radiance; `seasonscapes albedo` takes the light out"
        raise InputError(path, "not an albedo", got=got, expected="reflectance in [0, 1]", cure=cure)


def _facts(path: Path) -> dict[str, Any]:
    """What a picture states about its texture; empty where an editor dropped it."""
    from seasonscapes.workflows.provenance import provenance

    stated = provenance(path)
    for key in ("seasonscapes", "provenance", "extras"):
        record = stated.get(key)
        if isinstance(record, dict) and isinstance(record.get("texture"), dict):
            return record["texture"]
    return {}


def _png(path: Path) -> np.ndarray:
    import cv2

    from seasonscapes.images import read_image_linear

    raw = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if raw is not None and raw.ndim == 3 and raw.shape[2] == 4 and (raw[..., 3] < raw[..., 3].max()).any():
        raise InputError(path, "has transparent texels", cure="fill them: an albedo has a value everywhere")
    return read_image_linear(path)


def _exr(path: Path) -> np.ndarray:
    """The picture; that its layers of light and albedo no longer agree with it is told."""
    from seasonscapes.images import read_exr

    layers, _ = read_exr(path)
    picture = layers.get("")
    if picture is None or picture.ndim != 3 or picture.shape[2] != 3:
        raise InputError(path, "has no picture", got=", ".join(sorted(layers)), expected="channels R, G and B")
    if {"sun", "sky", "bounce", "albedo"} <= set(layers):
        layered = np.nan_to_num((layers["sun"] + layers["sky"] + layers["bounce"]) * layers["albedo"] / np.pi)
        if not np.allclose(layered, picture, rtol=0.01, atol=0.01 * float(picture.max())):
            log.info("%s: the picture differs from its layers of light and albedo; the picture counts", path)
    return np.asarray(picture, np.float32)


def _glb(path: Path) -> np.ndarray:
    import pygltflib

    document = pygltflib.GLTF2.load(str(path))
    images = [] if document is None else document.images
    if document is None or len(images) != 1:
        expected = "one base colour texture: the atlas of the place"
        raise InputError(path, "not the model of a place", got=f"{len(images)} textures", expected=expected)
    view = images[0].bufferView
    if view is None:
        raise InputError(path, "keeps its texture in another file", cure="export it as one .glb")
    part = document.bufferViews[view]
    start = part.byteOffset or 0
    with tempfile.TemporaryDirectory() as folder:
        picture = Path(folder) / "texture.png"
        picture.write_bytes((document.binary_blob() or b"")[start : start + part.byteLength])
        return _png(picture)


_PICTURES: dict[str, Callable[[Path], np.ndarray]] = {".png": _png, ".exr": _exr, ".glb": _glb}


def _without_light(place: Place, path: Path, texture: Texture, facts: dict[str, Any]) -> Texture:
    """Divide a lit texture by the light of its hour; texels whose highlights are clipped get weight 0.

    The light between slopes is that of the scene's own albedo.
    """
    from seasonscapes.images import linear_from_display

    if facts.get("tilted"):
        cure = "render from the .npz that it was made of, or recover that without --normals"
        raise InputError(path, "is lit on normals from photographs, which a picture does not hold", cure=cure)
    radiance, weight = texture.values, texture.weight
    if "exposure_ev100" in facts:
        if facts.get("eye"):
            cure = "write the texture with --exposure auto or a number"
            raise InputError(path, "is developed as an eye adapted to the dark sees it", cure=cure)
        weight = (radiance.max(axis=-1) < _CLIPPED).astype(np.float32)
        radiance = linear_from_display(radiance, float(facts["exposure_ev100"]))
    lit = _light_of(place, path, facts)
    received = lit.sun + lit.sky + lit.bounce
    on_land = np.isfinite(received) & (received > 0.0)
    albedo = np.where(on_land, np.pi * radiance / np.where(on_land, received, 1.0), lit.albedo)
    return Texture(np.clip(albedo, 0.0, 1.0).astype(np.float32), weight, place.atlas_id)


def _light_of(place: Place, path: Path, facts: dict[str, Any]) -> LitTexture:
    from seasonscapes.workflows.received_light import lit_texture

    try:
        sky = sky_model_from_table(facts["sky"], where=path)
        utc, rays, seed = datetime.fromisoformat(facts["time_utc"]), int(facts["rays"]), int(facts["seed"])
        return lit_texture(place, utc, sky=sky, rays=rays, seed=seed)
    except (KeyError, TypeError, ValueError, SeasonscapesError) as error:
        if isinstance(error, AtlasMismatch):
            raise
        cure = "take its light out with `seasonscapes delight`"
        raise InputError(path, f"states a light that cannot be computed again ({error})", cure=cure) from None
