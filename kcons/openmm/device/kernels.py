"""Operations of a step as kernels: one text that OpenCL, CUDA, HIP and C++ compile.

Operations that nobody looks between are joined. What is left is cut where forces are evaluated, where a sum over all
particles is needed and, for constraints that stay with OpenMM, where its solvers come in; each piece is one kernel. A
work-item has a cluster of atoms that rows join, or a single atom; a work-group has a large cluster.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray

#: Platforms whose kernels are plain C++.
PLAIN = ("Reference", "CPU")
#: Work-groups of a kernel at most; each leaves its share of a sum in a place of its own.
MOST_GROUPS = 256
#: Sums over all particles: two times three that are used in turn, and that of the kinetic energy which is told.
_SUMS = 7


class Array(NamedTuple):
    """An array on the device, which kernels know by its name.

    Attributes
    ----------
    name : str
    kind : {'mixed', 'int'}
    values : ndarray
        What it begins with.
    saved : bool
        Whether it belongs to a state: checkpoints and States have it.
    """

    name: str
    kind: str
    values: FloatArray | IntArray
    saved: bool = False


class Shape(NamedTuple):
    """Clusters of atoms whose code is the same.

    Attributes
    ----------
    name : str
        Ending of the names of its functions; empty for single atoms.
    atoms : ndarray of int, shape (n_clusters, n)
    together : bool
        Whether a work-group has a cluster; else a work-item.
    n_rows : int
        Independent rows of a cluster.
    first : int
        Number of the first cluster among those of this name.
    """

    name: str
    atoms: IntArray
    together: bool = False
    n_rows: int = 0
    first: int = 0


_COMMON = """
#ifndef PLAIN
#define FORCE(f, p, c) (f[(p)+(c)*padded]*(1/(mixed) 0x100000000))
#define ORDER(p) order[p]
#define GET_V(a, p) {mixed4 q_ = velm[p]; v[3*(a)] = q_.x; v[3*(a)+1] = q_.y; v[3*(a)+2] = q_.z; w[a] = q_.w;}
#define PUT_V(a, p) velm[p] = make_mixed4(v[3*(a)], v[3*(a)+1], v[3*(a)+2], w[a]);
#define GET_D(a, p) {mixed4 q_ = delta[p]; d[3*(a)] = q_.x; d[3*(a)+1] = q_.y; d[3*(a)+2] = q_.z;}
#define PUT_D(a, p) delta[p] = make_mixed4(d[3*(a)], d[3*(a)+1], d[3*(a)+2], 0);
#ifdef USE_MIXED_PRECISION
#define GET_X(a, p) {real4 q_ = posq[p], r_ = correction[p]; x[3*(a)] = q_.x+(mixed) r_.x; \\
  x[3*(a)+1] = q_.y+(mixed) r_.y; x[3*(a)+2] = q_.z+(mixed) r_.z;}
#define PUT_X(a, p) {real4 q_ = make_real4((real) x[3*(a)], (real) x[3*(a)+1], (real) x[3*(a)+2], posq[p].w); \\
  posq[p] = q_; correction[p] = make_real4(x[3*(a)]-q_.x, x[3*(a)+1]-q_.y, x[3*(a)+2]-q_.z, 0);}
#else
#define GET_X(a, p) {real4 q_ = posq[p]; x[3*(a)] = q_.x; x[3*(a)+1] = q_.y; x[3*(a)+2] = q_.z;}
#define PUT_X(a, p) posq[p] = make_real4(x[3*(a)], x[3*(a)+1], x[3*(a)+2], posq[p].w);
#endif
#endif
#ifdef PLAIN
#define CLAIM(place, value) __sync_val_compare_and_swap(place, 0, value)
#elif defined(__OPENCL_VERSION__)
#define CLAIM(place, value) atomic_cmpxchg(place, 0, value)
#else
#define CLAIM(place, value) atomicCAS(place, 0, value)
#endif
/* The first failure is kept; kernels that are launched later do nothing. */
#define FAIL(row, residual) \\
  {if (CLAIM(&failure[0], launch+1) == 0) {failure[1] = step+1; failure[2] = row; failure_residual[0] = residual;}}
