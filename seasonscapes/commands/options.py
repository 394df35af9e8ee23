"""Flags about the place and its sky that several commands share, and the values that they stand for."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from cyclopts import Parameter

from seasonscapes.commands.outputs import check_output_folder, refuse_own_input

if TYPE_CHECKING:
    from seasonscapes.progress import Progress
    from seasonscapes.sky.models import SkyModel
    from seasonscapes.workflows.photograph_files import PhotographSources
    from seasonscapes.workflows.place import MeshOptions, Place
    from seasonscapes.workflows.recovery_plan import RecoveryPlan
    from seasonscapes.workspace import Workspace


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class PlaceOptions:
    """How to read a scene and build its terrain."""

    mesher: str | None = None
    """adaptive (error-bounded, default), grid (every sample), poisson (the screened Poisson surface, error-bounded)."""
    max_error_m: float | None = None
    """Vertical bound of the adaptive mesh in metres; default a tenth of the samples' spacing, at most 5."""
    refine: int | None = None
    """Interpolate the heights this many times finer first; default as far as it pays."""
    atlas: str | None = None
    """planar (top-down, default), relief (more texels on cliffs), xatlas (charts)."""
    texel_m: float | None = None
    """Side of a texel in metres; default as fine as the imagery."""
    workspace: Path | None = None
    """Folder for built artefacts; default SEASONSCAPES_WORKSPACE or the user's cache."""
    allow_outside: bool = False
    """Trust the scene: data and pictures outside its folder, any raster format, servers."""

    def folder(self) -> Workspace:
        """The workspace asked for; `InputError` where there is none and none can be made."""
        from seasonscapes.workspace import Workspace, default_workspace

        workspace = default_workspace() if self.workspace is None else Workspace(self.workspace)
        if not os.access(workspace.folder, os.R_OK | os.X_OK) or not workspace.folder.is_dir():
            check_output_folder(workspace.folder, flag="workspace" if self.workspace is None else "--workspace")
        return workspace

    def plan(self, scene: str, sources: PhotographSources) -> RecoveryPlan:
        """How finely to recover an albedo of a scene from photographs; see `plan_recovery`."""
        from seasonscapes.workflows.recovery_plan import plan_recovery

        return plan_recovery(
            scene, sources, texel_m=self.texel_m, workspace=self.folder(), allow_outside=self.allow_outside
        )

    def mesh(self, *, texel_m: float | None = None, albedo: Sequence[Path] = ()) -> MeshOptions:
        """How to build the terrain; ``texel_m`` is a command's own default.

        Albedo files bring the terrain and the atlas that they were made with, unless flags ask for others.
        """
        from seasonscapes.workflows.edited_textures import stated_mesh
        from seasonscapes.workflows.place import MeshOptions

        own = (self.mesher, self.max_error_m, self.refine, self.atlas, self.texel_m)
        stated = stated_mesh(albedo) if own == (None,) * 5 else None
        if stated is not None:
            return stated
        return MeshOptions(
            self.mesher or "adaptive",
            self.max_error_m,
            self.refine,
            self.atlas or "planar",
            texel_m if self.texel_m is None else self.texel_m,
        )

    def load(
        self,
        scene: str,
        progress: Progress | None = None,
        *,
        texel_m: float | None = None,
        albedo: Sequence[Path] = (),
        output: Path | None = None,
    ) -> Place:
        """The place of a scene file or bundled scene (see `mesh`), of whose files ``output`` must be none."""
        from seasonscapes.workflows.place import load_place

        place = load_place(
            scene,
            self.folder(),
            options=self.mesh(texel_m=texel_m, albedo=albedo),
            allow_outside=self.allow_outside,
            progress=progress,
        )
        if output is not None:
            refuse_own_input(output, (place.path, *place.scene.input_paths))
        return place


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class SkyOptions:
    """Which sky."""

    sky: str = "clear"
    """A sky model's name (clear, alpine_winter, hazy, saharan_dust, overcast, hosek) or file."""
    turbidity: float | None = None
    """Replace the model's haze: 1 is pure air, 3 clear, 6 hazy."""
    visibility_km: float | None = None
    """Replace the model's haze by the meteorological range."""
    ozone_du: float | None = None
    """Replace the model's ozone column, in Dobson units."""
    cloudiness: float | None = None
    """Share of the sky that clouds cover, 0 to 1."""

    def model(self) -> SkyModel:
        """The declared model with these flags applied."""
        from seasonscapes.sky.models import read_sky_model, with_overrides

        return with_overrides(
            read_sky_model(self.sky),
            turbidity=self.turbidity,
            visibility_km=self.visibility_km,
            ozone_du=self.ozone_du,
            cloudiness=self.cloudiness,
        )
