"""Types of the public names; see ``__init__.py``."""

from seasonscapes.albedo.seasons import AlbedoSeries as AlbedoSeries
from seasonscapes.calibration.evidence import Correspondences as Correspondences
from seasonscapes.cameras.observation import Observation as Observation
from seasonscapes.cameras.panorama import Panorama as Panorama
from seasonscapes.cameras.pinhole import Camera as Camera
from seasonscapes.errors import InputError as InputError
from seasonscapes.errors import SeasonscapesError as SeasonscapesError
from seasonscapes.evaluation.metrics import score as score
from seasonscapes.images import srgb_from_linear as srgb_from_linear
from seasonscapes.rendering.radiance import RenderedView as RenderedView
from seasonscapes.scene import Viewpoint as Viewpoint
from seasonscapes.sky.illumination import Illumination as Illumination
from seasonscapes.sky.models import SkyModel as SkyModel
from seasonscapes.sky.report import dome_picture as dome_picture
from seasonscapes.terrain.surface import Texture as Texture
from seasonscapes.texturing.completion import CompletionOptions as CompletionOptions
from seasonscapes.workflows.albedo_recovery import RecoveryOptions as RecoveryOptions
from seasonscapes.workflows.albedo_recovery import recover_albedo as recover_albedo
from seasonscapes.workflows.albedo_sources import load_albedo as load_albedo
from seasonscapes.workflows.albedo_sources import scene_albedo as scene_albedo
from seasonscapes.workflows.camera_paths import camera_path as camera_path
from seasonscapes.workflows.completion import complete as complete
from seasonscapes.workflows.delighting import delight as delight
from seasonscapes.workflows.differentiable import differentiable_scene as differentiable_scene
from seasonscapes.workflows.distillation import DistilOptions as DistilOptions
from seasonscapes.workflows.distillation import distil as distil
from seasonscapes.workflows.gaussian_views import render_gaussians as render_gaussians
from seasonscapes.workflows.illumination import illumination as illumination
from seasonscapes.workflows.illumination import sky_model as sky_model
from seasonscapes.workflows.illumination import sun_moon_position as sun_moon_position
from seasonscapes.workflows.painting import paint as paint
from seasonscapes.workflows.photograph_files import open_photographs as open_photographs
from seasonscapes.workflows.pictures import develop as develop
from seasonscapes.workflows.pictures import save_exr as save_exr
from seasonscapes.workflows.pictures import save_png as save_png
from seasonscapes.workflows.place import MeshOptions as MeshOptions
from seasonscapes.workflows.place import Place as Place
from seasonscapes.workflows.place import load_place as load_place
from seasonscapes.workflows.predicted_radiance import predict_radiance as predict_radiance
from seasonscapes.workflows.received_light import irradiance_map as irradiance_map
from seasonscapes.workflows.received_light import lit_texture as lit_texture
from seasonscapes.workflows.relight_session import relight as relight
from seasonscapes.workflows.relight_session import relight_session as relight_session
from seasonscapes.workflows.synthetic_photographs import synthetic_photographs as synthetic_photographs
from seasonscapes.workflows.timelapse import timelapse as timelapse
from seasonscapes.workflows.view_rendering import render as render
from seasonscapes.workflows.view_rendering import textured_view as textured_view
from seasonscapes.workflows.views import camera as camera
from seasonscapes.workflows.webcam_calibration import calibrate as calibrate
from seasonscapes.workflows.webcam_calibration import camera_station as camera_station
from seasonscapes.workflows.webcam_calibration import webcam_station as webcam_station
from seasonscapes.workspace import Workspace as Workspace

__version__: str
__all__: list[str]
