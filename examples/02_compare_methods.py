"""Which time step can I afford? Error against cost for a chain, with kcons and with one of ASE's own tools.

The same thing from the command line: kcons compare chain --size 10 --methods rattle,ase-kcons,ase-bonds
"""

from kcons.comparison import compare, figure, observed_orders, rank, test_systems, text

system = test_systems.build("chain", size=10)
table = compare(system, ["rattle", "ase-kcons", "ase-bonds"], budget=10)  # a row a method and time step

print(table[["title", "setting", "error", "sigma", "step_seconds"]].to_string(index=False))
print(text(table, rank(table)))

order = observed_orders(table)["kcons RATTLE"]
print(f"halving the step of RATTLE divides the error by {2**order:.2f}")

figure(table).savefig("compare.png", dpi=150)
