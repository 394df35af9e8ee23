"""The benchmark's scene in Blender Cycles. Runs in an environment of its own that has ``bpy`` (see `render.py`):

    python benchmarks/cycles_render.py FOLDER

reads what `render.py` wrote to FOLDER, prints ``ready {…}``, then answers each line ``SAMPLES SEED FILE`` of its input
with ``done {"seconds": …, "cpu_seconds": …}`` after writing the picture to FILE (``.npy``, float32 ``(H, W, 4)``).
"""

from __future__ import annotations

import json
import math
import os
import resource
import sys
import tempfile
import time
import warnings
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix


def cpu_seconds() -> float:
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


def float_image(name: str, values: np.ndarray) -> bpy.types.Image:
    """Linear values ``(H, W, 3)``, row 0 on top, as they are; Blender counts rows from below."""
    height, width = values.shape[:2]
    image = bpy.data.images.new(name, width, height, alpha=False, float_buffer=True, is_data=True)
    image.use_half_precision = False
    pixels = np.ones((height, width, 4), np.float32)
    pixels[..., :3] = values[::-1]
    image.pixels.foreach_set(pixels.ravel())
    image.update()
    return image


def add_terrain(files: np.lib.npyio.NpzFile) -> None:
    vertices, faces, uv = files["vertices"], files["faces"].astype(np.int32), files["uv"]
    mesh = bpy.data.meshes.new("terrain")
    mesh.vertices.add(len(vertices))
    mesh.vertices.foreach_set("co", vertices.ravel())
    mesh.loops.add(faces.size)
    mesh.loops.foreach_set("vertex_index", faces.ravel())
    mesh.polygons.add(len(faces))
    mesh.polygons.foreach_set("loop_start", np.arange(0, faces.size, 3, dtype=np.int32))
    mesh.update(calc_edges=True)
    mesh.uv_layers.new(name="atlas").uv.foreach_set("vector", uv[faces.ravel()].ravel())
    mesh.shade_smooth()
    material = bpy.data.materials.new("ground")
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    nodes.clear()
    texture, diffuse, output = (
        nodes.new(f"ShaderNode{kind}") for kind in ("TexImage", "BsdfDiffuse", "OutputMaterial")
    )
    texture.image, texture.interpolation, texture.extension = float_image("albedo", files["albedo"]), "Linear", "EXTEND"
    diffuse.inputs["Roughness"].default_value = 0.0  # Lambert
    links.new(texture.outputs["Color"], diffuse.inputs["Color"])
    links.new(diffuse.outputs["BSDF"], output.inputs["Surface"])
    mesh.materials.append(material)
    terrain = bpy.data.objects.new("terrain", mesh)
    # Neither of the others brightens grazing light to hide facets.
    terrain.shadow_terminator_geometry_offset = terrain.shadow_terminator_shading_offset = 0.0
    bpy.context.scene.collection.objects.link(terrain)


