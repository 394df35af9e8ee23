"""Opening of raster files that nobody vouches for: which formats are read, and where their files may lie.

GDAL recognises some 140 formats, and many of them only name other files, servers or programs. Here a file is refused
before GDAL sees it unless its content is that of a plain raster; a VRT mosaic is read if every element of it is known
and every file it names lies in the allowed folder and is itself readable. `open_raster` is the only way in which this
package opens a raster file for reading.
"""

from __future__ import annotations

import hashlib
import os
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

from seasonscapes.errors import InputError

if TYPE_CHECKING:
    from rasterio.io import DatasetReader

# What is read, by the first bytes of the file: the GDAL driver of one file and its sidecars.
_MAGIC = {
    b"II*\0": "GTiff",
    b"MM\0*": "GTiff",
    b"II+\0": "GTiff",
    b"MM\0+": "GTiff",
    b"\x89PNG": "PNG",
    b"\xff\xd8\xff": "JPEG",
    b"\0\0\0\x0cjP  ": "JP2OpenJPEG",
    b"EHFA_HEADER_TAG": "HFA",
    b"UHL1": "DTED",
}
_ASCII_GRID = (b"ncols", b"nrows", b"xll", b"yll", b"cellsize", b"dx", b"nodata_value")
# These begin with anything; their files' names decide.
_SUFFIXES = {".hgt": "SRTMHGT", ".bil": "EHdr", ".bip": "EHdr", ".bsq": "EHdr", ".flt": "EHdr", ".dem": "USGSDEM"}
FORMATS = "GeoTIFF, PNG, JPEG, JPEG 2000, WebP, Erdas Imagine, DTED, ASCII grid, .hgt, .bil, .flt or USGS .dem"
# GDAL opens a VRT's sources with all of its drivers: their content has to leave no choice.
_IN_VRT = frozenset({"GTiff", "PNG", "JPEG", "JP2OpenJPEG", "HFA", "AAIGrid", "SRTMHGT"})
_HGT_BYTES = {2 * 1201 * 1201, 2 * 3601 * 3601, 2 * 1801 * 3601}
_HDF5, _HDF5_OFFSETS = b"\x89HDF", (0, 512, 1024, 2048)
# Elements of mosaics and subsets, in lower case since GDAL ignores case. Warping, pixel functions, raw bands and open
# options are missing on purpose: they name files, programs and servers in many more ways.
_VRT_ELEMENTS = frozenset(
    {
        "vrtdataset",
        "srs",
        "geotransform",
        "metadata",
        "mdi",
        "blockxsize",
        "blockysize",
        "vrtrasterband",
        "description",
        "colorinterp",
        "nodatavalue",
        "hidenodatavalue",
        "unittype",
        "offset",
        "scale",
        "categorynames",
        "category",
        "colortable",
        "entry",
        "gcplist",
        "gcp",
        "maskband",
        "overviewlist",
        "histograms",
        "histitem",
        "histmin",
        "histmax",
        "bucketcount",
        "includeoutofrange",
        "approximate",
        "histcounts",
        "simplesource",
        "complexsource",
        "averagedsource",
        "kernelfilteredsource",
        "kernel",
        "size",
        "coefs",
        "normalized",
        "sourcefilename",
        "sourceband",
        "sourceproperties",
        "srcrect",
        "dstrect",
        "nodata",
        "scaleoffset",
        "scaleratio",
        "lut",
        "usemaskband",
        "colortablecomponent",
        "exponent",
        "srcmin",
        "srcmax",
        "dstmin",
        "dstmax",
        "clamp",
    }
)
_VRT_CURE = "write it as one file: gdal_translate FILE.vrt FILE.tif"
_MOST_NESTED = 8
_MOST_VRT_BYTES = 50_000_000
# No network, no Python in VRTs, whatever a file asks for.
_CLOSED = {
    "GDAL_VRT_ENABLE_PYTHON": "NO",
    "CPL_VSIL_CURL_ALLOWED_EXTENSIONS": "{noext}",
    "CPL_VSIL_CURL_ALLOWED_FILENAME": "none",
    "PROJ_NETWORK": "OFF",
}


