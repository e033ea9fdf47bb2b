"""Operations of a step as kernels: one text that OpenCL, CUDA, HIP and C++ compile.

Operations that nobody looks between are joined. What is left is cut where forces are evaluated and where a sum over all
particles is needed; each piece is one kernel.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, UnsupportedError
from kcons.openmm.device.clusters import Array, Shape

#: Platforms whose kernels are plain C++.
PLAIN = ("Reference", "CPU")
#: Work-groups of a kernel at most; each leaves its share of a sum in a place of its own.
MOST_GROUPS = 256
_NONE = np.zeros(0, dtype=np.int64)
#: Sums over all particles: two times three that are used in turn, and that of the kinetic energy which is told.
_SUMS = 7


_COMMON = """
#ifndef PLAIN
#define FORCE(f, p, c) (f[(p)+(c)*padded]*(1/(mixed) 0x100000000))
#define ORDER(p) order[p]
#define GET_V(a, p) {mixed4 q_ = velm[p]; v[3*(a)] = q_.x; v[3*(a)+1] = q_.y; v[3*(a)+2] = q_.z; w[a] = q_.w;}
#define PUT_V(a, p) velm[p] = make_mixed4(v[3*(a)], v[3*(a)+1], v[3*(a)+2], w[a]);
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
/* Some compilers for OpenCL leave short loops and functions as they are, and the arrays in them in memory. */
#ifdef __OPENCL_VERSION__
#define INLINED DEVICE __attribute__((always_inline))
#define UNROLLED _Pragma("unroll")
#else
#define INLINED DEVICE
#define UNROLLED
#endif
#define XYZ UNROLLED for (int c = 0; c < 3; c++)
#define AWAY(a, cell, sign) {mixed n_[3]; XYZ n_[c] = sign (cell)[c]; ROWS_SHIFT((x+3*(a)), n_)}
/* In double precision Newton's last turn has all digits. */
#ifdef USE_DOUBLE_PRECISION
#define HELD_TO min(tolerance, (mixed) 1e-13)
#else
#define HELD_TO tolerance
#endif
#define RESTS(p) ((p) < 0 ? -1-(p) : (p))
#define TINY ((mixed) 1e-37f)
/* The first failure is kept; kernels that are launched later do nothing. */
#define FAIL(row, residual) \\
  {if (CLAIM(&failure[0], launch+1) == 0) {failure[1] = step+1; failure[2] = row; looked[5] = residual;}}
/* Four normal numbers of a particle, a step and a use within it (Philox 4x32, Box and Muller): an angle is a quarter of
   the circle and what is left of it, from -pi/4 to pi/4, of which sine and cosine are polynomials. CUDA's fast
   logarithm of a number just below 1 may be positive. */
DEVICE void gaussians(mixed* g, int particle, int step, int use, int seed) {
  unsigned int c0 = particle, c1 = step, c2 = use, c3 = 0, key0 = seed, key1 = 0x6b636f6eu;
  for (int k = 0; k < 10; k++) {
    mm_ulong p = (mm_ulong) 0xD2511F53u*c0, q = (mm_ulong) 0xCD9E8D57u*c2;
    c0 = (unsigned int) (q>>32)^c1^key0; c1 = (unsigned int) q;
    c2 = (unsigned int) (p>>32)^c3^key1; c3 = (unsigned int) p;
    key0 += 0x9E3779B9u; key1 += 0xBB67AE85u;
  }
  for (int k = 0; k < 4; k += 2) {
    unsigned int turn = k ? c3 : c1;
    float size = sqrt(max(-2.0f*log(((k ? c2 : c0)+0.5f)*2.3283064e-10f), 0.0f));
    float t = (int) (turn<<2)*3.6572952e-10f, t2 = t*t;
    float sine = size*t*(1+t2*(-1.6666667e-1f+t2*(8.3333333e-3f-t2*1.9841270e-4f)));
    float cosine = size*(1+t2*(-0.5f+t2*(4.1666667e-2f+t2*(-1.3888889e-3f+t2*2.4801587e-5f))));
    if (turn>>31) cosine = -cosine;
    g[k] = (turn>>30)&1 ? sine : cosine; g[k+1] = (turn>>30)&1 ? cosine : sine;
  }
}
"""

_PLAIN = """
#include <math.h>
#define PLAIN
#define USE_DOUBLE_PRECISION
template <class T> static inline T max(T a, T b) {return a > b ? a : b;}
template <class T> static inline T min(T a, T b) {return a < b ? a : b;}
typedef double real, mixed;
typedef unsigned long mm_ulong;
struct real4 {double x, y, z;};
typedef real4 mixed4;
#define DEVICE static inline
#define KERNEL extern "C"
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
struct Numbers {int step, launch; double dt, time, tolerance; real4 box0, box1, box2;};
#define UNPACK_NUMBERS int step = given->step, launch = given->launch; double dt = given->dt, time = given->time; \\
  double tolerance = given->tolerance; real4 box0 = given->box0, box1 = given->box1, box2 = given->box2;
