"""A place for Blender: the ground as GLB, the sky as EXR, and a script that puts sun, sky and camera of an hour to them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from seasonscapes.cameras.pinhole import Camera
from seasonscapes.export.axes import lamp_quaternion
from seasonscapes.export.gltf import lamp_colour
from seasonscapes.images import EXPOSURE_GAIN, SATURATION_LUMINANCE, atomic_path
from seasonscapes.sky.illumination import Luminary

GROUND_FILE, SKY_FILE, SCRIPT_FILE = "ground.glb", "sky.exr", "open_in_blender.py"

_SCRIPT = '''"""Opens a place in Blender with sun, sky and camera of one hour. Made by seasonscapes.

    blender --python open_in_blender.py
    blender --background --python open_in_blender.py -- --render picture.png

Lights are in lux and cd/m2 times SCENE["scale"], an exposure: Cycles clamps large values. There is no air in between.
"""

import json
import sys
from pathlib import Path

import bpy
from mathutils import Matrix, Quaternion

SCENE = json.loads(r"""
%s
""")
FOLDER = Path(__file__).resolve().parent


def add_ground():
    bpy.ops.import_scene.gltf(filepath=str(FOLDER / SCENE["ground"]))


def add_lamp(name, lamp):
    data = bpy.data.lights.new(name, "SUN")
    data.energy = lamp["normal_illuminance_lx"] * SCENE["scale"]
    data.color = lamp["colour"]
    data.angle = lamp["angular_diameter_rad"]
    place = bpy.data.objects.new(name, data)
    place.rotation_mode = "QUATERNION"
    x, y, z, w = lamp["rotation_xyzw"]
    place.rotation_quaternion = Quaternion((w, x, y, z))
    bpy.context.scene.collection.objects.link(place)


def add_sky():
    world = bpy.data.worlds.new("sky")
    if world.node_tree is None:  # before Blender 5
        world.use_nodes = True
    nodes = world.node_tree.nodes
    image = nodes.new("ShaderNodeTexEnvironment")
    image.image = bpy.data.images.load(str(FOLDER / SCENE["sky"]))
    background = next(node for node in nodes if node.type == "BACKGROUND")
    background.inputs["Strength"].default_value = SCENE["scale"]
    world.node_tree.links.new(image.outputs["Color"], background.inputs["Color"])
    bpy.context.scene.world = world


def add_camera(camera):
    data = bpy.data.cameras.new("camera")
    data.sensor_fit = "HORIZONTAL"
    data.sensor_width = camera["sensor_width_mm"]
    data.lens = camera["focal_length_mm"]
    data.shift_x, data.shift_y = camera["shift"]
    data.clip_start, data.clip_end = 1.0, 1e6
    place = bpy.data.objects.new("camera", data)
    place.matrix_world = Matrix(camera["world_from_camera"])
    scene = bpy.context.scene
    scene.collection.objects.link(place)
    scene.camera = place
    scene.render.resolution_x, scene.render.resolution_y = camera["size_px"]
    scene.render.resolution_percentage = 100
    scene.render.pixel_aspect_x, scene.render.pixel_aspect_y = camera["pixel_aspect"]


bpy.ops.wm.read_factory_settings(use_empty=True)
add_ground()
for name, lamp in SCENE["lamps"].items():
    add_lamp(name, lamp)
add_sky()
if SCENE["camera"]:
    add_camera(SCENE["camera"])
bpy.context.scene.render.engine = "CYCLES"
bpy.context.scene.cycles.samples = 256
if "--render" in sys.argv:
    bpy.context.scene.render.filepath = str(Path(sys.argv[sys.argv.index("--render") + 1]).resolve())
    bpy.ops.render.render(write_still=True)
'''


def exposure_scale(ev100: float) -> float:
    """Factor from radiance [cd/m²] to display-linear values, as the package's own tone curve begins."""
    return EXPOSURE_GAIN / (SATURATION_LUMINANCE * 2.0**ev100)


def blender_scene(lamps: dict[str, Luminary], camera: Camera | None, ev100: float, about: dict[str, Any]) -> dict:
    """The numbers of the script, in Blender's z-up axes (x east, y north).

    Parameters
    ----------
    lamps
        Sun and moon by name.
    camera
        A view in the frame of the terrain, if one is wanted.
    ev100
        Exposure.
    about
        Plain values about the place and the hour.
    """
    return {
        "about": about,
        "ground": GROUND_FILE,
        "sky": SKY_FILE,
        "scale": exposure_scale(ev100),
        "lamps": {name: _lamp(lamp) for name, lamp in lamps.items()},
        "camera": None if camera is None else _camera(camera),
    }


def _lamp(lamp: Luminary) -> dict:
    colour, lux = lamp_colour(lamp)
    return {
        "colour": colour,
        "normal_illuminance_lx": lux,
        "angular_diameter_rad": float(np.radians(2.0 * lamp.angular_radius_deg)),
        "rotation_xyzw": lamp_quaternion(lamp.direction),
        "azimuth_deg": lamp.azimuth_deg,
        "elevation_deg": lamp.elevation_deg,
    }


def _camera(camera: Camera) -> dict:
    width, sensor_mm = camera.width_px, 36.0
    # Blender's cameras look along -z with y up, and shifts are fractions of the width: positive ones move the view right
    # and up, the principal point left and down.
    pose = camera.world_from_camera @ np.diag([1.0, -1.0, -1.0, 1.0])
    aspect = [1.0, float(camera.fx / camera.fy)] if camera.fx >= camera.fy else [float(camera.fy / camera.fx), 1.0]
    return {
        "size_px": [width, camera.height_px],
        "sensor_width_mm": sensor_mm,
        "focal_length_mm": sensor_mm * float(camera.fx) / width,
        "shift": [
            (0.5 * width - float(camera.cx)) / width,
            (float(camera.cy) - 0.5 * camera.height_px) / width * float(camera.fx / camera.fy),
        ],
        "pixel_aspect": aspect,
        "world_from_camera": pose.tolist(),
    }


def blender_script(scene: dict) -> str:
    """The script's text for the values of `blender_scene`."""
    return _SCRIPT % json.dumps(scene, indent=1, default=float)


def write_blender_script(folder: Path, scene: dict) -> Path:
    """Write the script to a folder that holds ground and sky, atomically."""
    path = folder / SCRIPT_FILE
    with atomic_path(path) as temporary:
        temporary.write_text(blender_script(scene), encoding="utf-8")
    return path
