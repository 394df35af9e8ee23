"""A textured terrain with sun, moon and sky as OpenUSD (extra ``usd``), still or through a day."""

# OpenUSD binds its names at run time and has no type stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from seasonscapes.errors import InputError
from seasonscapes.export.gltf import ALBEDO_COLOURS, LIT_COLOURS, TexturedTerrain, lamp_colour, shading_normals
from seasonscapes.export.sky_map import NORTH_EDGED, write_sky
from seasonscapes.images import atomic_path, png8_bytes
from seasonscapes.sky.illumination import Luminary

# Time codes are minutes since the first instant; a player shows an hour in a second.
_CODES_PER_SECOND = 60.0


@dataclass(frozen=True)
class Instant:
    """The light of one instant.

    Parameters
    ----------
    time
        Aware.
    lamps
        Sun and moon by name; without those below the horizon.
    sky_radiance
        Sky map as in `sky.illumination.Illumination`.
    """

    time: datetime
    lamps: Mapping[str, Luminary]
    sky_radiance: np.ndarray


def require_usd() -> None:
    """`InputError` where the extra ``usd`` is not installed."""
    try:
        import pxr  # noqa: F401
    except ImportError:
        raise InputError("--to usd", "OpenUSD is not installed", cure='pip install "seasonscapes[usd]"') from None


def write_usd(path: Path, model: TexturedTerrain, instants: Sequence[Instant]) -> list[Path]:
    """Write a ``.usda``, ``.usdc`` or ``.usd`` stage with its texture and skies beside it; the stage last, atomically.

    The stage is z-up, in metres: x east, y north, z up. The ground is a ``UsdPreviewSurface`` without specular
    reflection. Sun and moon are ``DistantLight`` of their angular diameters, normalised: intensity × colour is the
    illuminance of a plane that faces the light [lx]. The sky is a ``DomeLight`` in cd/m². Of several instants, lights
    and sky carry time samples; a time code is a minute since the first.

    Parameters
    ----------
    path
        File to write.
    model
        Terrain, texture and metadata; its lamps are not used.
    instants
        None for the ground without light, one for an hour, or several in the order of time.

    Returns
    -------
    list of Path
        The files.

    Raises
    ------
    InputError
        Where OpenUSD is not installed.
    """
    require_usd()
    from pxr import Sdf, Usd, UsdGeom

    texture = path.with_name(f"{path.stem}.{'lit' if model.lit else 'albedo'}.png")
    with atomic_path(texture) as temporary:
        temporary.write_bytes(png8_bytes(model.picture))
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    world = UsdGeom.Xform.Define(stage, "/World")
    stage.SetDefaultPrim(world.GetPrim())
    Usd.ModelAPI(world.GetPrim()).SetKind("component")
    colours = LIT_COLOURS if model.lit else ALBEDO_COLOURS
    axes = {"up_axis": "z", "axes": "x east, y north, z up", "unit": "metre"}
    about = {**axes, "colour_space": f"{colours}; lights in linear Rec.709", **model.about}
    layer = stage.GetRootLayer()
    layer.customLayerData = {"seasonscapes": _dictionary(about)}
    layer.documentation = about.get("attribution", "")
    _ground(stage, model, texture.name)
    files = [path, texture]
    if instants:
        codes = [(instant.time - instants[0].time).total_seconds() / 60.0 for instant in instants]
        for name in ("sun", "moon"):
            lamps = [instant.lamps.get(name) for instant in instants]
            if any(lamp is not None for lamp in lamps):
                _distant_light(stage, name, lamps, codes)
        files += _dome(stage, path, instants, codes, about)
        if len(instants) > 1:
            stage.SetStartTimeCode(codes[0])
            stage.SetEndTimeCode(codes[-1])
            stage.SetTimeCodesPerSecond(_CODES_PER_SECOND)
            stage.SetFramesPerSecond(_CODES_PER_SECOND)
    with atomic_path(path) as temporary:
        # The temporary file exists, and layers of one path are kept: it is replaced by an export, never opened.
        if not layer.Export(str(temporary), args={} if path.suffix != ".usd" else {"format": "usdc"}):
            raise OSError(f"{path}: OpenUSD could not write the stage")
    assert Sdf.Layer.Find(str(path)) is None
    return files


def _dictionary(values: Mapping[str, Any]) -> dict[str, Any]:
    """Plain values as OpenUSD stores them: nested dictionaries of numbers and text; lists become JSON text."""
    stored = {}
    for name, value in values.items():
        if isinstance(value, Mapping):
            stored[name] = _dictionary(value)
        elif isinstance(value, (bool, int, float, str)):
            stored[name] = value
        else:
            stored[name] = json.dumps(value, default=float)
    return stored


