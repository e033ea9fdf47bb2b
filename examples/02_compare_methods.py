"""Which time step can I afford? Error against cost for a chain, with kcons and with two of ASE's own tools.

The same thing from the command line: kcons compare chain --size 10 --methods rattle,ase-bonds
"""

from pathlib import Path
from tempfile import TemporaryDirectory

from rich.console import Console

from kcons.comparison import measure, report, test_systems

test_system = test_systems.build("chain", size=10)
result = measure.compare(test_system, methods=["rattle", "ase-kcons", "ase-bonds"], budget=10)

Console(width=report.WIDTH).print(report.table(result))
print(report.explanation(result))

# Everything in the table is there as numbers too.
finest = result.of("rattle")[-1]
print(f"RATTLE at {finest.setting:g} fs: {finest.error:.1e} Å after {result.scene['horizon']:g} fs")
order = result.observed_order("rattle")
print(f"halving the step divides the error by {2**order:.2f}")

with TemporaryDirectory() as folder:
    for path in report.write(result, Path(folder)):
        print(f"wrote {path.name}")