/* Four normal numbers of a particle, a step and a use within it (Philox 4x32 with 10 rounds, Box and Muller). */
DEVICE void philox(unsigned int* c, unsigned int key0, unsigned int key1) {
  for (int k = 0; k < 10; k++) {
    mm_ulong p = (mm_ulong) 0xD2511F53u*c[0], q = (mm_ulong) 0xCD9E8D57u*c[2];
    unsigned int first = (unsigned int) (q>>32)^c[1]^key0, third = (unsigned int) (p>>32)^c[3]^key1;
    c[0] = first; c[1] = (unsigned int) q; c[2] = third; c[3] = (unsigned int) p;
    key0 += 0x9E3779B9u; key1 += 0xBB67AE85u;
  }
}
DEVICE void gaussians(mixed* g, int particle, int step, int use, int seed) {
  unsigned int c[4];
  c[0] = particle; c[1] = step; c[2] = use; c[3] = 0;
  philox(c, (unsigned int) seed, 0x6b636f6eu);
  for (int k = 0; k < 4; k += 2) {
    float size = sqrt(-2.0f*log((c[k]+0.5f)*2.3283064e-10f)), angle = 6.2831853f*(c[k+1]*2.3283064e-10f);
    g[k] = size*cos(angle); g[k+1] = size*sin(angle);
  }
}
"""

_PLAIN = """
#include <math.h>
#include <algorithm>
#define PLAIN
#define USE_DOUBLE_PRECISION
using std::max; using std::min;
typedef double real, mixed;
typedef long mm_long;
typedef unsigned long mm_ulong;
struct real4 {double x, y, z, w;};
typedef real4 mixed4;
static inline real4 make_real4(double x, double y, double z, double w) {return real4{x, y, z, w};}
#define make_mixed4 make_real4
#define DEVICE static inline
#define KERNEL extern "C"
#define GLOBAL
#define LOCAL
#define LOCAL_ARG
#define RESTRICT
#define SYNC_THREADS
#define LOCAL_ID 0
#define LOCAL_SIZE 1
#define WG 1
#define GLOBAL_ID GROUP_ID
#define GLOBAL_SIZE NUM_GROUPS
#define FORCE(f, p, c) f[3*(p)+(c)]
#define ORDER(p) (p)
#define GET_3(to, a, from, p) {to[3*(a)] = from[3*(p)]; to[3*(a)+1] = from[3*(p)+1]; to[3*(a)+2] = from[3*(p)+2];}
#define GET_V(a, p) {GET_3(v, a, velocities, p) w[a] = inverse_masses[p];}
#define PUT_V(a, p) GET_3(velocities, p, v, a)
#define GET_X(a, p) GET_3(x, a, positions, p)
#define PUT_X(a, p) GET_3(positions, p, x, a)
#define GET_D(a, p) GET_3(d, a, delta, p)
#define PUT_D(a, p) GET_3(delta, p, d, a)
"""

_NUMBERS = ("dt", "time", "tolerance")
_BOX = ("box0", "box1", "box2")


def preamble(platform: str, arrays: Sequence[Array], scratch: int = 0, work_group: int = 64) -> str:
    """What comes before the source of rows: types and names of the platform, `ROWS`, `FAIL`, random numbers."""
    passed = [*(a for a in arrays if a.name in ("parameters", "failure", "failure_residual")), *_of_rows(arrays)]
    names = ["step", "launch", "tolerance", *_BOX, *(a.name for a in passed)]
    typed = ["int step", "int launch", "mixed tolerance", *(f"mixed4 {name}" for name in _BOX)]
    typed += [f"GLOBAL {a.kind}* RESTRICT {a.name}" for a in passed]
    if scratch:
        names.append("scratch")
        typed.append("LOCAL_ARG mixed* scratch")
    start = _PLAIN if platform in PLAIN else f"#define WG {work_group}\n"
    return (
        f"{start}#define MOST_GROUPS {MOST_GROUPS}\n#define ROWS {', '.join(typed)},\n"
        f"#define ROWS_PASS {', '.join(names)},\n{_COMMON}"
    )


def _of_rows(arrays: Sequence[Array]) -> list[Array]:
    return [array for array in arrays if array.name.startswith("rows_")]


def standard_arrays(
    parameters: Sequence[float] = (0.0,), memory: Sequence[float] = (0.0,), seed: int = 0
) -> list[Array]:
    """Arrays of every program: settings, what belongs to the state, failures, sums, what is read at the end."""
    return [
        Array("parameters", "mixed", np.array([*parameters, 0.0])),
        Array("memory", "mixed", np.array([*memory, 0.0]), saved=True),
        Array("memory_before", "mixed", np.zeros(len(memory) + 1)),
        Array("seed", "int", np.array([seed])),
        Array("failure", "int", np.zeros(3, dtype=np.int64)),
        Array("failure_residual", "mixed", np.zeros(1)),
        Array("partial", "mixed", np.zeros(_SUMS * MOST_GROUPS)),
        Array("looked", "mixed", np.zeros(3)),
    ]