def add_light(files: np.lib.npyio.NpzFile, facts: dict) -> None:
    """A sky map in Blender's orientation (its first column is west) and a sun lamp of the disc's size."""
    scene = bpy.context.scene
    scene.world = bpy.data.worlds.new("sky")
    scene.world.use_nodes = True
    nodes, links = scene.world.node_tree.nodes, scene.world.node_tree.links
    nodes.clear()
    texture, background, output = (
        nodes.new(f"ShaderNode{kind}") for kind in ("TexEnvironment", "Background", "OutputWorld")
    )
    sky = files["sky"]
    texture.image = float_image("sky", np.roll(sky, sky.shape[1] // 4, axis=1))
    links.new(texture.outputs["Color"], background.inputs["Color"])
    links.new(background.outputs["Background"], output.inputs["Surface"])
    lamp = bpy.data.lights.new("sun", "SUN")
    illuminance = np.array(facts["sun_normal_illuminance"])
    lamp.energy, lamp.color = float(illuminance.max()), illuminance / illuminance.max()
    lamp.angle = math.radians(2.0 * facts["sun_angular_radius_deg"])
    sun = bpy.data.objects.new("sun", lamp)
    # A lamp shines along its own -z.
    z = np.array(facts["sun_direction"])
    x = np.cross([0.0, 0.0, 1.0], z) / np.linalg.norm(np.cross([0.0, 0.0, 1.0], z))
    sun.matrix_world = Matrix(np.vstack([np.c_[x, np.cross(z, x), z, np.zeros(3)], [0, 0, 0, 1]]).tolist())
    scene.collection.objects.link(sun)


def add_camera(facts: dict) -> None:
    scene = bpy.context.scene
    camera = bpy.data.cameras.new("camera")
    camera.sensor_fit, camera.angle = "HORIZONTAL", math.radians(facts["fov_deg"])
    camera.clip_start, camera.clip_end = 0.5, 1.0e6
    placed = bpy.data.objects.new("camera", camera)
    # Blender's cameras look along -z with y up, OpenCV's along +z with y down.
    placed.matrix_world = Matrix((np.array(facts["world_from_camera"]) @ np.diag([1.0, -1.0, -1.0, 1.0])).tolist())
    scene.collection.objects.link(placed)
    scene.camera = placed
    scene.render.resolution_x, scene.render.resolution_y = facts["width_px"], facts["height_px"]
    scene.render.resolution_percentage = 100


def set_up_cycles(facts: dict) -> None:
    """Every sample counts alike and none is embellished; what is not named stays as Cycles comes."""
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.render.threads_mode, scene.render.threads = "FIXED", facts["threads"]
    scene.render.film_transparent = True  # the sky lights the scene; its picture is not asked for
    scene.render.use_persistent_data = True  # keep the scene and its BVH between renders, as the others do
    scene.view_settings.view_transform = "Raw"
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.render.image_settings.color_depth = "32"
    scene.render.image_settings.color_mode = "RGBA"
    cycles = scene.cycles
    cycles.device, cycles.use_denoising, cycles.use_adaptive_sampling = "CPU", False, False
    cycles.sample_clamp_direct = cycles.sample_clamp_indirect = 0.0
    cycles.pixel_filter_type = "BOX"
    # Mitsuba counts edges from camera to light; Cycles counts scatterings after the first surface.
    cycles.max_bounces = cycles.diffuse_bounces = facts["max_depth"] - 2


def render(samples: int, seed: int) -> tuple[np.ndarray, dict]:
    """The picture ``(H, W, 4)`` with row 0 on top, and the time of the render call alone."""
    scene = bpy.context.scene
    scene.cycles.samples, scene.cycles.seed = samples, seed
    start, start_cpu = time.perf_counter(), cpu_seconds()
    bpy.ops.render.render()
    times = {"seconds": time.perf_counter() - start, "cpu_seconds": cpu_seconds() - start_cpu}
    with tempfile.TemporaryDirectory() as folder:
        path = os.path.join(folder, "picture.exr")
        bpy.data.images["Render Result"].save_render(path)
        picture = bpy.data.images.load(path)
        width, height = picture.size
        pixels = np.empty(width * height * 4, np.float32)
        picture.pixels.foreach_get(pixels)
        bpy.data.images.remove(picture)
    return pixels.reshape(height, width, 4)[::-1], times


def main(folder: Path) -> None:
    facts = json.loads((folder / "facts.json").read_text())
    start = time.perf_counter()
    warnings.simplefilter("ignore", DeprecationWarning)  # use_nodes: needed up to Blender 4, always on from 5
    bpy.ops.wm.read_factory_settings(use_empty=True)
    with np.load(folder / "scene.npz") as files:
        add_terrain(files)
        add_light(files, facts)
    add_camera(facts)
    set_up_cycles(facts)
    print("ready", json.dumps({"version": bpy.app.version_string, "seconds": time.perf_counter() - start}), flush=True)
    for line in sys.stdin:
        samples, seed, path = line.split(maxsplit=2)
        picture, times = render(int(samples), int(seed))
        np.save(path.strip(), picture)
        print("done", json.dumps(times), flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
