"""Algebra in global variables against NumPy."""

from __future__ import annotations

import numpy as np
import openmm
import pytest

from kcons.openmm.collective.small_algebra import Block, blocks
from kcons.openmm.integrator.program import Program

_KEPT = []


def run(integrator):
    """One step; the Context is kept, as the values of the variables are with it."""
    system = openmm.System()
    system.addParticle(1.0)
    context = openmm.Context(system, integrator, openmm.Platform.getPlatform("Reference"))
    context.setPositions([[0, 0, 0]])
    integrator.step(1)
    _KEPT.append(context)


def written(size, write):
    """An integrator with one block of rows 0, 2, 4... and what `write` adds."""
    integrator = openmm.CustomIntegrator(0.001)
    program = Program(integrator)
    block = Block(range(0, 2 * size, 2), 3)
    program.number("failed", "")
    program.number("singular", "")
    block.declare(program)
    block.declare_newton(program)
    for row in block.rows:
        program.number(f"more3_{row}", "")
        program.number(f"result3_{row}", "")
    write(program, block)
    program.hand_over()
    return integrator, block


def fill(integrator, block, gram):
    for a, i in enumerate(block.rows):
        for b, j in enumerate(block.rows[: a + 1]):
            integrator.setGlobalVariableByName(block.gram(i, j), float(gram[a, b]))
        integrator.setGlobalVariableByName(block.of("own", i), float(abs(gram[a, a])))


def inverse_of(integrator, block):
    return np.array([[integrator.getGlobalVariableByName(block.inverse(i, j)) for j in block.rows] for i in block.rows])


def random_gram(size, seed=0):
    a = np.random.default_rng(seed).normal(size=(size, size + 2))
    return a @ a.T


@pytest.mark.parametrize("size", [1, 2, 3, 7])
def test_inverse(size):
    integrator, block = written(size, lambda p, b: b.invert(p, "singular"))
    gram = random_gram(size)
    fill(integrator, block, gram)
    run(integrator)
    assert integrator.getGlobalVariableByName("singular") == 0
    assert inverse_of(integrator, block) @ gram == pytest.approx(np.eye(size), abs=1e-12)


@pytest.mark.parametrize("size", [2, 3, 7])
def test_the_first_dependent_row_is_named(size):
    integrator, block = written(size, lambda p, b: b.invert(p, "singular"))
    a = np.random.default_rng(1).normal(size=(size, size + 2))
    a[size - 1] = a[0] - 2 * a[size - 2]
    fill(integrator, block, a @ a.T)
    run(integrator)
    assert integrator.getGlobalVariableByName("singular") == 1 + block.rows[-1]
    assert np.isfinite(inverse_of(integrator, block)).all()


@pytest.mark.parametrize("value", [0.0, float("nan")])
def test_a_row_without_gradient_is_named(value):
    integrator, block = written(1, lambda p, b: b.invert(p, "singular"))
    integrator.setGlobalVariableByName(block.gram(0, 0), value)
    run(integrator)
    assert integrator.getGlobalVariableByName("singular") == 1


@pytest.mark.parametrize("size", [1, 2, 5])
def test_broyden_updates_explain_the_last_push(size):
    def write(p, block):
        block.invert(p, "singular")
        block.update(p, "1")

    integrator, block = written(size, write)
    gram = random_gram(size)
    fill(integrator, block, gram)
    rng = np.random.default_rng(2)
    push = rng.normal(size=size)
    change = (gram + 0.1 * rng.normal(size=(size, size))) @ push
    for a, i in enumerate(block.rows):
        integrator.setGlobalVariableByName(f"more3_{i}", push[a])
        integrator.setGlobalVariableByName(f"change3_{i}", change[a])
    run(integrator)
    updated = inverse_of(integrator, block)
    assert updated @ change == pytest.approx(push, rel=1e-11)
    # Nothing else is changed: the update has rank 1.
    assert np.linalg.matrix_rank(updated - np.linalg.inv(gram), tol=1e-10) == 1


@pytest.mark.parametrize("size", [1, 3])
@pytest.mark.parametrize("push", [0.0, 1e-200])
def test_a_push_too_small_teaches_nothing(size, push):
    def write(p, block):
        block.invert(p, "singular")
        block.update(p, "1")

    integrator, block = written(size, write)
    gram = random_gram(size)
    fill(integrator, block, gram)
    for i in block.rows:
        integrator.setGlobalVariableByName(f"more3_{i}", push)
    run(integrator)
    assert inverse_of(integrator, block) == pytest.approx(np.linalg.inv(gram), rel=1e-12)


def test_products_with_the_inverse():
    def write(p, block):
        block.invert(p, "singular")
        for i in block.rows:
            p.let(f"result3_{i}", block.solve(i, "more"), "")

    integrator, block = written(4, write)
    gram, vector = random_gram(4), np.arange(1.0, 5.0)
    fill(integrator, block, gram)
    for a, i in enumerate(block.rows):
        integrator.setGlobalVariableByName(f"more3_{i}", vector[a])
    run(integrator)
    result = [integrator.getGlobalVariableByName(f"result3_{i}") for i in block.rows]
    assert result == pytest.approx(np.linalg.solve(gram, vector), rel=1e-12)


def test_blocks_of_rows_that_touch():
    assert blocks([{0, 1}, {2, 3}, {4}, {3, 4}, {9}]) == [[0], [1, 2, 3], [4]]
    assert blocks([{1}, {2}, {1, 2}]) == [[0, 1, 2]]
    assert blocks([]) == []
