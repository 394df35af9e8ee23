"""Physically-based relighting of large mountain landscapes: any place, any date, any hour.

>>> import seasonscapes as ss
>>> place = ss.load_place("alpine_small")
>>> camera = ss.camera(place, "meadow", size_px=(48, 32))
>>> view = ss.render(place, camera, "2024-09-18T19:05", sky="hosek", spp=4)
>>> picture = ss.develop(view)

Names are imported from their modules when they are first used, so that ``import seasonscapes`` takes milliseconds.
"""

import importlib
from typing import Any

__version__ = "0.1.0"

# Public name to the module below `seasonscapes` that defines it.
_MODULES = {
    # places and views
    "load_place": "workflows.place",
    "Place": "workflows.place",
    "MeshOptions": "workflows.place",
    "camera": "workflows.views",
    "Viewpoint": "scene",
    "Camera": "cameras.pinhole",
    "Panorama": "cameras.panorama",
    "camera_path": "workflows.camera_paths",
    # light
    "sky_model": "workflows.illumination",
    "SkyModel": "sky.models",
    "illumination": "workflows.illumination",
    "Illumination": "sky.illumination",
    "sun_moon_position": "workflows.illumination",
    "dome_picture": "sky.report",
    # pictures
    "render": "workflows.view_rendering",
    "RenderedView": "rendering.radiance",
    "relight_session": "workflows.relight_session",
    "relight": "workflows.relight_session",
    "timelapse": "workflows.timelapse",
    "lit_texture": "workflows.received_light",
    "irradiance_map": "workflows.received_light",
    "show": "workflows.viewer",
    "PlaceView": "workflows.viewer",
    "export_scene": "workflows.export_scene",
    "ExportOptions": "workflows.export_scene",
    "textured_view": "workflows.view_rendering",
    "develop": "workflows.pictures",
    "srgb_from_linear": "images",
    "save_png": "workflows.pictures",
    "save_exr": "workflows.pictures",
    # photographs
    "Observation": "cameras.observation",
    "open_photographs": "workflows.photograph_files",
    "synthetic_photographs": "workflows.synthetic_photographs",
    "webcam_station": "workflows.webcam_calibration",
    "camera_station": "workflows.webcam_calibration",
    "Correspondences": "calibration.evidence",
    "calibrate": "workflows.webcam_calibration",
    "paint": "workflows.painting",
    "complete": "workflows.completion",
    "CompletionOptions": "texturing.completion",
    "Texture": "terrain.surface",
    "amplified": "terrain.amplification",
    # albedo
    "recover_albedo": "workflows.albedo_recovery",
    "RecoveryOptions": "workflows.albedo_recovery",
    "PaintedTexture": "workflows.recovery_methods",
    "scene_albedo": "workflows.albedo_sources",
    "load_albedo": "workflows.albedo_sources",
    "AlbedoSeries": "albedo.seasons",
    "predict_radiance": "workflows.predicted_radiance",
    "delight": "workflows.delighting",
    "differentiable_scene": "workflows.differentiable",
    "camera_hours": "workflows.unseen_hours",
    "CameraHours": "workflows.unseen_hours",
    "picture_clocks": "workflows.picture_clocks",
    "PictureClock": "workflows.picture_clocks",
    # meshes
    "load_mesh": "workflows.mesh_loading",
    "MeshPlacing": "terrain.mesh_placing",
    "MeshSurroundings": "workflows.meshes",
    "delight_mesh": "workflows.meshes",
    "light_mesh": "workflows.meshes",
    "render_mesh": "workflows.mesh_views",
    "save_mesh": "terrain.mesh_writing",
    # Gaussians
    "distil": "workflows.distillation",
    "DistilOptions": "workflows.distillation",
    "render_gaussians": "workflows.gaussian_views",
    # evaluation and files
    "score": "evaluation.metrics",
    "Workspace": "workspace",
    "InputError": "errors",
    "SeasonscapesError": "errors",
}

# One table of names; type checkers read the stub beside this file.
__all__ = ["__version__", *_MODULES]  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'seasonscapes' has no attribute {name!r}")
    value = getattr(importlib.import_module(f"seasonscapes.{_MODULES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