@dataclass(frozen=True)
class Confinement:
    """Where the files of a raster may lie.

    Parameters
    ----------
    folder
        The raster and every file that it names must lie in it; ``None``: in the raster's own folder.
    allow_outside
        Trust the raster: any place, any GDAL format, ``/vsi…`` paths and servers.
    """

    folder: Path | None = None
    allow_outside: bool = False


OWN_FOLDER = Confinement()


def real_path(path: str | os.PathLike[str]) -> Path:
    """Absolute and without links; unlike `pathlib.Path.resolve` also for links in a circle, which name no file."""
    return Path(os.path.realpath(path))


def confined_path(name: str, base: Path, confinement: Confinement, *, where: str | Path) -> Path | str:
    """Resolve the name of a file in a document that nobody vouches for.

    Parameters
    ----------
    name
        As the document has it, relative to ``base`` or absolute.
    base
        Folder of the document; also where the file must lie, unless ``confinement`` names another folder.
    confinement
        The allowed folder.
    where
        What an error message calls the name: document and key, or line.

    Returns
    -------
    pathlib.Path or str
        Absolute and without links; with ``allow_outside`` also a GDAL ``/vsi…`` path, as a string.

    Raises
    ------
    InputError
        Where the name leads out of the folder, or holds a NUL.
    """
    if "\0" in name:
        raise InputError(where, "a file name with a NUL character", got=name)
    if name.startswith("/vsi"):
        if confinement.allow_outside:
            return name
    else:
        target = real_path(base / name)
        if confinement.allow_outside or target.is_relative_to(real_path(confinement.folder or base)):
            return target
    raise InputError(
        where,
        "leads outside its folder",
        got=name,
        expected=f"a file below {confinement.folder or base}",
        cure="move the data beside the file, or pass --allow-outside",
    )


@contextmanager
def open_raster(path: str | os.PathLike[str], confinement: Confinement = OWN_FOLDER) -> Iterator[DatasetReader]:
    """Open a raster for reading, without network and without files outside its folder.

    Parameters
    ----------
    path
        File; with ``confinement.allow_outside`` also a GDAL ``/vsi…`` path.
    confinement
        Where its files may lie.

    Yields
    ------
    rasterio.io.DatasetReader
        The open raster.

    Raises
    ------
    InputError
        Where there is no such file, it is of no known format, or it leads outside the folder.
    """
    import rasterio
    from rasterio.errors import NotGeoreferencedWarning, RasterioError

    name, driver = os.fspath(path), None
    if not confinement.allow_outside:
        driver = _plain_driver(Path(name), confinement)
    elif not name.startswith("/vsi") and not Path(name).is_file():
        raise InputError(name, "no such file")
    options: dict[str, Any] = {} if confinement.allow_outside else _CLOSED
    with rasterio.Env(**options):
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", NotGeoreferencedWarning)
                source = rasterio.open(name, driver=driver)
            with source:
                if not confinement.allow_outside:
                    _require_inside(name, source, confinement)
                yield source
        except RasterioError as error:
            raise InputError(name, f"not readable as a raster: {error}") from None


def raster_hash(path: str | os.PathLike[str], confinement: Confinement = OWN_FOLDER) -> str:
    """Hash the content of every file that a raster is made of: sources of a VRT, world files, ``.aux.xml``, masks.

    Parameters
    ----------
    path, confinement
        As in `open_raster`.

    Returns
    -------
    str
        Hexadecimal SHA-256 of the files' names (relative to the raster's folder) and contents. A ``/vsi…`` path counts
        by its name alone.

    Raises
    ------
    InputError
        As `open_raster`.
    """
    name = os.fspath(path)
    digest = hashlib.sha256()
    if name.startswith("/vsi"):
        with open_raster(name, confinement):
            digest.update(name.encode())
            return digest.hexdigest()
    base = real_path(name).parent
    for file in sorted(raster_members(name, confinement)):
        with open(file, "rb") as stream:
            content = hashlib.file_digest(stream, "sha256").hexdigest()
        digest.update(f"{os.path.relpath(file, base)}\0{content}\n".encode())
    return digest.hexdigest()


