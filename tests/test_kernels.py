"""Dr.Jit compiles a kernel once: not again for where numpy's memory begins, for another number of pixels or another hour."""

from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
from test_rendering import heightfield, looking_down

from seasonscapes.frames import direction_from_angles
from seasonscapes.rendering.backend import aligned, point3, to_numpy, use_backend
from seasonscapes.rendering.coefficients import SamplingOptions
from seasonscapes.rendering.hemisphere_rays import ray_scene
from seasonscapes.rendering.mitsuba_scene import mi_mesh
from seasonscapes.rendering.relit_view import relight_view, relightable_view
from seasonscapes.rendering.transport import trace_view
from seasonscapes.sky.illumination import Luminary, uniform_sky


@contextmanager
def kernels():
    """A set that holds the hashes of all kernels that were launched, when it is left."""
    use_backend()
    import drjit as dr

    found: set[str] = set()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        yield found
        found |= {str(entry["hash"]) for entry in dr.kernel_history() if entry["type"] == dr.KernelType.JIT}


def test_arrays_begin_where_one_kernel_reads_them():
    with kernels() as found:
        import drjit as dr
        import mitsuba as mi

        memory = np.arange(120, dtype=np.float32)
        for first in range(8):
            values = memory[first : first + 100]
            assert aligned(values).ctypes.data % 64 == 0
            np.testing.assert_array_equal(np.array(mi.Float(aligned(values)) + dr.opaque(mi.Float, 1.0)), values + 1.0)
    assert len(found) == 1


@pytest.mark.parametrize("dtype", [np.float32, np.float16, np.uint32, bool])
def test_aligned_arrays_have_the_values(dtype):
    values = np.arange(12).reshape(3, 4)
    for given in (values, values.T, values[:, 1:], values[:0]):
        np.testing.assert_array_equal(aligned(given, dtype), given.astype(dtype))
        assert aligned(given, dtype).dtype == dtype


def test_vectors_come_back_without_a_kernel_for_their_number():
    with kernels() as found:
        import drjit as dr
        import mitsuba as mi

        for count in (5, 8, 33):
            values = np.random.default_rng(count).normal(size=(count, 3)).astype(np.float32)
            doubled = mi.Vector3f(point3(values)) * dr.opaque(mi.Float, 2.0)
            np.testing.assert_array_equal(to_numpy(doubled), 2.0 * values)
            one_axis = mi.Vector3f(mi.Float(aligned(values[:, 0])), 0.0, 1.0)
            np.testing.assert_array_equal(to_numpy(one_axis), np.c_[values[:, 0], np.zeros(count), np.ones(count)])
    assert len(found) <= 3


def test_another_size_and_hour_of_a_view_need_no_new_kernel():
    scene = ray_scene(mi_mesh(heightfield(lambda e, n: 40.0 * np.sin(e / 90.0), count=41), np.full(3, 0.3, np.float32)))
    options = SamplingOptions(rays=16, clusters=64, clusters_per_receiver=16)
    launched = []
    for size, azimuth_deg in ((16, 120.0), (21, 210.0), (16, 250.0)):
        sun = Luminary(direction_from_angles(azimuth_deg, 30.0), np.full(3, 9e4), 0.2665)
        with kernels() as found:
            view = relightable_view(scene, trace_view(scene, looking_down(size=size), options))
            relight_view(view, replace(uniform_sky(8000.0), sun=sun))
        launched.append(found)
    assert len(launched[0]) > 10
    assert launched[1] <= launched[0]
    assert launched[2] <= launched[0]
