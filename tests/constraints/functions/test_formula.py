"""Formulas: read, written as code, exact, kept in files; as rows, and what is refused. Rows of Python functions."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from constraint_cases import MASSES, TIME, scattered, spread

from kcons import ConstraintSet, Motion
from kcons.constraints import (
    Custom,
    Dihedral,
    Distance,
    Formula,
    Sphere,
    from_dict,
)
from kcons.constraints.functions.formula import FUNCTIONS, code_of
from kcons.errors import InputError, SingularGeometryError
from kcons.solvers.sparse.row_functions import row_function

#: What takes for ever or all memory, or is no formula in other ways: some text, and what is said of it.
FROM_OTHERS = {
    "x1*9**9**9": "is finite nowhere",
    "x1*10**-9**9": "its gradient is zero",
    "x1+2**2**40": "is finite nowhere",
    "pi**pi**pi**pi*x1": "is finite nowhere",
    "x1*1e200*1e200": "is finite nowhere",
    "x1*1e999": "a number that is too large",
    "x1+" + "9" * 400: "a number that is too large",
    "x1+0x" + "f" * 4000: "a number that is too large",
    "x1+log(0)": "is finite nowhere",
    "x999999": "names atom 999999 of a row and not atom 1",
    "x99999999999999999999999": "is not known",
    "+".join(["x1"] * 900): "more than 200 levels",
    "x1+" * 5000 + "x1": "at most 10000",
    "-" * 3000 + "x1": "nested",
    "(" * 3000 + "x1" + ")" * 3000: "nested",
    "x1*sin": "'sin' in .* is a function; write what it is of",
    "x1*True": "is not allowed",
    "x1\ud800": "cannot be read",
    "x1\0": "cannot be read",
    "x\u0661": "is not known",
}


@pytest.mark.parametrize("formula", FROM_OTHERS, ids=range(len(FROM_OTHERS)))
def test_formulas_without_bound_are_refused_at_once(formula):
    with pytest.raises(InputError, match=FROM_OTHERS[formula]) as caught:
        code_of(formula, ())
    assert len(str(caught.value)) < 500 and caught.value.item


def row_of(formula, r, t=0.0):
    """Value and gradient of a formula of one atom, at places of shape (3, n)."""
    out = np.empty((4, np.shape(r)[1]))
    code_of(formula, ()).row(r, (), t, out)
    return out


@pytest.mark.parametrize(
    ("formula", "value"),
    [
        ("x1**(2**40)", 1.0),
        ("(" * 40 + "x1" + "**99)" * 40, 1.0),
        ("x1*12345678901234567890*1e100 + (9*x1)**40", 12345678901234567890e100 + 9.0**40),
        ("sin(" * 60 + "0*x1" + ")" * 60 + "+ x1", 1.0),
    ],
)
def test_large_numbers_and_long_formulas_are_computed_as_others_are(formula, value):
    with np.errstate(all="ignore"):
        assert row_of(formula, np.ones((3, 1)))[0, 0] == value


@pytest.mark.parametrize(
    ("formula", "found"),
    [
        ("(x1 - x2 + y1 - y2)**60", True),  # multiplied out it has thousands of parts
        ("sin(x1)*cos(x2) - cos(x1)*sin(x2)", True),
        ("acos((x1 - x2)/2)", True),
        ("abs(x1 - x2)", True),
        ("(x1 + y1 + z1 + x2 + y2 + z2)**60", False),
        ("abs(x1 - 5e8) + x1 + x1 - x2", False),  # on this side of the wall it is x1 - x2 + 5e8
        ("x1 - x2 + 1e-8*x1", False),
        ("exp(exp(exp(exp(x1 - x2))))", True),
        ("exp(exp(exp(exp(x1 + x2))))", False),
        ("(x1 - x2)**((x1 - x2)**((x1 - x2)**(x1 - x2)))", True),
        ("(x1 - x2)**0 + y1 - y2", True),
        ("(x1 - x2)**2 + sin(z1 - z2)*y1 - y2*sin(z1 - z2)", True),
        ("x1 - x2 + z1*1e-9", False),
    ],
)
def test_shifts_are_found_out(formula, found):
    assert code_of(formula, ()).invariant == found


def test_a_gradient_of_zero_is_refused_before_anything_is_written(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    with pytest.raises(InputError, match="does not change with the positions"):
        code_of("x1 - x1 + 3.25", ())
    assert not list(tmp_path.rglob("*.py"))


def test_every_function_is_differentiated_exactly():
    """Value, gradient and second derivatives against differences, for each function."""
    rng = np.random.default_rng(0)
    for name in sorted(FUNCTIONS):
        inner = "1 + x1**2*y1/9" if name in ("log", "sqrt", "abs") else "x1*y1/3 - z1**3/7"
        two = f"{name}({inner}, 2 + z1)" if name == "atan2" else f"{name}({inner})"
        text, t = f"{two}*y1 + x1/(2 + t)", 0.3
        r = rng.uniform(0.2, 0.9, (3, 5))
        first = row_of(text, r, t)
        for axis in range(3):
            h = np.zeros((3, 1))
            h[axis] = 1e-4
            up, down, far, deep = (row_of(text, r + k * h, t)[0] for k in (1, -1, 2, -2))
            slope = (8 * (up - down) - (far - deep)) / 12e-4
            np.testing.assert_allclose(first[1 + axis], slope, atol=1e-10, err_msg=name)
        row, v, s = Formula(text, np.zeros(5, int)), rng.normal(size=(5, 1, 3)), 2e-3
        up, here, down = (row.measure(r.T[:, None] + k * s * v, t + k * s) for k in (1, 0, -1))
        far, deep = (row.measure(r.T[:, None] + k * s * v, t + k * s) for k in (2, -2))
        bend = (16 * (up + down) - (far + deep) - 30 * here) / (12 * s * s)
        found = row.curvature(r.T[:, None], v, t) + row.time_terms(r.T[:, None], v, t)[1]
        np.testing.assert_allclose(found, bend, rtol=1e-7, atol=1e-7, err_msg=name)


def test_what_is_compiled_is_found_again(tmp_path, monkeypatch):
    """By the name of its module, which is the same in each process."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    hits = []
    for _ in range(3):  # Numba sees the new folder after the first
        code_of.cache_clear()
        hits.append(row_function(Formula("x1 + 0.375*y1", 0), np.zeros(1)).cache_hits)
    assert hits == [0, 0, 1]


