"""Sample points for path tracing: shuffled and Owen-scrambled Sobol points, keyed by hashes.

For each random decision along a path, the k-th sample of a pixel uses the k-th point of a two-dimensional Sobol
sequence that is scrambled independently per decision and pixel: aligned runs of 2ᵏ samples are stratified, decisions
and pixels are independent. The generator has no state. A number depends on its key and index alone, so that images do
not depend on the division into blocks or on threads.

Burley 2020, "Practical hash-based Owen scrambling", JCGT 9(4); second dimension after Ahmed 2024, "An implementation
algorithm of 2D Sobol sequence fast, elegant, and compact", doi:10.2312/sr.20241147; constants of the hash after Vegdahl
2021, "Building a better LK hash".
"""

from __future__ import annotations

from typing import Any

import numpy as np


def hashed(key: Any, word: Any) -> Any:
    """Hash a key and a word to a new key (Wellons' *lowbias32*), bijective in ``key``.

    Parameters
    ----------
    key, word
        ``mi.UInt32``, or integers for ``word``.

    Returns
    -------
    mi.UInt32
        The new key.
    """
    import mitsuba as mi

    bits = mi.UInt32(key) ^ (mi.UInt32(word) * mi.UInt32(0x9E3779B9))
    bits ^= bits >> 16
    bits *= mi.UInt32(0x7FEB352D)
    bits ^= bits >> 15
    bits *= mi.UInt32(0x846CA68B)
    return bits ^ (bits >> 16)


def uniform(key: Any) -> Any:
    """Return a uniform random number of a key.

    Parameters
    ----------
    key
        ``mi.UInt32``.

    Returns
    -------
    mi.Float
        In [0, 1).
    """
    return _fraction(hashed(key, 0))


def hash_to_unit(identity: np.ndarray, seed: int) -> np.ndarray:
    """Hash receiver indices to numbers in [0, 1), independently of the division into blocks (Wellons' *lowbias32*).

    Parameters
    ----------
    identity
        ``(N,)`` unsigned integers.
    seed
        Any integer.

    Returns
    -------
    numpy.ndarray
        ``(N,)`` float32.
    """
    bits = identity.astype(np.uint32) ^ np.uint32((seed * 2891336453 + 0x9E3779B9) % 2**32)
    for shift, factor in ((16, 0x7FEB352D), (15, 0x846CA68B)):
        bits = (bits ^ (bits >> np.uint32(shift))) * np.uint32(factor)
    return ((bits ^ (bits >> np.uint32(16))) >> np.uint32(8)).astype(np.float32) * np.float32(2.0**-24)


def sobol_pair(key: Any, index: Any) -> Any:
    """Return a point of the Owen-scrambled, shuffled (0, 2)-sequence of a key.

    Parameters
    ----------
    key
        ``mi.UInt32`` key of the sequence.
    index
        ``mi.UInt32`` index of the point.

    Returns
    -------
    mi.Point2f
        In [0, 1)².
    """
    import drjit as dr
    import mitsuba as mi

    # In bit-reversed numbers a nested scramble is a permutation in which bits affect only higher bits.
    shuffled = dr.brev(_permuted(dr.brev(index), hashed(key, 1)))
    return mi.Point2f(
        _fraction(dr.brev(_permuted(shuffled, hashed(key, 2)))),
        _fraction(dr.brev(_permuted(_pascal(shuffled), hashed(key, 3)))),
    )


def _fraction(bits: Any) -> Any:
    """Convert to [0, 1) with the 24 bits that float32 represents exactly, so that 1.0 does not occur."""
    import mitsuba as mi

    return mi.Float(bits >> 8) * (2.0**-24)


def _permuted(bits: Any, key: Any) -> Any:
    """Permute by Laine & Karras' hash (Burley 2020) with the constants of Vegdahl 2021."""
    import mitsuba as mi

    bits = bits ^ (bits * mi.UInt32(0x3D20ADEA))
    bits = bits + key
    bits = bits * ((key >> 16) | 1)
    bits = bits ^ (bits * mi.UInt32(0x05526C56))
    return bits ^ (bits * mi.UInt32(0x53A22864))


def _pascal(index: Any) -> Any:
    """Digits of the second Sobol dimension, lowest bit first: Pascal's triangle modulo 2 times the index's bits."""
    import mitsuba as mi

    for shift, mask in ((1, 0x55555555), (2, 0x33333333), (4, 0x0F0F0F0F), (8, 0x00FF00FF), (16, 0x0000FFFF)):
        index = index ^ ((index >> shift) & mi.UInt32(mask))
    return index