def rasters_hash(paths: Sequence[str | os.PathLike[str]], confinement: Confinement = OWN_FOLDER) -> str:
    """`raster_hash` of one file, or of the tiles of one raster in their order."""
    hashes = [raster_hash(path, confinement) for path in paths]
    return hashes[0] if len(hashes) == 1 else hashlib.sha256("\n".join(hashes).encode()).hexdigest()


def raster_members(path: str | os.PathLike[str], confinement: Confinement = OWN_FOLDER) -> set[Path]:
    """The files that a raster is made of, itself included; overviews are not, since they are never read."""
    found: set[Path] = set()
    pending = [real_path(path)]
    while pending:
        file = pending.pop()
        if file in found:
            continue
        found.add(file)
        with open_raster(file, _within(confinement, Path(path))) as source:
            beside = {real_path(each) for each in source.files if not each.startswith("/vsi")}
        is_vrt = _starts_as_vrt(file)
        pending += [each for each in beside if is_vrt and each.suffix not in (".xml", ".ovr", ".msk")]
        found |= {each for each in beside if each.suffix != ".ovr" and (not is_vrt or each.suffix in (".xml", ".msk"))}
    return found


def _within(confinement: Confinement, path: Path) -> Confinement:
    """The confinement of files that a raster names: the raster's folder is theirs too."""
    if confinement.folder is not None or confinement.allow_outside:
        return confinement
    return Confinement(real_path(path).parent)


def _starts_as_vrt(path: Path) -> bool:
    with open(path, "rb") as file:
        return file.read(1024).lstrip()[:11].lower() == b"<vrtdataset"


def _plain_driver(path: Path, confinement: Confinement, depth: int = 0) -> str:
    """The GDAL driver of a file that is nothing but a raster, its sources included; `InputError` for any other."""
    if os.fspath(path).startswith("/vsi"):
        raise InputError(path, "a virtual path of GDAL", cure="pass --allow-outside if you trust it")
    if not path.is_file():
        raise InputError(path, "no such file")
    target, folder = real_path(path), real_path(confinement.folder or path.parent)
    if not target.is_relative_to(folder):
        raise InputError(path, "leads outside its folder", got=str(target), expected=f"a file below {folder}")
    _require_plain_sidecars(path)
    if not _starts_as_vrt(path):
        return _driver_of(path)
    inner = _within(confinement, path)
    for source in _vrt_sources(path, inner):
        if depth == _MOST_NESTED:
            raise InputError(path, f"VRT files nested more than {_MOST_NESTED} deep", cure=_VRT_CURE)
        _require_source(source, _plain_driver(source, inner, depth + 1), path)
    return "VRT"


def _driver_of(path: Path) -> str:
    with open(path, "rb") as file:
        head = file.read(64)
    start = head.lstrip()
    if start.startswith((b"<", b"\xef\xbb\xbf<", b"{", b"[")):
        raise InputError(
            path,
            "a description of data elsewhere (XML or JSON) and no raster",
            expected=FORMATS,
            cure="save the data itself, as a GeoTIFF; or pass --allow-outside if you trust it",
        )
    found = next((driver for magic, driver in _MAGIC.items() if head.startswith(magic)), None)
    if found is None and head[:4] == b"RIFF" and head[8:12] == b"WEBP":
        found = "WEBP"
    if found is None and start.lower().startswith(_ASCII_GRID):
        found = "AAIGrid"
    found = found or _SUFFIXES.get(path.suffix.lower())
    if found is None:
        raise InputError(
            path,
            "not readable as a raster: of no known kind",
            expected=FORMATS + ", or a VRT of these",
            cure="convert it: gdal_translate FILE FILE.tif; or pass --allow-outside if you trust it",
        )
    return found


def _require_plain_sidecars(path: Path) -> None:
    """Masks and overviews beside a raster are opened by GDAL with all of its drivers: they must be TIFF files."""
    for suffix in (".msk", ".ovr"):
        beside = path.with_name(path.name + suffix)
        if beside.is_file():
            with open(beside, "rb") as file:
                if _MAGIC.get(file.read(4)) != "GTiff":
                    raise InputError(beside, "a mask or overview that is no TIFF file", cure="remove it")