def test_a_file_that_is_damaged_is_written_anew(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    file = Path(code_of("x1 + 0.625*y1", ()).row.__code__.co_filename)
    whole = file.read_text()
    assert file.is_relative_to(tmp_path)
    for damaged in ("", whole[:-20], whole.replace("0.625", "0.626")):
        file.write_text(damaged)
        code_of.cache_clear()
        assert code_of("x1 + 0.625*y1", ()).row.__code__.co_filename == str(file) and file.read_text() == whole


# -- as rows -----------------------------------------------------------------------------------------------


def test_a_period_goes_the_shorter_way():
    row = Formula("atan2(y1, x1)", 0, target=3.1, period=2 * np.pi)
    x = np.array([[-1.0, -0.03, 0.0]])
    motion = Motion(ConstraintSet(row, x, [1.0]), x)
    y = motion.project_positions(x, x)
    assert np.arctan2(y[0, 1], y[0, 0]) == pytest.approx(3.1) and np.abs(y - x).max() < 0.1


def test_files_keep_formulas():
    row = Formula("a*x1 - z2", [[0, 1], [2, 3]], {"a": [1.0, 2.0]}, target=[0.5, 0.25], period=7.0)
    again = from_dict(row.todict())
    assert again.todict() == row.todict()
    assert from_dict(Formula("x1", [0, 1]).todict()).n_rows == 2
    with pytest.raises(InputError, match=r"\['values'\] are missing"):
        from_dict({key: value for key, value in row.todict().items() if key != "values"})
    for wrong in ([1.0, 2.0], [[1.0, 2.0], [3.0, 4.0]], None):
        with pytest.raises(InputError, match="values"):
            from_dict({**row.todict(), "values": wrong})


@pytest.mark.parametrize(
    ("formula", "x1"),
    [("sqrt(1 - x1**2) - z1", 2.0), ("log(x1)", 0.0), ("a/x1 + y1", 0.0), ("x1**2", 0.0), ("sqrt(x1) + y1", 0.0)],
)
def test_what_is_undefined_at_the_start_is_refused(formula, x1):
    row = Formula(formula, 1, {"a": 1.0}, target=None)
    x = np.array([[0.0, 0.0, 0.0], [x1, 0.0, 0.0]])
    with pytest.raises(
        SingularGeometryError, match=r"row 1, Formula\(1\): value and gradient must be finite"
    ) as caught:
        ConstraintSet([Sphere(0, [1.0, 0, 0]), row], x, np.ones(2), time=TIME)
    assert caught.value.atoms == (1,)


# -- Python functions: checks of what was given, accuracy of what was not --------------------------


def gap(r):
    return float(np.linalg.norm(r[0] - r[1]))


def gap_gradient(r):
    u = (r[0] - r[1]) / gap(r)
    return np.array([u, -u])


#: The same coordinates as formulas, which are differentiated exactly.
SQUARES = "((x{0} - x{1})**2 + (y{0} - y{1})**2 + (z{0} - z{1})**2)"
SPREAD = f"exp(-{SQUARES.format(1, 2)}/8) + {SQUARES.format(2, 3)}/5"


@pytest.mark.parametrize("given", [True, False])
def test_differenced_curvature_has_ten_digits(given):
    x, v, atoms = scattered(0), 10 * scattered(1), [[0, 1, 2], [5, 3, 4]]
    exact, differenced = Formula(SPREAD, atoms), spread(atoms, given=given)
    r, u = x[exact.atoms], v[exact.atoms]
    found = differenced.curvature(r, u, TIME)
    expected = exact.curvature(r, u, TIME)
    assert np.abs(found - expected).max() < 1e-10 * np.einsum("kai,kai->k", u, u).max()


#: What functions give that does not fit, and what is said of it before anything moves.
WRONG = [
    (
        Custom([0, 1], gap, lambda r: 2 * gap_gradient(r)),
        r"row 1, Custom\(0, 1\): gradient gives .* but differences .* give",
    ),
    (
        Custom([0, 1], gap, lambda r: gap_gradient(r)[0]),
        r"Custom: gradient returned shape \(3,\) for row 0; it must return \(2, 3\)",
    ),
    (
        Custom([0, 1], lambda r: r[0], gap_gradient),
        r"Custom: function returned shape \(3,\) for row 0; it must return one number",
    ),
]


@pytest.mark.parametrize(("row", "words"), WRONG)
def test_what_functions_give_is_checked(row, words):
    with pytest.raises(InputError, match=words):
        ConstraintSet([Distance([2, 3]), row], scattered(0), MASSES)


TRANS = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 0.0], [1.5, 0.0, 0.0], [1.5, -1.0, 0.0]])


