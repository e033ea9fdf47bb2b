"""How far methods can be pushed: largest stable steps, drift of the energy, reversibility, random molecules."""

from kcons.stability.fuzz import Trial, trial
from kcons.stability.runs import attempt, drift, largest_step, reversal
from kcons.stability.scenes import SCENES
from kcons.stability.study import digest, put_into, run

__all__ = ["SCENES", "Trial", "attempt", "digest", "drift", "largest_step", "put_into", "reversal", "run", "trial"]