def _require_source(source: Path, driver: str, vrt: Path) -> None:
    """Refuse a source of a VRT that GDAL might take for something else."""
    plain = driver in _IN_VRT or driver == "VRT"
    if driver == "SRTMHGT":
        with open(source, "rb") as file:
            head = file.read(2052)
        plain = source.stat().st_size in _HGT_BYTES and all(head[at : at + 4] != _HDF5 for at in _HDF5_OFFSETS)
    if not plain:
        raise InputError(
            vrt,
            "names a file of a kind that is not read through a VRT",
            got=str(source),
            expected="GeoTIFF, PNG, JPEG, JPEG 2000, Erdas Imagine, ASCII grid or SRTM .hgt",
            cure=_VRT_CURE,
        )


def _vrt_sources(path: Path, confinement: Confinement) -> list[Path]:
    """The files that a VRT names; `InputError` for elements that are not known, and for files outside the folder."""
    if path.stat().st_size > _MOST_VRT_BYTES:
        raise InputError(path, "too large for a VRT", expected=f"at most {_MOST_VRT_BYTES} bytes", cure=_VRT_CURE)
    try:
        # As text, so that no declared encoding makes this parser and GDAL's read different names.
        text = path.read_bytes().decode("utf-8")
        if "<!DOCTYPE" in text or "<!ENTITY" in text:
            raise InputError(path, "a VRT with a document type", cure=_VRT_CURE)
        root = ElementTree.fromstring(text)
    except (UnicodeDecodeError, ElementTree.ParseError, ValueError, RecursionError) as error:
        raise InputError(path, f"not a valid VRT: {error}") from None
    sources = []
    for element in root.iter():
        kind = element.tag.rpartition("}")[2].lower() if isinstance(element.tag, str) else ""
        attributes = {key.lower(): value for key, value in element.attrib.items()}
        subclass = attributes.get("subclass", "VRTRasterBand") if kind in ("vrtdataset", "vrtrasterband") else ""
        if kind not in _VRT_ELEMENTS or subclass not in ("", "VRTRasterBand", "VRTSourcedRasterBand"):
            raise InputError(path, "a VRT that does more than join rasters", got=subclass or kind, cure=_VRT_CURE)
        if kind == "metadata" and attributes.get("domain", "").lower() == "overviews":
            raise InputError(path, "names a file of overviews", cure="remove that entry")
        if kind == "sourcefilename":
            sources.append(_vrt_source(path, element.text or "", attributes, confinement))
    return sources


def _vrt_source(path: Path, name: str, attributes: dict[str, str], confinement: Confinement) -> Path:
    relative = attributes.get("relativetovrt", "0") == "1"
    # GDAL reads a colon as the end of a format's or server's name ("HDF5:", "vrt://", "https://").
    if relative == name.startswith("/") or ":" in name or name != name.strip() or not name:
        raise InputError(
            f"{path}: SourceFilename",
            "not the plain path of a file",
            got=name,
            expected='relative with relativeToVRT="1", or else absolute',
            cure=_VRT_CURE,
        )
    source = Path(confined_path(name, path.parent, confinement, where=f"{path}: SourceFilename"))
    if not source.is_file():
        raise InputError(f"{path}: SourceFilename", "no such file", got=str(source))
    return source


def _require_inside(name: str, source: DatasetReader, confinement: Confinement) -> None:
    """Refuse a raster whose sidecars, parts or overviews lie elsewhere."""
    folder = real_path(confinement.folder or Path(name).parent)
    if source.tags(ns="OVERVIEWS"):
        raise InputError(name, "names a file of overviews", cure="write it anew: gdal_translate FILE NEW.tif")
    for file in source.files:
        if file.startswith("/vsi") or not real_path(file).is_relative_to(folder):
            raise InputError(
                name,
                "is made of a file outside its folder",
                got=file,
                expected=f"files below {folder}",
                cure="copy the data beside it, or pass --allow-outside",
            )