def _ground(stage: Any, model: TexturedTerrain, texture: str) -> None:
    from pxr import Gf, Sdf, UsdGeom, UsdShade, Vt

    terrain = model.terrain
    mesh = UsdGeom.Mesh.Define(stage, "/World/Ground")
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(terrain.vertices, np.float32)))
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(terrain.faces), 3, np.int32)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(terrain.faces.ravel().astype(np.int32)))
    mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(shading_normals(terrain)))
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    bounds = [terrain.vertices.min(axis=0), terrain.vertices.max(axis=0)]
    mesh.CreateExtentAttr(Vt.Vec3fArray([Gf.Vec3f(*map(float, corner)) for corner in bounds]))
    primvars = UsdGeom.PrimvarsAPI(mesh)
    st = primvars.CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.vertex)
    # OpenUSD counts v upwards, as the atlas does.
    st.Set(Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(terrain.uv, np.float32)))
    material = UsdShade.Material.Define(stage, "/World/GroundMaterial")
    surface = _shader(stage, "Surface", "UsdPreviewSurface")
    coordinates = _shader(stage, "Coordinates", "UsdPrimvarReader_float2")
    coordinates.CreateInput("varname", Sdf.ValueTypeNames.String).Set("st")
    image = _shader(stage, "Texture", "UsdUVTexture")
    image.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(Sdf.AssetPath(f"./{texture}"))
    image.CreateInput("sourceColorSpace", Sdf.ValueTypeNames.Token).Set("sRGB")
    for axis in ("wrapS", "wrapT"):
        image.CreateInput(axis, Sdf.ValueTypeNames.Token).Set("clamp")
    coordinates_out = coordinates.CreateOutput("result", Sdf.ValueTypeNames.Float2)
    image.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(coordinates_out)
    rgb = image.CreateOutput("rgb", Sdf.ValueTypeNames.Float3)
    black = Gf.Vec3f(0.0, 0.0, 0.0)
    if model.lit:
        surface.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).Set(black)
    colour = surface.CreateInput("emissiveColor" if model.lit else "diffuseColor", Sdf.ValueTypeNames.Color3f)
    colour.ConnectToSource(rgb)
    # Lambertian: no specular reflection.
    surface.CreateInput("useSpecularWorkflow", Sdf.ValueTypeNames.Int).Set(1)
    surface.CreateInput("specularColor", Sdf.ValueTypeNames.Color3f).Set(black)
    surface.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(1.0)
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", Sdf.ValueTypeNames.Token))
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)


def _shader(stage: Any, name: str, kind: str) -> Any:
    from pxr import UsdShade

    shader = UsdShade.Shader.Define(stage, f"/World/GroundMaterial/{name}")
    shader.CreateIdAttr(kind)
    return shader


def _distant_light(stage: Any, name: str, lamps: Sequence[Luminary | None], codes: Sequence[float]) -> None:
    """A lamp that is dark while it is below the horizon."""
    from pxr import Gf, UsdLux

    light = UsdLux.DistantLight.Define(stage, f"/World/{name.capitalize()}")
    shining = [(code, lamp) for code, lamp in zip(codes, lamps, strict=True) if lamp is not None]
    light.CreateAngleAttr(2.0 * shining[0][1].angular_radius_deg)
    light.CreateNormalizeAttr(True)
    intensity, colour = light.CreateIntensityAttr(), light.CreateColorAttr()
    for code, lamp in zip(codes, lamps, strict=True):
        _set(intensity, 0.0 if lamp is None else lamp_colour(lamp)[1], code, codes)
    # A light shines along its -z: tilt +z from the zenith to the elevation over north, then turn to the azimuth. As angles
    # and without jumps, so that what lies between two samples is a sun between two suns.
    turn, tilt = light.AddRotateZOp(), light.AddRotateXOp()
    azimuths = np.degrees(np.unwrap(np.radians([lamp.azimuth_deg for _, lamp in shining])))
    for (code, lamp), azimuth_deg in zip(shining, azimuths, strict=True):
        _set(colour, Gf.Vec3f(*lamp_colour(lamp)[0]), code, codes)
        _set(turn, -float(azimuth_deg), code, codes)
        _set(tilt, lamp.elevation_deg - 90.0, code, codes)


def _dome(
    stage: Any, path: Path, instants: Sequence[Instant], codes: Sequence[float], about: dict[str, Any]
) -> list[Path]:
    from pxr import Sdf, UsdLux

    dome = UsdLux.DomeLight.Define(stage, "/World/Sky")
    dome.CreateIntensityAttr(1.0)
    dome.CreateTextureFormatAttr(UsdLux.Tokens.latlong)
    # A dome's pole is its +y and the centre of its map its +z: laid over, +y is up, +z south and +x east.
    dome.AddRotateXOp().Set(90.0)
    texture, files = dome.CreateTextureFileAttr(), []
    for instant, code in zip(instants, codes, strict=True):
        number = "" if len(instants) == 1 else f".{round(code):04d}"
        sky = path.with_name(f"{path.stem}.sky{number}.exr")
        time_utc = instant.time.astimezone(UTC).isoformat()
        write_sky(sky, instant.sky_radiance, {**about, "time_utc": time_utc}, layout=NORTH_EDGED)
        _set(texture, Sdf.AssetPath(f"./{sky.name}"), code, codes)
        files.append(sky)
    return files


def _set(attribute: Any, value: Any, code: float, codes: Sequence[float]) -> None:
    """Set an attribute for good where there is a single instant, else at a time code."""
    if len(codes) == 1:
        attribute.Set(value)
    else:
        attribute.Set(value, code)
