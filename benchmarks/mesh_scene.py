"""A mesh as phone photogrammetry makes them, with its truth: rocks and a hut on a patch of ground, three textures.

The file's y axis points up and its origin is shifted, as photogrammetry writes map coordinates. The truth is path traced
by Mitsuba's own integrator over Mitsuba's own meshes and materials; the ground goes on beyond the patch.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from seasonscapes.frames import LocalFrame
from seasonscapes.images import linear_from_srgb, srgb_from_linear
from seasonscapes.sky.illumination import Illumination
from seasonscapes.terrain.surface import Terrain
from seasonscapes.terrain.texels import texel_positions

# Swiss map coordinates that the file's are shifted by (east, north, height).
CRS, SHIFT = "EPSG:2056", (2_641_000.0, 1_158_000.0, 1_200.0)
PATCH_M = 12.0
GROUND_BEYOND = 0.25
_SEAM_PX = 4


@dataclass(frozen=True)
class Part:
    """A part with its own texture: positions in metres east, north, up of the map, and albedo."""

    name: str
    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray
    albedo: np.ndarray

    @property
    def terrain(self) -> Terrain:
        """For the positions of texels."""
        return Terrain(
            self.vertices.astype(np.float32),
            self.faces.astype(np.uint32),
            self.uv.astype(np.float32),
            LocalFrame(0.0, 0.0),
        )


def make_parts(seed: int, *, texels: int = 192) -> list[Part]:
    """Ground, rocks and hut with albedo textures of ``texels`` (ground) and two thirds as many."""
    rng = np.random.default_rng(seed)
    noise = _Noise(rng)
    return [
        _painted("ground", *_ground(noise), texels, _meadow, noise),
        _painted("rocks", *_unwrapped(*_rocks(rng, noise), texels * 2 // 3), texels * 2 // 3, _granite, noise),
        _painted("hut", *_unwrapped(*_hut(), texels * 2 // 3), texels * 2 // 3, _timber, noise),
    ]


class _Noise:
    """Smooth noise of position by random Fourier modes of several octaves."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._modes = []
        for octave in range(5):
            direction = rng.normal(size=(12, 3))
            direction /= np.linalg.norm(direction, axis=1, keepdims=True)
            self._modes.append((direction * 0.5 * 2.0**octave, rng.uniform(0.0, 2.0 * np.pi, 12), 0.62**octave))

    def __call__(self, point: np.ndarray, scale: float = 1.0) -> np.ndarray:
        total = np.zeros(point.shape[:-1])
        for wave, phase, weight in self._modes:
            total += weight * np.cos(point @ (wave.T * scale) * 2.0 + phase).sum(axis=-1) / 3.5
        return total


def _ground(noise: _Noise) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    side = 49
    v, u = np.meshgrid(np.linspace(0.0, 1.0, side), np.linspace(0.0, 1.0, side), indexing="ij")
    east, north = (u - 0.5) * PATCH_M, (v - 0.5) * PATCH_M
    plan = np.stack([east, north, np.zeros_like(east)], axis=-1)
    rim = np.clip((0.5 * PATCH_M - np.maximum(np.abs(east), np.abs(north))) / 2.0, 0.0, 1.0)
    up = 0.07 * rim * (noise(plan, 0.35) + 1.0) ** 2
    vertices = np.stack([east, north, up], axis=-1).reshape(-1, 3)
    index = np.arange(side * side).reshape(side, side)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return vertices, faces, np.stack([u, v], axis=-1).reshape(-1, 2)


def _rocks(rng: np.random.Generator, noise: _Noise) -> tuple[np.ndarray, np.ndarray]:
    import trimesh

    vertices, faces = [], []
    for centre, radius in (((-2.6, 1.2), 1.3), ((2.2, -2.4), 0.9), ((-1.0, -3.0), 0.5)):
        ball = trimesh.creation.icosphere(subdivisions=4)
        direction = np.asarray(ball.vertices)
        shift = rng.uniform(0.0, 20.0, 3)
        length = radius * (1.0 + 0.16 * noise(direction + shift, 0.8))
        points = direction * length[:, None] * np.array([1.0, 1.0, 0.8]) + np.array([*centre, 0.35 * radius])
        faces.append(np.asarray(ball.faces) + sum(len(part) for part in vertices))
        vertices.append(points)
    vertices, faces = np.concatenate(vertices), np.concatenate(faces)
    # Photogrammetry has no undersides.
    kept = vertices[faces][..., 2].max(axis=1) > 0.0
    used, faces = np.unique(faces[kept], return_inverse=True)
    return vertices[used], faces.reshape(-1, 3)


