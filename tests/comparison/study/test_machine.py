"""What a result depends on, and where it was measured."""

from __future__ import annotations

import json

from kcons import __version__
from kcons.comparison.study import machine


def test_stamp_is_what_comes_back_from_a_file():
    stamp = machine.stamp(quick=True, part={"steps": (1.0, 2.0)})
    assert stamp == {
        "version": __version__,
        "code": machine.code_digest(),
        "quick": True,
        "part": {"steps": [1.0, 2.0]},
    }
    assert json.loads(json.dumps(stamp)) == stamp


def test_code_is_known_by_what_it_does(tmp_path, monkeypatch):
    """Names of files, imports, documentation and layout do not count."""
    monkeypatch.setattr(machine, "PACKAGE", tmp_path)

    def digest(name, text):
        for path in tmp_path.glob("*.py"):
            path.unlink()
        (tmp_path / name).write_text(text)
        machine.code_digest.cache_clear()
        return machine.code_digest()

    try:
        first = digest("a.py", '"""Words."""\nimport os\ndef f(x):\n    """More."""\n    return x\n')
        assert digest("b.py", "from os import path\n\n\ndef f(x):\n    return (x)\n") == first
        assert digest("a.py", "def f(x):\n    return -x\n") != first
    finally:
        machine.code_digest.cache_clear()


def test_environment():
    about = machine.environment()
    assert about["cpu"] and about["versions"]["numpy"] and about["threads"] == 1
    assert json.loads(json.dumps(about)) == about
    assert about["simd"] in (64, 128, 256, 512)


def test_processors_are_named_with_their_simd_width():
    assert machine.processor_of({"cpu": "a processor", "simd": 256}) == "a processor, 256-bit SIMD"
    assert machine.processor_of({"cpu": "a processor"}) == "a processor"  # results of before it was noted


def test_simd_width_is_that_of_the_widest_instructions(monkeypatch):
    known = {"avx512f": True, "avx2": True, "sse2": True}
    monkeypatch.setattr(machine.llvmlite.binding, "get_host_cpu_features", lambda: known)
    assert machine.simd_width() == 512
    known["avx512f"] = False
    assert machine.simd_width() == 256
    known.clear()
    assert machine.simd_width() == 64
