"""What NumPy must be told to leave alone, so that it computes as on another processor: haswell or x86-64."""

import sys

from numpy._core._multiarray_umath import __cpu_dispatch__, __cpu_features__

#: Those that a haswell has.
OLD = {"SSE41", "POPCNT", "SSE42", "AVX", "F16C", "FMA3", "AVX2", "X86_V2", "X86_V3"}
kept = OLD if sys.argv[1] == "haswell" else set()
# NumPy warns of names of features that are not there.
print(" ".join(name for name in __cpu_dispatch__ if __cpu_features__.get(name) and name not in kept))