def _hut() -> tuple[np.ndarray, np.ndarray]:
    east, north, wall, ridge = 1.3, 0.9, 1.5, 2.3
    corners = np.array([[-east, -north], [east, -north], [east, north], [-east, north]])
    base, top = np.c_[corners, np.full(4, -0.1)], np.c_[corners, np.full(4, wall)]
    ridges = np.array([[-east, 0.0, ridge], [east, 0.0, ridge]])
    points = np.concatenate([base, top, ridges]) + np.array([1.6, 2.2, 0.0])
    quads = [[0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7], [4, 5, 9, 8], [6, 7, 8, 9]]
    faces = [face for q in quads for face in ([q[0], q[1], q[2]], [q[0], q[2], q[3]])] + [[5, 6, 9], [7, 4, 8]]
    return points, np.array(faces)


def _unwrapped(vertices: np.ndarray, faces: np.ndarray, texels: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    import xatlas

    atlas = xatlas.Atlas()
    atlas.add_mesh(vertices.astype(np.float32), faces.astype(np.uint32))
    options = xatlas.PackOptions()
    options.resolution, options.padding = texels, _SEAM_PX
    atlas.generate(pack_options=options)
    used, local, uv = atlas[0]
    return vertices[used], np.asarray(local, np.int64), np.asarray(uv, float)


def _painted(
    name: str, vertices: np.ndarray, faces: np.ndarray, uv: np.ndarray, texels: int, colour, noise: _Noise
) -> Part:
    part = Part(name, vertices, faces, uv, np.zeros((texels, texels, 3), np.float32))
    position, face = texel_positions(part.terrain, texels, texels)
    albedo = np.clip(colour(np.nan_to_num(position).astype(float), noise), 0.03, 0.8)
    return Part(name, vertices, faces, uv, _spread(albedo, face >= 0).astype(np.float32))


def _spread(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    from scipy.ndimage import distance_transform_edt

    nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
    return values[nearest[0], nearest[1]]


def _meadow(p: np.ndarray, noise: _Noise) -> np.ndarray:
    share = 1.0 / (1.0 + np.exp(-6.0 * noise(p, 0.5)))[..., None]
    base = share * np.array([0.09, 0.13, 0.05]) + (1.0 - share) * np.array([0.34, 0.29, 0.22])
    return base * (1.0 + 0.25 * noise(p, 4.0))[..., None]


def _granite(p: np.ndarray, noise: _Noise) -> np.ndarray:
    base = np.array([0.36, 0.35, 0.33]) * (1.0 + 0.3 * noise(p, 1.5) + 0.2 * noise(p, 5.0))[..., None]
    lichen = (noise(p + 7.0, 1.2) > 0.7)[..., None]
    return np.where(lichen, np.array([0.45, 0.40, 0.12]), base)


def _timber(p: np.ndarray, noise: _Noise) -> np.ndarray:
    boards = 0.75 + 0.25 * np.sign(np.sin(p[..., 2] * 22.0))
    wood = np.array([0.33, 0.20, 0.11]) * (boards * (1.0 + 0.2 * noise(p, 3.0)))[..., None]
    slate = np.array([0.22, 0.23, 0.25]) * (1.0 + 0.25 * noise(p, 4.0))[..., None]
    return np.where(p[..., 2:] > 1.52, slate, wood)


def write_parts(path: Path, parts: list[Part], textures: list[np.ndarray]) -> None:
    """Write the mesh with 8-bit sRGB textures of linear values: y up, coordinates shifted (through trimesh)."""
    import trimesh
    from PIL import Image
    from trimesh.visual.material import PBRMaterial
    from trimesh.visual.texture import TextureVisuals

    scene = trimesh.Scene()
    for part, values in zip(parts, textures, strict=True):
        levels = np.rint(255.0 * srgb_from_linear(np.clip(values, 0.0, 1.0))).astype(np.uint8)
        material = PBRMaterial(name=part.name, baseColorTexture=Image.fromarray(levels), metallicFactor=0.0)
        east, north, up = part.vertices.T
        geometry = trimesh.Trimesh(
            np.stack([east, up, -north], axis=1) + np.array([31.0, 4.0, -52.0]),
            part.faces,
            process=False,
            visual=TextureVisuals(uv=part.uv, material=material),
        )
        scene.add_geometry(geometry, node_name=part.name, geom_name=part.name)
    path.write_bytes(scene.export(file_type="glb"))


# What brings the file's coordinates (x, −z, y) to the map's.
OFFSET = (SHIFT[0] - 31.0, SHIFT[1] - 52.0, SHIFT[2] - 4.0)


def path_traced_textures(
    parts: list[Part], light: Illumination, turn: np.ndarray, *, spp: int, seed: int = 0
) -> list[np.ndarray]:
    """Radiance ``(R, S, 3)`` [cd/m²] that leaves each texel, by Mitsuba's own path integrator; NaN off the surface.

    ``turn`` rotates map axes to true east and north, in which the light is given.
    """
    import drjit as dr
    import mitsuba as mi

    from seasonscapes.rendering.mitsuba_scene import mi_luminary, mi_sky

    members: dict = {"type": "scene", "sky": mi_sky(light.sky_radiance)}
    if light.sun is not None:
        members["sun"] = mi_luminary(light.sun)
    for part in parts:
        members[part.name] = _own_mesh(part, turn)
    size = mi.ScalarTransform4f().scale([400.0, 400.0, 1.0])
    grey = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [GROUND_BEYOND] * 3}}
    lower = mi.ScalarTransform4f().translate([0.0, 0.0, -0.002])
    members["beyond"] = {"type": "rectangle", "to_world": lower @ size, "bsdf": grey}
    scene = mi.load_dict(members)
    integrator = mi.load_dict({"type": "path", "max_depth": 8, "rr_depth": 64})
    pictures = []
    for number, part in enumerate(parts):
        texels = part.albedo.shape[0]
        position, face = texel_positions(part.terrain, texels, texels)
        known = face >= 0
        corner = part.vertices[part.faces[face[known]]]
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        normal = (normal / np.linalg.norm(normal, axis=1, keepdims=True)) @ turn.T
        start = (position[known] @ turn.T + 2e-3 * normal).astype(np.float32)
        total = np.zeros((len(start), 3))
        batch = max(1, (1 << 20) // spp)
        for first in range(0, len(start), batch):
            here = slice(first, first + batch)
            repeated = [np.repeat(values[here], spp, axis=0).astype(np.float32).T.copy() for values in (start, normal)]
            sampler = mi.load_dict({"type": "independent"})
            sampler.seed(seed + 1000 * number + first, repeated[0].shape[1])
            ray = mi.RayDifferential3f(mi.Point3f(*repeated[0]), -mi.Vector3f(*repeated[1]))
            radiance = integrator.sample(scene, sampler, ray)[0]
            dr.eval(radiance)
            values = np.array(radiance).T.reshape(-1, spp, 3)
            total[here] = values.mean(axis=1)
        picture = np.full((texels, texels, 3), np.nan)
        picture[known] = total
        pictures.append(picture)
    return pictures


def _own_mesh(part: Part, turn: np.ndarray):
    """A plain Mitsuba mesh with flat faces, a bitmap and Mitsuba's diffuse material on both sides."""
    import mitsuba as mi

    properties = mi.Properties()
    bitmap = {
        "type": "bitmap",
        "data": mi.TensorXf(np.ascontiguousarray(part.albedo[::-1])),
        "raw": True,
        "wrap_mode": "clamp",
    }
    properties["bsdf"] = mi.load_dict({"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": bitmap}})
    mesh = mi.Mesh(part.name, len(part.vertices), len(part.faces), has_vertex_texcoords=True, props=properties)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = (part.vertices @ turn.T).astype(np.float32).ravel()
    parameters["faces"] = part.faces.astype(np.uint32).ravel()
    # Row 0 of the flipped bitmap lies at v = 0.
    parameters["vertex_texcoords"] = part.uv.astype(np.float32).ravel()
    parameters.update()
    return mesh


