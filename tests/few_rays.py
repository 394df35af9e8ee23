"""Light transport with few rays, for tests of what is done with it: the same code, a fraction of the time.

Processes of their own call `trace_few_rays`; tests in this one ask for the fixture `few_rays` of ``conftest.py``, which
takes it back.
"""

from __future__ import annotations

from collections.abc import Callable

MOST = {"shadow_samples": 4, "albedo_samples": 16, "rays": 64, "clusters": 512, "clusters_per_receiver": 32, "rank": 16}


def trace_few_rays() -> Callable[[], None]:
    """Bound every `SamplingOptions` from now on, and those that modules hold; returns what takes it back."""
    from seasonscapes.albedo import forward_model
    from seasonscapes.evaluation import synthetic_webcams
    from seasonscapes.rendering import grid_transport, transport
    from seasonscapes.rendering.coefficients import SamplingOptions

    checked, held = SamplingOptions.__post_init__, (synthetic_webcams.QUICK, forward_model.TEXEL_SAMPLING)
    before = [dict(vars(options)) for options in held]
    pilots = transport._PILOTS, grid_transport._PILOTS

    def bound(options: SamplingOptions) -> None:
        for name, most in MOST.items():
            object.__setattr__(options, name, min(getattr(options, name), most))
        checked(options)

    def take_back() -> None:
        SamplingOptions.__post_init__ = checked
        transport._PILOTS, grid_transport._PILOTS = pilots
        for options, values in zip(held, before, strict=True):
            for name, value in values.items():
                object.__setattr__(options, name, value)

    SamplingOptions.__post_init__ = bound
    transport._PILOTS = grid_transport._PILOTS = 1 << 14
    for options in held:
        bound(options)
    return take_back
