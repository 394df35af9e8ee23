"""Flags that do something only beside others: one that would be ignored is refused before anything is built.

What only the scene can tell (whether there are several dated albedos, whether it is synthetic) the commands check themselves.
"""

from __future__ import annotations

from collections.abc import Sequence

from seasonscapes.commands.flag_rules import Condition, Given, beside, given_flags, named, no, written_as
from seasonscapes.errors import InputError


def _regression(given: Given) -> bool:
    """Whether `inpaint` completes by regression, and not by fusion with an albedo."""
    method = given.get("--method", "guided")
    return method == "diffusion" or (method == "guided" and "--albedo" not in given)


_DIFFUSION = (
    *("--path", "--weights", "--base", "--depth-net", "--inpaint-net", "--adapter", "--prompt", "--guide-image", "--hybrid"),
    *("--strength", "--steps", "--guidance", "--without", "--mask", "--dilate-px", "--least-hole", "--paint-sky"),
    *("--frames", "--film", "--fps", "--device", "--dtype", "--offload"),
)  # fmt: skip
_SKY = ("--sky", "--turbidity", "--visibility-km", "--ozone-du", "--cloudiness")
_TERRAIN = ("--mesher", "--max-error-m", "--refine", "--atlas", "--texel-m")
_VIEW = ("--camera", "--at", "--heading", "--pitch", "--fov", "--size")

_BOUND = Condition(
    ("--max-error-m",), "a mesher with a bound (adaptive, poisson)", lambda given: given.get("--mesher") != "grid"
)
_POSITION = Condition(("--heading", "--pitch", "--fov"), "--at", beside("--at"))
_STEP = Condition(("--every",), "--from and --to", beside("--from"))
_BALANCE = Condition(("--white-balance",), "--look photo", named("--look", "photo", default="photo"))
_SYNTHETIC = (
    Condition(("--leave-out", "--size"), "--synthetic-webcams", beside("--synthetic-webcams")),
    Condition(
        ("--manifest", "--calibrations", "--masks", "--within-min", "--doubtful-poses"),
        "real photographs, which --synthetic-webcams leaves out",
        no("--synthetic-webcams"),
    ),
)

CONDITIONS: dict[str, tuple[Condition, ...]] = {
    "render": (
        _POSITION,
        _BALANCE,
        Condition(("--white-balance",), "a .png output", written_as(".png", default="a.png")),
    ),
    "timelapse": (
        Condition(
            (*_VIEW, "--every", "--smooth", "--exr", "--keep-frames", "--cluster", "--shard"),
            "a fixed camera, which --path replaces",
            no("--path"),
        ),
        _POSITION,
        _BALANCE,
        _STEP,
        Condition(("--fps",), "an .mp4 output", written_as(".mp4", default="a.mp4")),
        Condition(
            ("--fps", "--smooth", "--exposure", "--look", "--white-balance", "--keep-frames"),
            "a film, which --shard does not make",
            no("--shard"),
        ),
    ),
    "lit-texture": (
        Condition(("--exposure",), "an output that is exposed (.png, .glb)", written_as(".png", ".glb", default="a.png")),
    ),
    "irradiance": (_STEP,),
    "relight": (_BALANCE, _STEP, Condition(("--fps",), "an .mp4 output", written_as(".mp4", default="a.png"))),
    "sky": (Condition(_TERRAIN, "a scene, in place of --at", no("--at")),),
    "export": (Condition(("--every",), "--day", beside("--day")),),
    "paint": _SYNTHETIC,
    "albedo": (
        Condition(("--size",), "--synthetic-webcams", beside("--synthetic-webcams")),
        _SYNTHETIC[1],
        Condition(
            ("--fit-haze",),
            "--method closed: differentiable finds the haze itself",
            named("--method", "closed", default="closed"),
        ),
        Condition(("--normals",), "--method closed", named("--method", "closed", default="closed")),
        Condition(
            ("--calibrations", "--masks", "--within-min", "--doubtful-poses"),
            "photographs, of which --painted alone has none",
            lambda given: "--manifest" in given or "--times" in given or "--painted" not in given,
        ),
    ),
    "inpaint": (
        Condition(_DIFFUSION, "--method diffusion", named("--method", "diffusion", default="guided")),
        Condition(("--fps",), "--film", beside("--film")),
        Condition(("--adapter",), "--guide-image", beside("--guide-image")),
        Condition(
            ("--fast",),
            "--method telea or diffusion, or guided without --albedo",
            lambda given: _regression(given) or given.get("--method") == "telea",
        ),
        Condition(
            ("--detail", "--seed"),
            "a method without fusion: guided fuses where there is an --albedo",
            lambda given: given.get("--method", "guided") != "guided" or "--albedo" not in given,
        ),
        Condition(_VIEW, "--figures", beside("--figures")),
        Condition(
            _SKY,
            "--albedo, --figures or --method diffusion",
            lambda given: "--albedo" in given or "--figures" in given or given.get("--method") == "diffusion",
        ),
        _POSITION,
    ),
    "path": (
        Condition(("--kind",), "--reference", beside("--reference")),
        Condition(("--fov",), "--via", beside("--via")),
    ),
    "splat": (
        _POSITION,
        _BALANCE,
        Condition(("--size", "--subpixels", "--device"), "a picture", lambda given: not written_as(".ply", ".glb", default="a.png")(given)),
        Condition(("--look", "--white-balance"), "a .png output", written_as(".png", default="a.png")),
    ),
    "run": (
        _POSITION,
        Condition(
            ("--photo-kind", "--photo-size", "--leave-out"), "a synthetic scene, without --manifest", no("--manifest")
        ),
        Condition(("--calibrations", "--within-min", "--doubtful-poses"), "--manifest", beside("--manifest")),
    ),
}  # fmt: skip


def conditions_of(verb: str) -> tuple[Condition, ...]:
    """The conditions on a verb's flags, with those that all verbs about terrain share."""
    return (*CONDITIONS.get(verb, ()), _BOUND)


def check_flags(tokens: Sequence[str]) -> None:
    """`InputError` about the first flag of a command line ``VERB …`` that would be ignored beside the others."""
    given = given_flags(tokens[1:])
    if "--help" in given or "-h" in tokens:
        return
    for condition in conditions_of(tokens[0] if tokens else ""):
        for flag in condition.flags:
            if flag in given and not condition.holds(given):
                raise InputError(flag, f"does nothing without {condition.needs}", got=given[flag] or None)