"""

#: What kernels are given besides arrays of their own, in the order in which the plugin gives it.
_GIVEN = (
    "int padded, int step, int launch, mixed dt, mixed time, mixed tolerance, mixed4 box0, mixed4 box1, mixed4 box2",
    "GLOBAL real4* RESTRICT posq, GLOBAL real4* RESTRICT correction, GLOBAL mixed4* RESTRICT velm",
    "GLOBAL const int* RESTRICT order",
)
#: Arrays that functions of rows have, too.
_PASSED = ("parameters", "failure", "looked")


def preamble(platform: str, arrays: Sequence[Array], scratch: int = 0, work_group: int = 64, slots: int = 1) -> str:
    """What comes before the source of rows: types and names of the platform, `ROWS`, `FAIL`, random numbers."""
    plain, arrays = platform in PLAIN, [array for array in arrays if array.passed]
    typed = ["int step", "int launch", "mixed tolerance", "mixed4 box0", "mixed4 box1", "mixed4 box2"]
    typed += [f"GLOBAL {a.kind}* {a.name}" for a in arrays if a.name in _PASSED or a.name.startswith("rows_")]
    typed += ["LOCAL_ARG mixed* scratch"] * (scratch > 0)
    names = [each.split()[-1].replace("tolerance", "HELD_TO") for each in typed]
    forces = [f"force{k}" for k in range(slots)]
    if plain:
        given = "void** pointers, const Numbers* given, int GROUP_ID, int NUM_GROUPS"
        own = [("mixed", name) for name in ("positions", "velocities", "inverse_masses", *forces)]
        own += [(array.kind, array.name) for array in arrays]
        pointers = [f"{kind}* {name} = ({kind}*) pointers[{k}];" for k, (kind, name) in enumerate(own)]
        unpack = f"UNPACK_NUMBERS {' '.join(pointers)}"
    else:
        alone = "" if scratch else "RESTRICT "  # items of a group read what others have written
        own_arrays = [f"GLOBAL {array.kind}* {alone}{array.name}" for array in arrays]
        given = ", ".join([*_GIVEN, *(f"GLOBAL const mm_long* RESTRICT {name}" for name in forces), *own_arrays])
        unpack = ""
    words = dict.fromkeys(("GLOBAL", "LOCAL", "LOCAL_ARG", "RESTRICT", "SYNC_THREADS") if plain else (), "")
    words |= {
        "MOST_GROUPS": str(MOST_GROUPS),
        "ARGUMENTS": given,
        "UNPACK": unpack,
        "SCRATCH": f" LOCAL mixed scratch[{scratch}];" if scratch else "",
        "ROWS": f"{', '.join(typed)},",
        "ROWS_PASS": f"{', '.join(names)},",
    }
    start = _PLAIN if plain else f"#define WG {work_group}\n"
    return start + "".join(f"#define {word} {text}\n" for word, text in words.items()) + _COMMON


def standard_arrays(parameters: Sequence[float] = (), memory: int = 0, seed: int = 0, n: int = 1) -> list[Array]:
    """Arrays of every program: settings, what belongs to the state, failures, sums, what is read at the end."""
    return [
        Array("parameters", "mixed", np.array([*parameters, 0.0])),
        Array("memory", "mixed", np.zeros(memory + 1), saved=True),
        Array("memory_before", "mixed", np.zeros(memory + 1)),
        Array("seed", "int", np.array([seed]), saved=True),
        Array("failure", "int", np.zeros(3, dtype=np.int64)),
        Array("partial", "mixed", np.zeros(_SUMS * MOST_GROUPS)),
        Array("kept", "mixed", np.zeros(3 * n)),
        Array("looked", "mixed", np.zeros(7)),
    ]


# -- operations ---------------------------------------------------------------------------------------


class Op(NamedTuple):
    """An operation as plain data: its verb, the fraction of the step that it is over, and whose forces.

    `flights` are fractions too: RATTLE drifts, or parts of a chain; `ends` are when they end, or other operations are.
    `begun` is 0 in the step that is being made, -1 in the one before; `use` the number of its noise within the step.
    """

    verb: str
    share: float = 0.0
    group: str = ""
    flights: tuple[float, ...] = ()
    ends: tuple[float, ...] = ()
    begun: int = 0
    use: int = 0


def divided(operations: Sequence[Op], noisy: bool) -> tuple[list[Op], list[Op], list[Op]]:
    """Head, middle and tail of a step: up to its last evaluation of forces, joined with the next step, and its end."""
    uses = iter(range(len(operations)))
    ops = [op._replace(use=next(uses)) if op.verb == "exchange" else op for op in operations]
    last, flown = (max((k for k, op in enumerate(ops, 1) if op.verb == v), default=0) for v in ("evaluate", "fly"))
    if not last:
        raise UnsupportedError("a step on the device evaluates forces at its end; the leapfrog does not")
    head, tail, note = ops[:last], [op._replace(begun=-1) for op in ops[last:]], [Op("note")] * noisy
    if all(op.verb in ("evaluate", "project") for op in ops[flown:last]):
        # Nothing changes v before: only the end of a call has to take the sum.
        return joined(head), joined([*tail, *head]), joined([*note, *tail])
    head = [*head[:flown], *note, *head[flown:]]
    return joined(head), joined([*tail, *head]), joined(tail)


def joined(operations: Sequence[Op]) -> list[Op]:
    """The same with fewer operations, where nobody sees what is between them."""
    done: list[Op] = []
    for k, op in enumerate(operations):
        after = next((later.verb for later in operations[k + 1 :] if later.verb != "kick"), "")
        if op.verb == "project" and (after == "fly" or (done and done[-1].verb == "turn")):
            continue  # the drift absorbs what v has across the rows; turned velocities are tangent
        if done and done[-1][0:3:2] == op[0:3:2] and op.verb in ("kick", "turn"):
            done[-1] = done[-1]._replace(share=done[-1].share + op.share)
        elif done and done[-1].verb == op.verb == "chain":
            done[-1] = done[-1]._replace(flights=(*done[-1].flights, *op.flights))
        else:
            done.append(op)
    return done


# -- kernels ------------------------------------------------------------------------------------------

_SUM = """ SYNC_THREADS;
 if (LOCAL_ID < 8) for (int k = 0; k < COUNT*WG; k += WG) for (int j = LOCAL_ID+8; j < WG; j += 8)
  shared[LOCAL_ID+k] += shared[j+k];
 SYNC_THREADS;
 if (LOCAL_ID == 0) for (int k = 0; k < COUNT*WG; k += WG) for (int j = 1; j < min(8, WG); j++)
  shared[k] += shared[j+k];
