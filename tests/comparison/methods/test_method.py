"""What every method has: interruption when its time is up."""

from __future__ import annotations

import time
from types import SimpleNamespace

import pytest
from numba.core import event

from kcons.comparison.methods.method import OverBudgetError, interrupted_after
from kcons.constraints.compilation import announcer


def kernel():
    pass


kernel.__module__ = "kcons.solvers.chains"
COMPILING = event.Event("numba:compile", event.EventStatus.START, {"dispatcher": SimpleNamespace(py_func=kernel)})


def test_interrupted_when_the_time_is_up():
    begun = time.perf_counter()
    with pytest.raises(OverBudgetError, match=r"not done after 0\.1 s"), interrupted_after(0.1):
        time.sleep(20)
    assert 0.1 <= time.perf_counter() - begun < 10
    with interrupted_after(0.1):
        pass
    time.sleep(0.2)  # nothing rings any more


def test_a_kernel_that_is_being_compiled_is_waited_for():
    """Interrupted, it would begin again with the next step, and never be done."""
    done = []
    with pytest.raises(OverBudgetError), interrupted_after(0.1):
        announcer.on_start(COMPILING)
        try:
            for _ in range(10):
                time.sleep(0.03)
            done.append("compiled")
        finally:
            announcer.on_end(COMPILING)
        time.sleep(20)
    assert done == ["compiled"]
