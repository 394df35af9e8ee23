"""What ``seasonscapes albedo`` tells of a recovery."""

from __future__ import annotations

from datetime import UTC
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from seasonscapes.workflows.albedo_recovery import RecoveredAlbedo
    from seasonscapes.workflows.place import Place


def albedo_record(loaded: Place, recovered: RecoveredAlbedo, output: Path) -> dict[str, Any]:
    """The machine-readable record; writes the figures beside the output."""
    from seasonscapes.workflows import albedo_recovery as recovery

    times = sorted({each.observation.time for each in recovered.photographs})
    record: dict[str, Any] = {
        "output": str(output),
        "scene": loaded.scene.name,
        "photographs": len(recovered.photographs),
        "times_utc": [time.astimezone(UTC).isoformat() for time in times],
        "measured_share": float((recovered.estimate.source == 1).mean()),
        "completed_share": float((recovered.estimate.source == 2).mean()),
        "residual": [round(float(value), 4) for value in recovered.fit.residual],
        "cloudiness": [each.light.cloudiness for each in recovered.photographs],
        "gains": recovered.fit.gains.tolist(),
        **recovered.facts,
        "figures": recovery.save_albedo_figures(
            loaded, recovered.estimate, recovered.day, output, tilted=recovered.tilt is not None
        ),
        "attribution": loaded.scene.attribution,
    }
    if loaded.synthetic is not None:
        record |= recovery.error_against_truth(loaded, recovered)
    return record


def albedo_lines(record: dict[str, Any], recovered: RecoveredAlbedo) -> list[str]:
    """The record for people."""
    observations = [photograph.observation for photograph in recovered.photographs]
    lines = [
        f"{each.webcam:<16} {each.time:%Y-%m-%d %H:%M} UTC  residual {residual:.1%}"
        for each, residual in zip(observations, record["residual"], strict=True)
    ]
    lines.append(f"{record['measured_share']:.1%} of the texture measured, {record['completed_share']:.1%} completed")
    if "tilted_share" in record:
        lines.append(
            f"{record['tilted_share']:.1%} have normals from the pictures, tilted by {record['tilt_rms']:.2f} (rms)"
        )
    if "true_psnr_db" in record:
        error = f"{record['true_psnr_db']} dB, relative error {record['true_relative_error']:.1%}"
        lines.append(f"against the truth, where measured: {error}")
    return [*lines, record["output"], *record["figures"].values()]
