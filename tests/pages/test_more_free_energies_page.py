"""Four kinds of coordinates: the page shows the committed results, and they are what is known."""

from __future__ import annotations

import json

from committed_pages import FOLDER, page

FOUND = json.loads((FOLDER / "more_free_energies.json").read_text(encoding="utf-8"))
TEXT = " ".join(page("free_energy.md").split())


def shown(value, error):
    return f"{value:.1f} ± {error:.1f}"


def test_every_picture_is_there():
    for name in ("pucker", "torsions", "ions", "pore"):
        assert f"figures/free_energy_{name}.png" in TEXT
        assert (FOLDER.parent / "figures" / f"free_energy_{name}.png").is_file()


def test_pore_against_its_closed_form():
    found = FOUND["pore"]
    assert f"{shown(found['barrier'], found['error'])} kJ/mol, {found['by quadrature']:.1f} by quadrature" in TEXT
    assert abs(found["barrier"] - found["by quadrature"]) < 3 * found["error"] < 0.1 * 3 * found["barrier"]


def test_ring():
    found = FOUND["pucker"]
    assert f"lowest at ±{found['lowest, degrees']:.0f} degrees" in TEXT
    assert f"flat ring {shown(found['barrier'], found['error'])} kJ/mol above" in TEXT
    assert f"30 degrees {shown(*found['at 30 degrees'])} kJ/mol" in TEXT
    assert found["at 30 degrees"][0] > 3 * found["at 30 degrees"][1]


def test_two_torsions():
    found = FOUND["torsions"]
    lowest, second = sorted(found["minima"], key=lambda m: m["F"])[:2]
    places = [tuple(round(q) for q in m["at, degrees"]) for m in (lowest, second)]
    assert f"minima at ({places[0][0]}, {places[0][1]}) and ({places[1][0]}, {places[1][1]}) degrees" in TEXT
    assert f"the second {shown(second['F'] - lowest['F'], second['error'])} kJ/mol higher" in TEXT
    assert f"{found['windows']} windows" in TEXT
    assert found["consistency"] > 1e-3
    assert second["F"] - lowest["F"] > 3 * second["error"]


def test_ions():
    found = FOUND["ions"]
    assert f"contact at {found['contact']:.1f} Å" in TEXT
    for name, said in (("barrier", "barrier at {barrier at:.1f} Å"), ("apart", "second minimum at {apart at:.1f} Å")):
        assert said.format(**found) in TEXT
        assert f"{shown(*found[name])} kJ/mol" in TEXT
    assert found["barrier"][0] > 3 * found["barrier"][1]
    assert found["least probability of both sides"] > 0.01 and "sides of every window agree (p > 0.01)" in TEXT
    assert 2.5 < found["contact"] < 3.0 < found["barrier at"] < 4.2 < found["apart at"] < 6.0


def test_both_sides_of_every_window_agree():
    for name in ("pucker", "pore"):
        assert FOUND[name]["least probability of both sides"] > 0.01 / FOUND[name]["windows"]