"""


def _summed(names: Sequence[str]) -> str:
    """Sums over a work-group of what its items have added to some numbers, ``shared[k*WG]`` for its first item."""
    stored = "".join(f" shared[LOCAL_ID+{k}*WG] = {name};" for k, name in enumerate(names))
    return stored + _SUM.replace("COUNT", str(len(names)))


def _once(code: str, *names: str) -> str:
    """Numbers that one item computes for all of its work-group."""
    stored = "".join(f" shared[{k}] = {name};" for k, name in enumerate(names))
    read = "".join(f" mixed {name} = shared[{k}];" for k, name in enumerate(names))
    return f" if (LOCAL_ID == 0) {{\n{code}{stored}}}\n SYNC_THREADS;{read}\n SYNC_THREADS;\n"


#: The closed form of `kcons.thermostats.isokinetic`, everything divided by exp(z).
_CLOSED_FORM = """ mixed sum0 = shared[0], sum1 = shared[WG], sum2 = shared[2*WG];
 mixed z = max((mixed) sqrt(sum1/P_two_k), TINY), decay = exp(-z);
 mixed aim = sum0/sqrt(max((mixed) (sum2*sum1), TINY));
 aim = min(max(aim, (mixed) -1), (mixed) 1);
 mixed sinhc = -expm1(-2*z)/(2*z), root = -expm1(-z)/z, scale = max((mixed) (aim*z*sinhc+(1+decay*decay)/2), TINY);
 mixed keep = sqrt(P_two_k/sum2)*decay/scale, push = (aim*z*root*root/2+sinhc)/scale;
 if (GROUP_ID == 0) {memory[M_growth] += z+log(scale); if (scale < (mixed) 1e-4f) memory[M_lost] += 1;}
"""
#: Half a push of all links, the first of which then scales velocities, and half a push; see `kcons.openmm.NoseHoover`.
_CHAIN = """ mixed sum = shared[0], link[LINKS], factor = 1, place = memory_before[M_chain_place];
 mixed inertia = P_kT/(P_frequency*P_frequency);
 const mixed parts[PARTS] = {SHARES};
 for (int k = 0; k < LINKS; k++) link[k] = memory_before[M_link1+k];
 for (int part = 0; part < PARTS; part++) {
  mixed h = parts[part]*dt;
  for (int turn = 0; turn < 2*LINKS; turn++) {
   int k = turn < LINKS ? LINKS-1-turn : turn-LINKS;
   if (turn == LINKS) {
    factor *= exp(-h*link[0]); place += h*P_momenta*link[0];
    for (int j = 1; j < LINKS; j++) place += h*link[j];
   }
   mixed damp = k+1 < LINKS ? exp(-h*link[k+1]/4) : (mixed) 1, push;
   if (k == 0) push = (sum*factor*factor-P_momenta*P_kT)/(P_momenta*inertia);
   else push = ((k == 1 ? P_momenta : (mixed) 1)*inertia*link[k-1]*link[k-1]-P_kT)/inertia;
   link[k] = (link[k]*damp+h*push/2)*damp;
  }
 }
 if (GROUP_ID == 0) {
  for (int k = 0; k < LINKS; k++) memory[M_link1+k] = link[k];
  memory[M_chain_place] = place;
 }