def _torsion(r):
    return float(Dihedral([0, 1, 2, 3]).measure(r[None], 0.0)[0])


@pytest.mark.parametrize("gradient", [None, lambda r: Dihedral([0, 1, 2, 3]).gradient(r[None], 0.0)[0]])
def test_differences_where_the_value_jumps_by_its_period(gradient):
    v = scattered(2)[:4]
    ours = ConstraintSet([Custom([0, 1, 2, 3], _torsion, gradient, period=2 * np.pi)], TRANS, np.ones(4))
    theirs = ConstraintSet([Dihedral([0, 1, 2, 3])], TRANS, np.ones(4))
    assert ours.jacobian(TRANS).toarray() == pytest.approx(theirs.jacobian(TRANS).toarray(), abs=1e-10)
    assert ours.acceleration_target(TRANS, v) == pytest.approx(theirs.acceleration_target(TRANS, v), rel=1e-8)
    kept = Motion(ours, TRANS).project_positions(TRANS + 0.01 * v, TRANS)
    assert kept == pytest.approx(Motion(theirs, TRANS).project_positions(TRANS + 0.01 * v, TRANS), abs=1e-9)


CUT = np.array([[0.2, 0.3, 0.4], [4.8, 0.1, 0.6], [0.5, 1.0, 0.2]])


@pytest.mark.parametrize("gradient", [None, gap_gradient])
def test_atoms_cut_by_a_face_of_the_cell_are_refused_unless_it_is_said_what_is_meant(gradient):
    """Their value was taken where they lie, and another one held than the nearest images have."""
    cell, masses = np.diag([5.0, 6.0, 6.0]), np.ones(3)
    with pytest.raises(InputError, match=r"row 0.* cut by a face .* differs by -4\.\d+ .* translation_invariant=True"):
        ConstraintSet(Custom([0, 1], gap, gradient), CUT, masses, cell=cell)
    held = ConstraintSet(Custom([0, 1], gap, gradient, translation_invariant=True), CUT, masses, cell=cell)
    assert held.value(CUT)[0] == 0 and held.constraints[0].target[0] == pytest.approx(np.sqrt(0.4**2 + 0.2**2 + 0.2**2))


def test_functions_that_know_their_images_or_a_place_may_be_cut():
    cell, masses = np.diag([5.0, 6.0, 6.0]), np.ones(3)

    def nearest(r):
        d = r[0] - r[1]
        return float(np.linalg.norm(d - np.diag(cell) * np.round(d / np.diag(cell))))

    for function, atoms in ((nearest, [0, 1]), (lambda r: float(r[0] @ r[1]), [0, 1]), (gap, [0, 2])):
        assert ConstraintSet(Custom(atoms, function), CUT, masses, cell=cell).value(CUT)[0] == 0