def eight_bit(radiance: list[np.ndarray], unit: np.ndarray) -> list[np.ndarray]:
    """Linear values after storage in 8-bit sRGB, where ``unit`` ``(3,)`` [cd/m²] is white; seams are spread."""
    pictures = []
    for values in radiance:
        known = np.isfinite(values).all(axis=2)
        levels = np.rint(255.0 * srgb_from_linear(np.clip(np.nan_to_num(values) / unit, 0.0, 1.0)))
        pictures.append(_spread(linear_from_srgb(levels / 255.0), known))
    return pictures


def photographed(radiance: list[np.ndarray], light: Illumination) -> list[np.ndarray]:
    """The textures of a camera that balances white for the hour, and exposes half a per cent to white."""
    level = light.global_horizontal_lx / np.pi
    unit = level * np.nanpercentile(np.concatenate([(values / level).ravel() for values in radiance]), 99.5)
    return eight_bit(radiance, unit)


def mesh_suns(seed: int, folder: Path, *, scenes: int, texels: int = 96, spp: int = 64) -> dict[str, float]:
    """Suns of meshes of unknown hour: random rocks, days and hours; every third mesh stands under an even, overcast sky.

    Returns
    -------
    dict
        ``mesh_sun_found_rate`` (within 5° of azimuth and 4° of elevation), ``mesh_sun_wrong_trusted``, and
        ``mesh_overcast_trusted`` of ``mesh_overcast`` meshes without a sun.
    """
    import seasonscapes as ss
    from seasonscapes.rendering.backend import use_backend
    from seasonscapes.workflows.mesh_sun import mesh_sun
    from seasonscapes.workflows.meshes import mesh_light, mesh_transport

    use_backend()
    rng = np.random.default_rng(seed)
    around = ss.MeshSurroundings(sky="hosek", rays=64)
    placing = ss.MeshPlacing(up="y", crs=CRS, offset=OFFSET)
    source = folder / "unknown_hour.glb"
    found = wrong = overcast = overcast_trusted = 0
    for number in range(scenes):
        scene = int(rng.integers(1, 100_000))
        parts = make_parts(scene, texels=texels)
        write_parts(source, parts, [part.albedo for part in parts])
        blank = ss.load_mesh(source, placing)
        turn = blank.turn @ np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
        hour = f"2024-{rng.integers(3, 10):02d}-15T{rng.integers(6, 16):02d}:{rng.integers(0, 60):02d}Z"
        light = mesh_light(blank, hour, around)[0]
        sun = light.sun
        assert sun is not None
        if number % 3 == 2:
            even = np.broadcast_to(light.sky_radiance.mean(axis=(0, 1)), light.sky_radiance.shape)
            light = replace(light, sky_radiance=even.astype(np.float32), sun=None)
        write_parts(source, parts, photographed(path_traced_textures(parts, light, turn, spp=spp, seed=scene), light))
        mesh = ss.load_mesh(source, placing)
        result = mesh_sun(mesh, mesh_transport(mesh, around), latitude_deg=mesh.frame.latitude_deg)
        if light.sun is None:
            overcast, overcast_trusted = overcast + 1, overcast_trusted + result.trusted
            continue
        off = abs((result.azimuth_deg - sun.azimuth_deg + 180.0) % 360.0 - 180.0)
        good = off <= 5.0 and abs(result.elevation_deg - sun.elevation_deg) <= 4.0
        found, wrong = found + good, wrong + (result.trusted and not good)
    return {
        "mesh_sun_scenes": scenes - overcast,
        "mesh_sun_found_rate": found / (scenes - overcast),
        "mesh_sun_wrong_trusted": float(wrong),
        "mesh_overcast": overcast,
        "mesh_overcast_trusted": float(overcast_trusted),
    }


