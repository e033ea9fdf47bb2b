"""Warnings fail a test where this package or its tests cause them, and deprecations inside other packages do not."""

from __future__ import annotations

import warnings

import pytest


def warn(category, module):
    warnings.warn_explicit("said by a test", category, f"{module}.py", 1, module=module)


@pytest.mark.parametrize("category", [DeprecationWarning, PendingDeprecationWarning, FutureWarning, SyntaxWarning])
@pytest.mark.parametrize("module", ["kcons", "kcons.motion", "test_motion", "openmm_systems", "tests.reference.cases"])
def test_own_deprecations_are_errors(category, module):
    with pytest.raises(category, match="said by a test"):
        warn(category, module)


@pytest.mark.parametrize("category", [DeprecationWarning, PendingDeprecationWarning, FutureWarning, SyntaxWarning])
@pytest.mark.parametrize("module", ["numpy", "ase.md.md", "kcons_like", "MDAnalysis.core"])
def test_those_of_other_packages_are_not(category, module):
    with warnings.catch_warnings(record=True) as seen:
        warn(category, module)
    assert [w.category for w in seen] == [category]


@pytest.mark.parametrize("category", [RuntimeWarning, UserWarning, ResourceWarning])
@pytest.mark.parametrize("module", ["kcons.motion", "test_motion", "numpy.linalg", "ase.md.md"])
def test_all_other_warnings_are_errors(category, module):
    with pytest.raises(category, match="said by a test"):
        warn(category, module)


def test_a_deprecated_call_is_an_error_where_it_is_made():
    def outdated():
        warnings.warn("said by a test", DeprecationWarning, stacklevel=2)

    with pytest.raises(DeprecationWarning, match="said by a test"):
        outdated()
