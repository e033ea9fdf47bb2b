"""An integrator each of whose drifts is taken back and compared with where it began."""

from __future__ import annotations

from kcons.errors import UnsupportedError
from kcons.openmm.integrator.lean_step_writer import LeanStepWriter
from kcons.openmm.integrator.projected import ProjectedIntegrator


class WaysBackWriter(LeanStepWriter):
    """As `LeanStepWriter`, with the way back of each drift.

    A kick undoes itself when velocities are turned round, but for what it does across the constraints; only drifts can
    fail to, where their projection finds another solution on the way back. So it is enough to take back drifts, which
    costs projections and no force. Each drift begins with velocities made tangent, which does not change where it has
    to end: so the way back is that of the step from the end, whatever its kicks do across, to the place where solvers
    start.
    """

    def write(self) -> None:
        if self.parts or self.scheme is None:
            raise UnsupportedError(
                "ways back are written for steps without parts, and not for the leapfrog; give HamiltonianMonteCarlo a "
                "ProjectedIntegrator with these parts, and it takes back whole trajectories"
            )
        p = self.program
        p.number("missed", "square of how far the worst way back has missed its start")
        p.number("miss", "the same for one drift")
        p.vector("x_begin", "where a drift begins")
        p.vector("x_land", "where it ends")
        p.vector("v_land", "the velocities there")
        super().write()

    def _drift(self, h: str, u: str = "v") -> str:
        p = self.program
        p.each("x_begin", "x", "where the drift begins")
        if u != "v":
            p.each("v", u, "the velocities it begins with")
        p.hold_velocities("the drift begins tangent to the constraints, as its way back does")
        p.each("v", f"v+{super()._drift(h)}", "the constraint forces act on v as well")
        p.each("v_land", "v", "to come back to")
        p.each("x_land", "x", "to come back to")
        p.hold_velocities("the way back begins tangent to the constraints")
        p.each("x", f"x-{h}*v", "move back freely")
        p.hold_positions("back onto the constraints of the System")
        p.sum("miss", "(x-x_begin)^2", "how far from where the drift began")
        p.let("missed", "select(step(missed-miss), missed, miss)", "the worst, and what is no number")
        p.each("x", "x_land", "where the drift ends")
        p.hold_positions("only tells the System's constraints where x is")
        p.each("v", "v_land", "the velocities there")
        return "0"


class WaysBackIntegrator(ProjectedIntegrator):
    """As `ProjectedIntegrator` without parts; each drift is taken back, which costs solves of constraints and no force.

    For `HamiltonianMonteCarlo`, which rejects trajectories with a drift that cannot be taken back.
    """

    _writer = WaysBackWriter

    def missed(self) -> float:
        """How far the worst way back has missed its start, in nm, since `forget_ways`: root of the sum over atoms."""
        return float(self.getGlobalVariableByName("missed")) ** 0.5

    def forget_ways(self) -> None:
        """Begin anew."""
        self.program.write("missed", 0.0)