def mesh_relit(seed: int, folder: Path, *, texels: int = 192, spp: int = 256, rays: int = 256) -> dict[str, float]:
    """Lit at one hour → delit → relit at two others: PSNR [dB] of sRGB textures against the truth, texels on the surface.

    Returns
    -------
    dict
        The lower of the two hours: ``mesh_relit_psnr_db``, ``mesh_hour_off_psnr_db`` (a clock an hour wrong) and
        ``mesh_as_lit_psnr_db`` (the lit textures left as they are, exposed alike). ``mesh_uv_equal``: 1 where trimesh and
        pygltflib find the coordinates of the source again.
    """
    import seasonscapes as ss
    from seasonscapes.rendering.backend import use_backend
    from seasonscapes.workflows.meshes import mesh_light, mesh_transport

    use_backend()
    parts = make_parts(seed, texels=texels)
    source = folder / "source.glb"
    write_parts(source, parts, [part.albedo for part in parts])
    around = ss.MeshSurroundings(sky="hosek", rays=rays)
    placing = ss.MeshPlacing(up="y", crs=CRS, offset=OFFSET)
    blank = ss.load_mesh(source, placing)
    turn = blank.turn @ np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    taken, others = "2024-07-20T10:30Z", ("2024-07-20T06:30Z", "2024-07-20T15:30Z")
    lights = {time: mesh_light(blank, time, around)[0] for time in (taken, *others)}
    truth = {time: path_traced_textures(parts, light, turn, spp=spp, seed=seed) for time, light in lights.items()}
    lit = photographed(truth[taken], lights[taken])
    write_parts(source, parts, lit)
    mesh = ss.load_mesh(source, placing)
    transport = mesh_transport(mesh, around)
    delit = ss.delight_mesh(mesh, taken, surroundings=around, transport=transport)
    output = folder / "albedo.glb"
    ss.save_mesh(output, delit.mesh, facts=delit.facts)
    again = ss.load_mesh(output, placing)
    # A control: the clock an hour off.
    wrong = ss.delight_mesh(mesh, "2024-07-20T11:30Z", surroundings=around, transport=transport).mesh
    scores: dict[str, list[float]] = {"mesh_relit_psnr_db": [], "mesh_hour_off_psnr_db": [], "mesh_as_lit_psnr_db": []}
    for time in others:
        right, off = (
            ss.light_mesh(albedo, time, surroundings=around, transport=transport).radiance for albedo in (again, wrong)
        )
        for name, pictures in zip(scores, (right, off, lit), strict=True):
            scores[name].append(_psnr(list(zip(pictures, truth[time], strict=True))))
    numbers = {name: round(min(values), 2) for name, values in scores.items()}
    return numbers | {"mesh_uv_equal": float(_equal_uv(source, output))}


