"""Tables, listings and measurements of single pages are what the code gives."""

from __future__ import annotations

import math
import re
import runpy

import numpy as np
import pytest
from committed_pages import DOCS, ROOT, blocks, text_of

from kcons.openmm import SCHEMES, ProjectedIntegrator

EXAMPLES, OPENMM = ROOT / "examples", text_of("openmm.md")


def test_the_table_of_steppers_is_as_it_is_made():
    page = text_of("steppers.md")
    row = "| `BlanesMoan4` | `blanes-moan4` | 4 | yes | yes | 6 | 30 | 0.398 | no |"
    made = runpy.run_path(str(DOCS / "make_tables.py"))
    renewed, (runs, _) = made["renewed"], made["results"]("openmm_four_femtoseconds")
    assert re.findall(r"ommit (\w+)", runs) == ["ce207a3d", "2f3b8213"]  # on a CPU and on a GPU
    assert [f"{gain:.2f}" for *_, gain in made["front_rows"]()[-2:]] == ["0.80", "0.66"]  # as on the page of OpenMM
    assert row in page and renewed(page) == page, "run docs/make_tables.py"
    worn = page.replace(row, "")
    assert renewed(worn, DOCS, "stability") == worn and renewed(worn, DOCS, "steppers") == page


def test_listing_and_schemes_on_the_page_are_those_of_the_integrator():
    (shown,) = (text for text in blocks(OPENMM, "text") if text.startswith("constraints of the System"))
    assert shown == ProjectedIntegrator(0.002, device=False).listing() + "\n"
    rows = re.findall(r"^\| (`.*?) \| (\d) \| ([\d, ]+) \| (?!\d)", OPENMM, re.MULTILINE)
    table = {}
    for names, order, evaluations in rows:
        keys = re.findall(r"`(.*?)`", names)
        table |= {k: (int(order), int(e)) for k, e in zip(keys, evaluations.split(","), strict=True)}
    made = {name: SCHEMES[name]() for name in table}  # the page on steppers has all of them
    assert len(table) > 5 and table == {name: (made[name].order, made[name].force_evaluations) for name in table}


def test_work_and_precision_of_growth(capsys):
    script = runpy.run_path(str(EXAMPLES / "notes" / "growth_results.py"))
    script["work_precision"]("to t = 5", script["START"], 5.0, (1e-6,))
    lines = [line.split() for line in capsys.readouterr().out.splitlines()[2:]]
    rows = {" ".join(line[:2]): [float(number) for number in line[5:]] for line in lines}
    own, plain = rows["kcons DOP853"], rows["SciPy DOP853"]
    assert own[0] < 2e-6 > plain[0]
    # What the projection is for.
    assert own[2] < 1e-13 < 1e-9 < plain[2]
    assert np.isfinite(list(rows.values())).all()


def test_langevin_reports_300_k_and_a_chain_without_noise_what_harmonic_vibrations_say():
    """Heavy hydrogens, 40 ps: about 270 K at the ends of steps of 4 fs, 300 K between, within three standard errors."""
    example = runpy.run_path(str(EXAMPLES / "studies" / "openmm_heavy_hydrogens.py"))
    system, x = example["alanine"]("HBonds")
    start = example["start_of"](system, x, 1, 1000)
    omega = example["harmonic"](system, x)
    # 66 coordinates, 12 bonds with hydrogen; a carbonyl vibrates in 19 fs.
    assert len(omega) == 54
    assert 2e3 * math.pi / omega.max() == pytest.approx(19, abs=1)
    expected = 300 * (1 - np.mean((0.004 * omega) ** 2) / 4)
    for name, reported in (("kcons Langevin", 300.0), ("kcons NoseHooverMiddle", expected)):
        found = example["sample"](system, start, name, 0.004, 40.0)
        for key, kelvin in (("reported", reported), ("half", 300.0)):
            assert abs(found[key]["mean"] - kelvin) <= 3 * found[key]["error"] < 25
    assert expected < 280
