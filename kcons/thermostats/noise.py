"""Random numbers of a seed and a step; normal ones within kernels, those of NumPy's Philox generator to the last bit.

A stretch of the generator's stream belongs to each step and to each part of it, so that noise is a function of the seed
and of the number of the step; kernels draw it without coming back to Python.

References
----------
Salmon, Moraes, Dror and Shaw, Proc. SC11, 16 (2011) (Philox 4x64-10); Marsaglia and Tsang, J. Stat. Softw. 5, 8 (2000)
(ziggurat).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numba.np.random._constants import fi_double, ki_double, wi_double, ziggurat_nor_inv_r, ziggurat_nor_r

from kcons.constraints.compilation import njit

_M0, _M1 = np.uint64(0xD2E7470EE14C6C93), np.uint64(0xCA5A826395121157)
_W0, _W1 = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xBB67AE8584CAA73B)
_ZERO, _ONE, _EIGHT, _NINE, _ELEVEN = (np.uint64(k) for k in (0, 1, 8, 9, 11))
_LAYER, _FRACTION = np.uint64(0xFF), np.uint64(0x000FFFFFFFFFFFFF)


def noise_generator(key: tuple[int, int], number: int, part: int = 0) -> np.random.Generator:
    """A generator of numbers that are a function of a key, the number of a step and its part."""
    counter = np.array([0, 0, number, part], dtype=np.uint64)
    return np.random.Generator(np.random.Philox(key=np.array(key, dtype=np.uint64), counter=counter))


@intrinsic
def _high(typingctx, a, b):  # type: ignore[no-untyped-def]
    """The upper 64 bits of a product."""

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        wide = ir.IntType(128)
        product = builder.mul(*(builder.zext(each, wide) for each in args))
        return builder.trunc(builder.lshr(product, ir.Constant(wide, 64)), args[0].type)

    return types.uint64(types.uint64, types.uint64), codegen


_upper: Any = _high


@njit(cache=True, nogil=True)
def fill_normal(seed: Any, number: Any, part: Any, out: Any) -> None:
    """Fill a flat array with normal numbers of a part of a step; whole numbers below 2^64, as uint64."""
    words, block, drawn, i = np.empty(4, dtype=np.uint64), _ZERO, 4, 0
    # Bits are drawn in turn: a number takes those of its layer, and now and then more to be accepted or rejected.
    layer, size, x, y, stage = _ZERO, _ZERO, 0.0, 0.0, 0
    while i < out.size:
        if drawn == 4:
            drawn = 0
            block += _ONE
            a, b, c, d, k, q = block, _ZERO, number, part, seed, _ZERO
            for _ in range(10):
                a, b, c, d = _upper(_M1, c) ^ b ^ k, _M1 * c, _upper(_M0, a) ^ d ^ q, _M0 * a
                k += _W0
                q += _W1
            words[0], words[1], words[2], words[3] = a, b, c, d
        r = words[drawn]
        drawn += 1
        if stage == 0:
            layer, size = r & _LAYER, (r >> _NINE) & _FRACTION
            x = float(size) * wi_double[layer]
            if (r >> _EIGHT) & _ONE != _ZERO:
                x = -x
            if size < ki_double[layer]:
                out[i] = x
                i += 1
            else:
                stage = 1 if layer == _ZERO else 3
            continue
        share = float(r >> _ELEVEN) * (1.0 / 9007199254740992.0)
        if stage == 1:
            y, stage = -ziggurat_nor_inv_r * math.log1p(-share), 2
        elif stage == 2:
            stage, height = 1, -math.log1p(-share)
            if height + height > y * y:
                out[i] = -(ziggurat_nor_r + y) if (size >> _EIGHT) & _ONE != _ZERO else ziggurat_nor_r + y
                i, stage = i + 1, 0
        else:
            stage = 0
            if (fi_double[layer - _ONE] - fi_double[layer]) * share + fi_double[layer] < math.exp(-0.5 * x * x):
                out[i] = x
                i += 1


@njit(cache=True, nogil=True)
def fill_next(stream: Any, out: Any) -> None:
    """The same for the next part of the steps; `stream` has the halves of the seed, step, part, and parts of a step."""
    seed = (np.uint64(stream[0]) << np.uint64(32)) | np.uint64(stream[1])
    fill_normal(seed, np.uint64(stream[2]), np.uint64(stream[3]), out)
    stream[3] += 1.0
    if stream[3] == stream[4]:
        stream[3] = 0.0
        stream[2] += 1.0
