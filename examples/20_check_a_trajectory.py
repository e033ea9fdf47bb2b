"""How well trajectories of other engines kept their constraints: adenylate kinase by GROMACS and CHARMM.

    python examples/20_check_a_trajectory.py

The files come with MDAnalysisTests; without it, a short trajectory is made here, with one bond too long in one frame.
"""

import tempfile
import warnings
from pathlib import Path

import numpy as np

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    import MDAnalysis as mda

from kcons.constraints import Distance
from kcons.mdanalysis import CheckResult, ConstraintCheck, check_trajectory, load_trajectory, open_universe


def show(title: str, result: CheckResult) -> None:
    """The verdict and what it rests on."""
    unit = result.units[0]
    print(f"{title}\n  {len(result.frames)} frames, {result.n_rows} rows of rank {result.rank}")
    print(f"  {result.precision}")
    print(f"  rms {unit.rms:.2e} Å, of which rounding makes {unit.rounding_rms:.2e} Å")
    if result.temperature is not None:
        print(f"  {result.temperature['mean']:.1f} K by {result.degrees_of_freedom} degrees of freedom")
    if result.broken is not None:
        print(f"  the file ends at frame {result.broken.frame}: {result.broken.reason}")
    print(f"  {result.verdict}\n")


def real_files() -> None:
    """Water and bonds to hydrogens, kept by GROMACS; a path of CHARMM that holds nothing."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from MDAnalysisTests.datafiles import DCD, PSF, TPR, TRR, XTC

    show("GROMACS, TRR", check_trajectory(TRR, TPR, "hbonds"))
    show("the same run, XTC", check_trajectory(XTC, TPR, "hbonds"))
    show("CHARMM, a path of minimised structures, DCD", check_trajectory(DCD, PSF, "hbonds", targets="mean"))
    with tempfile.TemporaryDirectory() as folder:
        short = Path(folder) / "cut.trr"
        short.write_bytes(Path(TRR).read_bytes()[:-100_000])
        # Constraints of one's own: the oxygens' bonds in the first hundred waters.
        universe = open_universe(TPR, short)
        oxygens = universe.select_atoms("resname SOL and name OW").indices[:100]
        rows = Distance(np.stack([oxygens, oxygens + 1], axis=1), 0.9572)
        show("the same run, cut off", ConstraintCheck(universe, rows).run().check)


def made_here() -> None:
    """Rigid dumbbells, one of them stretched in the seventh frame."""
    n = 20
    rng = np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as folder:
        universe = mda.Universe.empty(2 * n, trajectory=True)
        universe.add_TopologyAttr("masses", np.ones(2 * n))
        with mda.Writer(f"{folder}/d.xtc", 2 * n) as writer:
            for frame in range(10):
                along = rng.normal(size=(n, 3))
                along *= (1.1 + 0.1 * (frame == 7) * (np.arange(n) == 3))[:, None] / np.linalg.norm(along, axis=1)[
                    :, None
                ]
                centre = 30 * rng.random((n, 3))
                universe.atoms.positions = np.stack([centre, centre + along], axis=1).reshape(-1, 3)
                writer.write(universe.atoms)
        load_trajectory(universe, f"{folder}/d.xtc")
        show("dumbbells, XTC", ConstraintCheck(universe, Distance(np.arange(2 * n).reshape(n, 2), 1.1)).run().check)


if __name__ == "__main__":
    try:
        import MDAnalysisTests  # noqa: F401
    except ImportError:
        made_here()
    else:
        real_files()
