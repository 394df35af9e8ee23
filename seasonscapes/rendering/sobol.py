"""Random numbers of a pixel: Sobol points, shuffled and scrambled by hashes of where they are used.

The k-th sample of a pixel draws, for each decision along its path, the k-th point of a two-dimensional Sobol sequence
of that decision's own: any 2ᵏ samples spread evenly over it, while decisions and pixels stay independent. There is no
state: a number depends on its key and index alone, so neither blocks nor threads change a picture.

Burley 2020, "Practical hash-based Owen scrambling", JCGT 9(4); second dimension after Ahmed 2024, "An implementation
algorithm of 2D Sobol sequence fast, elegant, and compact", doi:10.2312/sr.20241147.
"""

from __future__ import annotations

from typing import Any


def hashed(key: Any, word: Any) -> Any:
    """A key ``mi.UInt32`` from a key and one more word (Wellons' *lowbias32* over both); one to one in ``key``."""
    import mitsuba as mi

    bits = mi.UInt32(key) ^ (mi.UInt32(word) * mi.UInt32(0x9E3779B9))
    bits ^= bits >> 16
    bits *= mi.UInt32(0x7FEB352D)
    bits ^= bits >> 15
    bits *= mi.UInt32(0x846CA68B)
    return bits ^ (bits >> 16)


def uniform(key: Any) -> Any:
    """One number in [0, 1) from a key."""
    return _fraction(hashed(key, 0))


def sobol_pair(key: Any, index: Any) -> Any:
    """Point ``index`` of the Owen-scrambled, shuffled (0, 2)-sequence that belongs to ``key``, ``mi.Point2f``."""
    import drjit as dr
    import mitsuba as mi

    # In digit-reversed numbers a nested scramble is a permutation in which bits reach only higher ones.
    shuffled = dr.brev(_permuted(dr.brev(index), hashed(key, 1)))
    return mi.Point2f(
        _fraction(dr.brev(_permuted(shuffled, hashed(key, 2)))),
        _fraction(dr.brev(_permuted(_pascal(shuffled), hashed(key, 3)))),
    )


def _fraction(bits: Any) -> Any:
    """The 24 bits that float32 holds exactly, so that 1.0 is never reached."""
    import mitsuba as mi

    return mi.Float(bits >> 8) * (2.0**-24)


def _permuted(bits: Any, key: Any) -> Any:
    """Laine & Karras' hash with Vegdahl's constants (Burley 2020, section 2.2)."""
    import mitsuba as mi

    bits = bits ^ (bits * mi.UInt32(0x3D20ADEA))
    bits = bits + key
    bits = bits * ((key >> 16) | 1)
    bits = bits ^ (bits * mi.UInt32(0x05526C56))
    return bits ^ (bits * mi.UInt32(0x53A22864))


def _pascal(index: Any) -> Any:
    """The second Sobol dimension's digits, lowest bit first: Pascal's triangle modulo 2 times the index's bits."""
    import mitsuba as mi

    for shift, mask in ((1, 0x55555555), (2, 0x33333333), (4, 0x0F0F0F0F), (8, 0x00FF00FF), (16, 0x0000FFFF)):
        index = index ^ ((index >> shift) & mi.UInt32(mask))
    return index