"""
#: What the last call did: whether velocities are finite, the kinetic energy that is told, a failure.
_LOOK = f"""KERNEL void look(ARGUMENTS) {{
 UNPACK LOCAL mixed shared[4*WG];
 mixed acc0 = 0, acc1 = 0, acc2 = 0;
 if (GROUP_ID != 0) return;
 for (int p = LOCAL_ID; p < PARTICLES; p += LOCAL_SIZE) {{
  mixed v[3], w[1];
  GET_V(0, p)
  acc0 += v[0]*v[0]+v[1]*v[1]+v[2]*v[2];
  if (w[0] != 0) acc2 += (v[0]*v[0]+v[1]*v[1]+v[2]*v[2])/w[0];
 }}
 for (int k = LOCAL_ID; k < MOST_GROUPS; k += LOCAL_SIZE) acc1 += partial[k+6*MOST_GROUPS];
{_summed(["acc0", "acc1", "acc2"])} if (LOCAL_ID == 0) {{
  looked[0] = shared[0]; looked[1] = NOTED; looked[6] = shared[2*WG];
  for (int k = 0; k < 3; k++) looked[2+k] = failure[k];
 }}
}}
"""

#: What is kept of some particles, whose places come last in `atoms`, until the host reads it; `step` counts records.
_RECORD = """KERNEL void record(ARGUMENTS) {
 UNPACK
 if (failure[0] != 0) return;
 GLOBAL mixed* to = records+9*COUNT*step;
 for (int k = GLOBAL_ID; k < COUNT; k += GLOBAL_SIZE) {
  mixed x[3], v[3], w[1];
  int p = atoms[FIRST+k];
  GET_V(0, p) GET_X(0, p)
  XYZ {to[9*k+c] = x[c]; to[9*k+3+c] = v[c]; to[9*k+6+c] = FORCES;}
 }
}
"""


#: What happens on the spheres of a cluster, see `kcons.thermostats.sphere_kernels`: component c of an atom is
#: its part of the center of mass, which is on sphere OF[c], and the rest on OF[3]; -1 for none. KEEP and PUSH are what
#: v and d are multiplied by, OWN what auxiliary variables are.
_SPHERES = """ {const int of[4] = {OF}; const mixed squares[COUNT] = {SQUARES};
 GLOBAL mixed* own = auxiliary+PLACE;
 mixed cv[3] = {0, 0, 0}, cd[3] = {0, 0, 0}, vv[COUNT] = {0}, vd[COUNT] = {0}, dd[COUNT] = {0}, mass = 0;
 mixed keep[COUNT], push[COUNT], kept_own[COUNT];
 SYNC
 if (of[0] >= 0) {
  EVERY if (w[a] != 0) {mass += 1/w[a]; XYZ {cv[c] += v[3*a+c]/w[a]; cd[c] += PUSHED/w[a];}}
  XYZ {
   cv[c] /= mass; cd[c] /= mass;
   vv[of[c]] += mass*cv[c]*cv[c]; vd[of[c]] += mass*cv[c]*cd[c]; dd[of[c]] += mass*cd[c]*cd[c];
  }
 }
 if (of[3] >= 0) EVERY if (w[a] != 0) XYZ {
  mixed m = 1/w[a], p = v[3*a+c]-cv[c], q = PUSHED-cd[c];
  vv[of[3]] += m*p*p; vd[of[3]] += m*p*q; dd[of[3]] += m*q*q;
 }
 for (int s = 0; s < COUNT; s++) {
  mixed R = squares[s]*P_kT, o = 0;
  for (int k = 0; k < AUXILIARY; k++) o += own[s*AUXILIARY+k]*own[s*AUXILIARY+k];
  keep[s] = kept_own[s] = 1; push[s] = 0;
  RULE
 }
 SYNC
 EACH if (w[a] != 0) XYZ {
  mixed r = v[3*a+c]-cv[c];
  if (of[3] >= 0) r = keep[of[3]]*r+push[of[3]]*(PUSHED-cd[c]);
  if (of[c] >= 0) r += keep[of[c]]*cv[c]+push[of[c]]*cd[c];
  v[3*a+c] = r;
 }
 if (FIRST) for (int s = 0; s < COUNT; s++) for (int k = 0; k < AUXILIARY; k++) own[s*AUXILIARY+k] *= kept_own[s];
 SYNC
 }
