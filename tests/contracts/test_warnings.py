"""Warnings fail a test where this package or its tests cause them, and deprecations inside other packages do not."""

from __future__ import annotations

import warnings

import pytest

OURS = ("kcons", "kcons.motion", "test_motion", "openmm_systems", "tests.reference.cases")
THEIRS = ("numpy", "ase.md.md", "kcons_like", "MDAnalysis.core")


def warn(category, module):
    warnings.warn_explicit("said by a test", category, f"{module}.py", 1, module=module)


@pytest.mark.parametrize("category", [DeprecationWarning, PendingDeprecationWarning, FutureWarning, SyntaxWarning])
def test_own_deprecations_are_errors_and_those_of_other_packages_are_not(category):
    for module in OURS:
        with pytest.raises(category, match="said by a test"):
            warn(category, module)
    for module in THEIRS:
        with warnings.catch_warnings(record=True) as seen:
            warn(category, module)
        assert [w.category for w in seen] == [category]


@pytest.mark.parametrize("category", [RuntimeWarning, UserWarning, ResourceWarning])
def test_all_other_warnings_are_errors(category):
    for module in (*OURS, *THEIRS):
        with pytest.raises(category, match="said by a test"):
            warn(category, module)