def _psnr(pairs: list[tuple[np.ndarray, np.ndarray]]) -> float:
    """PSNR of sRGB values after one common exposure: the scale is what an image of unknown exposure does not tell."""
    one = np.concatenate([values[np.isfinite(truth).all(axis=2)] for values, truth in pairs])
    other = np.concatenate([truth[np.isfinite(truth).all(axis=2)] for _, truth in pairs])
    unit = np.percentile(other, 99.5)
    scale = float(np.sum(other / unit) / np.sum(one / unit))
    difference = srgb_from_linear(one * scale / unit) - srgb_from_linear(other / unit)
    return float(-10.0 * np.log10(np.mean(difference**2)))


def _equal_uv(one: Path, other: Path) -> bool:
    """Whether trimesh and pygltflib read equal texture coordinates from both files."""
    import pygltflib
    import trimesh

    first, second = (trimesh.load_scene(path, process=False) for path in (one, other))
    equal = list(first.geometry) == list(second.geometry) and all(
        np.array_equal(first.geometry[name].visual.uv, second.geometry[name].visual.uv) for name in first.geometry
    )
    found = []
    for path in (one, other):
        document = pygltflib.GLTF2.load_binary(str(path))
        assert document is not None
        blob = document.binary_blob() or b""
        values = []
        for mesh in document.meshes:
            for primitive in mesh.primitives:
                accessor = document.accessors[primitive.attributes.TEXCOORD_0]
                view = document.bufferViews[accessor.bufferView]
                start = (view.byteOffset or 0) + (accessor.byteOffset or 0)
                values.append(blob[start : start + 8 * accessor.count])
        found.append(values)
    return equal and found[0] == found[1]