"""
_RULES = {
    "turn": """if (dd[s] > 0) {
   mixed z = sqrt(dd[s]/R), cosine = min(max((mixed) (vd[s]/sqrt(dd[s]*R)), (mixed) -1), (mixed) 1);
   mixed once = expm1(-z), twice = expm1(-2*z), scale = 1+(1-cosine)*twice/2;
   if (scale > 0) {keep[s] = kept_own[s] = (1+once)/scale; push[s] = (cosine*once*once-twice)/(2*z*scale);}
  }""",
    "restore": "if (vv[s]+o > 0) keep[s] = kept_own[s] = sqrt(R/(vv[s]+o));",
    "rescale": "if (vv[s] > 0) keep[s] = sqrt(max((mixed) (R-o), (mixed) 0)/vv[s]);",
}


def _spheres_of(kind: str, shape: Shape, moving: Any, placed: bool) -> tuple[tuple[int, ...], list[int]]:
    """Spheres of the center of mass along x, y, z and of the rest, -1 for none; degrees of freedom on each."""
    free = 3 * int(moving.sum()) - sum(not row.depends for row in shape.rows)
    if kind == "cluster" or placed or not moving.all():
        return (-1, -1, -1, 0 if free else -1), [free] if free else []
    centers, parts = ((0, 1, 2), [1, 1, 1]) if kind == "axes" else ((0, 0, 0), [3])
    return (*centers, len(parts) if free > 3 else -1), [*parts, *([free - 3] if free > 3 else [])]


def _with(text: str, words: Mapping[str, object]) -> str:
    """A text with other words."""
    for word, meaning in words.items():
        text = text.replace(word, str(meaning))
    return text


#: A kernel to launch; or, without a name, the bit mask of groups whose forces are evaluated, and where they are kept.
Action = tuple[str, int, int]


class Kernels:
    """The kernels of a step, for what `plan` is given; all atoms are in clusters, those that are free in one each."""

    def __init__(self, described: Mapping[str, Any], masses: FloatArray, groups: Mapping[str, int], held: Any) -> None:
        #: Bit masks of the groups of forces, by the name that operations have.
        self.groups = dict(groups)
        #: Whether noise is made tangent, so that multipliers are those of forces.
        self.tidy = described["parts"]
        #: Particles whose rows have a place in space: what cells OpenMM has moved them by is taken back for them.
        self.placed = held.placed
        #: Kind of spheres, empty for none, and auxiliary variables of each; spheres of each shape, see `_SPHERES`,
        #: degrees of freedom on them, and where the auxiliary variables of the shape begin.
        self.spheres, self.per_sphere = described["spheres"]
        self.sphere_of: list[tuple[tuple[int, ...], list[int], int]] = []
        held.warm = self.auxiliary = self.items = self.crowds = self.work = self.particles = 0
        #: Shapes, and where their clusters are: among the items of a kernel, in `atoms` and in `work`.
        self.places: list[tuple[Shape, int, int, int]] = []
        self.order: list[IntArray] = []
        everything = np.arange(len(masses))
        moving = (masses > 0) & ~np.isin(everything, held.fixed)
        free = np.setdiff1d(everything, np.concatenate([_NONE, *(shape.atoms.ravel() for shape in held.shapes)]))
        for shape in [*held.shapes, *([Shape(free[:, None])] if len(free) else [])]:
            clusters = len(shape.atoms)
            self.places.append((shape, self.items, self.particles, self.work))
            atoms = (shape.atoms if shape.together else shape.atoms.T).ravel()
            self.order.append(np.where(np.isin(atoms, held.fixed), -1 - atoms, atoms))
            self.crowds += clusters * shape.together
            self.items += clusters * (not shape.together)
            self.particles += shape.atoms.size
            self.work += 10 * shape.atoms.size * shape.together
            if self.spheres:
                placed = bool(np.isin(shape.atoms, held.placed).any())
                of, freedom = _spheres_of(self.spheres, shape, moving[shape.atoms[0]], placed)
                self.sphere_of.append((of, freedom, self.auxiliary))
                self.auxiliary += clusters * len(freedom) * self.per_sphere
                held.warm += clusters * sum(g - g / (g + self.per_sphere) for g in freedom)  # 2K/kT on average
        self.source: list[str] = []
        self._reset()
        self._bank = 0

    def _reset(self) -> None:
        self._code = ["" for _ in self.places]
        self._before, self._moves, self._sums, self._noted = "", False, 0, False

    def _add(self, code: str, rows: str | None = None) -> None:
        """Code for each cluster; another where rows are held in it."""
        for k, (shape, *_) in enumerate(self.places):
            self._code[k] += code if rows is None or not shape.name else rows

    def write(self, name: str, operations: Sequence[Op]) -> list[Action]:
        """Kernels for some operations; returns what is to be done with them."""
        self._name, self._actions = name, list[Action]()
        for op in operations:
            getattr(self, f"_{op.verb}")(op)
        self._close()
        return self._actions

    # -- one operation each --

    def _kick(self, op: Op) -> None:
        self._add(f" EACH XYZ v[3*a+c] += {_of_dt(op.share)}*{self._force(op)}*w[a];\n")

    def _fly(self, op: Op) -> None:
        count, lengths, ends = len(op.flights), _listed(op.flights), _listed(end + op.begun for end in op.ends)
        # Loops of one pass at least: some compilers write what comes after a barrier under a condition twice.
        loop = f" {{const mixed lengths[{count}] = {{{lengths}}}, ends[{count}] = {{{ends}}}; int flight = 0;\n"
        loop += " do {ROOM const mixed h = lengths[flight]*dt;\n"
        free = " EACH if (w[a] != 0) XYZ x[3*a+c] += h*v[3*a+c];\n"
        held = (
            " const mixed per_h = 1/h;\n EACH XYZ d[3*a+c] = w[a] != 0 ? h*v[3*a+c] : (mixed) 0;\n"
            " SYNC positions_NAME(ROWS_PASS CLUSTER, h, time+ends[flight]*dt, x, d, w);\n"
            " if (failure[0] == 0) EACH if (w[a] != 0) XYZ {x[3*a+c] += d[3*a+c]; v[3*a+c] = d[3*a+c]*per_h;}\n"
        )
        end = f" }} while (++flight < {count});}}\n"
        self._add(loop + free + end, loop + held + end)
        self._moves = True

    def _project(self, op: Op) -> None:
        self._add("", f" SYNC velocities_NAME(ROWS_PASS CLUSTER, 1, {_time(op, op.ends[0])}, x, v, w);\n")

    def _exchange(self, op: Op) -> None:
        """Friction and noise; on spheres the noise is along the rows, and auxiliary variables have their own."""
        damp, size = f"damp{op.use}_{-op.begun}", f"size{op.use}_{-op.begun}"
        y = f"(P_friction*{_of_dt(op.share)})"
        self._before += _once(f" mixed {damp} = exp(-{y}), {size} = sqrt(-expm1(-2*{y})*P_kT);\n", damp, size)
        draw = f"mixed g[4]; gaussians(g, ORDER(AT), step+({op.begun}), {{}}, seed[0]);"
        noise = f"{{{draw.format(op.use)} mixed s = sqrt(w[a]);\n  XYZ"
        if not self.spheres:
            # What the drift before has left across the rows is an impulse of theirs; what noise adds is none.
            along = " SYNC velocities_NAME(ROWS_PASS CLUSTER, {}, time, x, v, w);\n"
            self._add("", along.format(1) * self.tidy)
            self._add(f" EACH if (w[a] != 0) {noise} v[3*a+c] = {damp}*v[3*a+c]+{size}*s*g[c];}}\n")
            self._add("", along.format(0) * self.tidy)
            return
        self._tangent(f" EACH {noise} d[3*a+c] = s*g[c];}}\n")
        self._add(f" EACH XYZ v[3*a+c] = {damp}*v[3*a+c]+{size}*d[3*a+c];\n")
        for k, (_, freedom, first) in enumerate(self.sphere_of):
            number = len(freedom) * self.per_sphere
            own = f"auxiliary[{first}+item*{number}+j]"
            self._code[k] += (
                f" if (FIRST) for (int j = 0; j < {number}; j++) {{int a = 0; {draw.format(f'{op.use}+1024*(j+1)')} "
                f"{own} = {damp}*{own}+{size}*g[0];}}\n }}\n"
            )
        self._rescale(Op("restore"))

    def _tangent(self, start: str, rest: str = "", summed: bool = False) -> None:
        """Begin a block with d, of which what is across the rows is taken away; its impulses are `summed` or not."""
        rate = "TINY" if summed else "0"  # targets ask for no speed
        along = f" SYNC velocities_NAME(ROWS_PASS CLUSTER, {rate}, time, x, d, w);\n"
        self._add(f" {{ROOM{start}{rest}", f" {{ROOM{start}{along}{rest}")

    def _turn(self, op: Op) -> None:
        push = f" EACH XYZ d[3*a+c] = {_of_dt(op.share)}*{self._force(op)}*w[a];\n"
        if self.spheres:
            self._tangent(push, summed=True)
            self._rescale(op)
            self._add(" }\n")
            return
        sums = "acc0 += m*u*s; acc1 += m*u*u; acc2 += m*s*s;"
        each = f"if (w[a] != 0) XYZ {{mixed u = d[3*a+c], s = v[3*a+c], m = 1/w[a]; {sums}}}"
        self._tangent(push, f" EACH {{{each} XYZ kept[3*(AT)+c] = d[3*a+c];}}\n }}\n", summed=True)
        self._gather(3)
        self._before += _once(_CLOSED_FORM, "keep", "push")
        self._add(" EACH XYZ v[3*a+c] = keep*v[3*a+c]+push*kept[3*(AT)+c];\n")

    def _chain(self, op: Op) -> None:
        self._add(" EACH if (w[a] != 0) XYZ acc0 += v[3*a+c]*v[3*a+c]/w[a];\n")
        kept = "memory_before[M_link1+k] = memory[M_link1+k]"
        self._before += f" if (GLOBAL_ID == 0) for (int k = 0; k <= LINKS; k++) {kept};\n"
        self._gather(1)
        shares = {"SHARES": _listed(op.flights), "PARTS": len(op.flights)}
        self._before += _once(_with(_CHAIN, shares), "factor")
        self._add(" EACH XYZ v[3*a+c] *= factor;\n")

    def _rescale(self, op: Op) -> None:
        """Velocities back to their spheres; `restore` and `turn` move auxiliary variables, too."""
        for k, (of, freedom, start) in enumerate(self.sphere_of):
            if freedom:
                number = self.per_sphere
                words = {"RULE": _RULES[op.verb], "PUSHED": "d[3*a+c]" if op.verb == "turn" else 0}
                words |= {"OF}": f"{', '.join(map(str, of))}}}", "COUNT": len(freedom), "AUXILIARY": number}
                words |= {"SQUARES": _listed(g + number - 1 for g in freedom)}
                words |= {"PLACE": f"{start}+item*{len(freedom) * number}"}
                self._code[k] += _with(_SPHERES, words)

    _restore = _rescale

    def _evaluate(self, op: Op) -> None:
        self._close(("", self.groups[op.group], list(self.groups).index(op.group)))

    def _note(self, op: Op) -> None:
        self._add(" EACH if (w[a] != 0) XYZ acc3 += v[3*a+c]*v[3*a+c]/w[a];\n")
        self._noted = True

    def _force(self, op: Op) -> str:
        return f"FORCE(force{list(self.groups).index(op.group)}, AT, c)"

    def _gather(self, count: int) -> None:
        """What follows needs the sums that clusters have added to: each group adds the shares of all groups."""
        self._sums, bank, names = count, self._bank, [f"acc{k}" for k in range(count)]
        self._close()
        added = "".join(f"{name} += partial[k+{bank + k}*MOST_GROUPS];" for k, name in enumerate(names))
        self._before = f" {{mixed {' = 0, '.join(names)} = 0;\n"
        self._before += f" for (int k = LOCAL_ID; k < NUM_GROUPS; k += LOCAL_SIZE) {{{added}}}\n{_summed(names)} }}\n"

    # -- text --

    def _close(self, action: Action | None = None) -> None:
        """A kernel of what was written since the last; `action` comes after it."""
        if any(self._code) or self._before:
            name = f"{self._name}{len(self._actions)}"
            self._actions.append((name, -1, 0))
            ends = accumulators = ""
            places = {f"acc{k}": self._bank + k for k in range(self._sums)} | ({"acc3": 6} if self._noted else {})
            if places:
                kept = enumerate(places.values())
                stores = " ".join(f"partial[GROUP_ID+{place}*MOST_GROUPS] = shared[{k}*WG];" for k, place in kept)
                ends = f"{_summed(list(places))} if (LOCAL_ID == 0) {{{stores}}}\n"
                accumulators = f" mixed {' = 0, '.join(places)} = 0;\n"
                self._bank = 3 - self._bank if self._sums else self._bank
            clusters = "".join(self._cluster(*each) for each in zip(self.places, self._code, strict=True) if each[1])
            self.source.append(
                f"KERNEL void {name}(ARGUMENTS) {{\n UNPACK LOCAL mixed shared[4*WG];SCRATCH\n"
                " if (failure[0] != 0 && failure[0] != launch+1) return;\n"
                f"{self._before}{accumulators}{clusters}{ends}}}\n"
            )
        if action is not None:
            self._actions.append(action)
        self._reset()

    def _cluster(self, place: tuple[Shape, int, int, int], code: str) -> str:
        """A loop over the clusters of a shape that a group has, or an item."""
        shape, begin, atoms, work = place
        clusters, n = shape.atoms.shape
        every = f"for (int a = 0; a < {n}; a++)"
        words = {"NAME": shape.name, "CLUSTER": f"item+{shape.first}", "EVERY": every}
        if shape.together:  # barriers are inside, which no condition may be about
            loop = f"for (int item = GROUP_ID; item < {clusters}; item += NUM_GROUPS)"
            room = f" GLOBAL mixed *x = work+{work}+item*{10 * n}, *v = x+{3 * n}, *d = v+{3 * n}, *w = d+{3 * n};\n"
            room += " SYNC\n"
            atom = f"atoms[{atoms}+item*{n}+a]"
            words |= {"EACH": f"for (int a = LOCAL_ID; a < {n}; a += LOCAL_SIZE)", "SYNC": "SYNC_THREADS;", "ROOM": ""}
            words |= {"AT": f"RESTS({atom})", "FIRST": "LOCAL_ID == 0"}
        else:
            loop = f"for (int item = GLOBAL_ID-{begin}; item < {clusters}; item += GLOBAL_SIZE) if (item >= 0)"
            atom = f"atoms[{atoms}+a*{clusters}+item]"
            room = f" mixed x[{3 * n}], v[{3 * n}], w[{n}]; int at[{n}];\n EACH at[a] = RESTS({atom});\n"
            words |= {"EACH": f"UNROLLED {every}", "SYNC": "", "ROOM": f"mixed d[{3 * n}];"}
            words |= {"AT": "at[a]", "FIRST": "1"}
        away = " AWAY(a, (cells+4*(AT)), {})" * bool(np.isin(shape.atoms, self.placed).any())
        load = f" EACH {{GET_V(a, AT) GET_X(a, AT){away.format('-')} if ({atom} < 0) w[a] = 0;}}\n"
        store = f" EACH if (w[a] != 0) {{PUT_V(a, AT){(away.format('+') + ' PUT_X(a, AT)') * self._moves}}}\n"
        return f" {loop} {{\n{_with(room + load + code + store, words)} }}\n"


def plan(
    described: Mapping[str, Any], platform: str, masses: FloatArray, groups: int, held: Any
) -> tuple[str, list[Array], list[list[Action]], tuple[int, int, int]]:
    """Source, arrays, head, middle and tail of a step, and sizes: work-items, those of a group, groups of forces kept.

    Given are what `DeviceIntegrator.describe` says of a step, the bit mask of force groups that act, and the rows.
    """
    operations = [Op._make(tuple(v) if isinstance(v, list) else v for v in op) for op in described["operations"]]
    masks = {op.group: 1 << int(op.group) if op.group else groups for op in operations if op.verb == "evaluate"}
    seed = described["seed"] or int(np.random.default_rng().integers(1, 2**31 - 1))
    parameters, memory, n = described["settings"], described["memory"], len(masses)
    kernels = Kernels(described, masses, masks, held)
    parts = zip(("head", "middle", "tail"), divided(operations, described["noisy"]), strict=True)
    actions = [kernels.write(name, each) for name, each in parts]
    recorded, room = described["recorded"], room_for(len(described["recorded"]))
    order = np.concatenate([*kernels.order, np.array(recorded, dtype=np.int64)])
    arrays = standard_arrays([*parameters.values()], len(memory), seed, n)
    arrays += [Array("atoms", "int", order), Array("work", "mixed", np.zeros(max(kernels.work, 1))), *held.arrays]
    if kernels.spheres:
        if any(g + kernels.per_sphere < 2 for _, freedom, _ in kernels.sphere_of for g in freedom):
            raise InputError("a sphere of one degree of freedom has the radius 0; give auxiliary=1", item="auxiliary")
        first = np.random.default_rng(seed).normal(size=max(kernels.auxiliary, 1)) * np.sqrt(parameters["kT"])
        arrays.append(Array("auxiliary", "mixed", first, saved=True))
    arrays += [Array("cells", "int", np.zeros(4 * n))] * (len(held.placed) > 0)
    arrays += [Array("records", "mixed", np.zeros(9 * len(recorded) * room))] * (len(recorded) > 0)
    work_group = 1 if platform in PLAIN else held.work_group
    names = {f"P_{name}": f"parameters[{k}]" for k, name in enumerate(parameters)}
    names |= {f"M_{name}": str(k) for k, name in enumerate(memory)}
    names |= {"LINKS": str(sum(name.startswith("link") for name in memory)), "PARTICLES": str(n)}
    noted = "P_kT*P_friction > 0 ? shared[WG] : (mixed) -1" if described["noisy"] else "-1"
    look = _with(_LOOK, {"NOTED": noted})
    if recorded:
        forces = "+".join(f"FORCE(force{k}, p, c)" for k in range(len(masks)))
        look += _with(_RECORD, {"COUNT": len(recorded), "FIRST": kernels.particles, "FORCES": forces})
    source = "".join([held.source, *kernels.source, look])
    source = "".join(f"#define {name} {text}\n" for name, text in names.items() if name in source) + source
    known = set(re.findall(r"\w+", source))  # launches cost less with fewer arguments
    arrays = [array._replace(passed=array.name in known) for array in arrays]
    source = preamble(platform, arrays, held.scratch, held.work_group, len(masks)) + source
    items = kernels.items + kernels.crowds * work_group
    return source, arrays, actions, (items, work_group, len(masks))


def room_for(particles: int) -> int:
    """How many records of so many particles the device keeps: 8 MB of them, 1,000 at most."""
    return min(1000, 1 + 2**20 // (9 * max(particles, 1)))


def _listed(numbers: Iterable[float]) -> str:
    return ", ".join(f"(mixed) {number!r}" for number in numbers)


def _of_dt(share: float) -> str:
    return f"((mixed) {share!r}*dt)"


def _time(op: Op, end: float) -> str:
    """The time at a fraction of the step, of which the kernel knows when it began."""
    return f"time+{_of_dt(end + op.begun)}"
