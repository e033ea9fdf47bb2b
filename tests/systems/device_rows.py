"""Rows of the device compiled as plain C++ and called by ctypes: one work-item has everything."""

import ctypes
import hashlib
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from kcons.openmm.device.kernels import preamble, standard_arrays
from kcons.openmm.device.rows import DeviceRows

_FOLDER = Path(tempfile.gettempdir()) / "kcons-device-rows"
#: Types of positions and of matrices by precision.
_TYPES = {
    "double": "typedef double real, mixed;",
    "mixed": "#define USE_MIXED_PRECISION\ntypedef float real; typedef double mixed;",
    "single": "typedef float real, mixed;",
}
_ANY = (
    "int steps, int launches, double allowed, const double* b, const int* atoms, int clusters, int first, double h, "
    "double at, int n, const mixed* all, mixed* change, const mixed* masses"
)
_CALLED = """
extern "C" void run_{what}_{name}({any}, {arguments}) {{
  int step = steps, launch = launches; mixed tolerance = allowed, scratch[4], x[3*{room}], d[3*{room}], w[{room}];
  mixed4 box0 = {{(mixed) b[0], 0, 0}}, box1 = {{(mixed) b[3], (mixed) b[4], 0}};
  mixed4 box2 = {{(mixed) b[6], (mixed) b[7], (mixed) b[8]}};
  for (int c = 0; c < clusters; c++) {{
    for (int a = 0; a < n; a++) {{
      int i = atoms[c*n+a]; w[a] = masses[i];
      for (int k = 0; k < 3; k++) {{x[3*a+k] = all[3*i+k]; d[3*a+k] = change[3*i+k];}}
    }}
    {what}_{name}(ROWS_PASS c+first, (mixed) h, (mixed) at, x, d, w);
    for (int a = 0; a < n; a++) for (int k = 0; k < 3; k++) change[3*atoms[c*n+a]+k] = d[3*a+k];
  }}
}}
"""


class PlainRows:
    """The functions of some rows, in one of the precisions.

    Attributes
    ----------
    arrays : dict of str to ndarray
        What is on the device.
    """

    def __init__(self, rows: DeviceRows, precision: str = "double") -> None:
        self.rows = rows
        self.number = np.float32 if precision == "single" else np.float64
        arrays = [*standard_arrays(), *rows.arrays]
        self.arrays = {
            a.name: np.array(a.values, dtype=self.number if a.kind == "mixed" else np.int32, order="C") for a in arrays
        }
        head = preamble("Reference", arrays, rows.scratch)
        head = head.replace("typedef double real, mixed;", _TYPES[precision])
        if precision != "double":
            head = head.replace("#define USE_DOUBLE_PRECISION\n", "")
        head = head.replace("struct real4 {double x, y, z;};", "struct real4 {mixed x, y, z;};")
        needed = [a for a in arrays if f" {a.name}," in head.split("#define ROWS ")[1].split("\n")[0] + ","]
        arguments = ", ".join(f"{a.kind}* {a.name}" for a in needed)
        self.needed = [a.name for a in needed]
        text = head + rows.source
        for name, shape in {shape.name: shape for shape in rows.shapes}.items():
            room = 4000 if shape.together else shape.atoms.shape[1]
            for what in ("positions", "velocities"):
                text += _CALLED.format(what=what, name=name, any=_ANY, arguments=arguments, room=room)
        _FOLDER.mkdir(exist_ok=True)
        path = _FOLDER / f"{hashlib.sha256(text.encode()).hexdigest()[:20]}.so"
        if not path.exists():
            source = path.with_suffix(".cpp")
            source.write_text(text)
            made = path.with_suffix(".new")
            subprocess.run(["g++", "-std=c++17", "-O0", "-shared", "-fPIC", "-w", "-o", made, source], check=True)
            made.rename(path)
        self.library = ctypes.CDLL(str(path))

    def _run(self, what, x, change, w, h, time, tolerance, box):
        x, change, w = (np.array(a, dtype=self.number, order="C") for a in (x, change, w))
        box = np.ascontiguousarray(np.eye(3) if box is None else box, dtype=float)
        pointers = [self.arrays[name].ctypes.data_as(ctypes.c_void_p) for name in self.needed]
        for shape in self.rows.shapes:
            atoms = np.ascontiguousarray(shape.atoms, dtype=np.int32)
            getattr(self.library, f"run_{what}_{shape.name}")(
                3, 7, ctypes.c_double(tolerance), box.ctypes.data_as(ctypes.c_void_p),
                atoms.ctypes.data_as(ctypes.c_void_p), len(atoms), shape.first, ctypes.c_double(h),
                ctypes.c_double(time - self.arrays["rows_knots"][0]), atoms.shape[1], x.ctypes.data_as(ctypes.c_void_p),
                change.ctypes.data_as(ctypes.c_void_p), w.ctypes.data_as(ctypes.c_void_p), *pointers,
            )  # fmt: skip
        return change.astype(float)

    def positions(self, x, d, w, h=1.0, time=0.0, tolerance=1e-13, box=None):
        """d with which x + d is on the rows."""
        return self._run("positions", x, d, w, h, time, tolerance, box)

    def velocities(self, x, v, w, rate=1.0, time=0.0, box=None):
        return self._run("velocities", x, v, w, rate, time, 1e-13, box)

    @property
    def failed(self) -> bool:
        return bool(self.arrays["failure"][0])

    def write(self, values) -> None:
        """Arrays by name, as an integrator writes them."""
        for name, array in values.items():
            self.arrays[name][: len(array)] = array
