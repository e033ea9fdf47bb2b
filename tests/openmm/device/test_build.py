"""The plugin: where it is compiled, and as a wheel."""

import subprocess
import sys

import pytest

from kcons.errors import UnsupportedError
from kcons.openmm.device import build, wheel

#: Half of the time goes into making the library faster, which no test here runs.
QUICKLY = (*build._FLAGS, "-O0")
pytestmark = pytest.mark.skipif(not build.compiler(), reason="no C++ compiler")


def test_it_is_compiled_once_for_these_sources(tmp_path, monkeypatch):
    """In processes of their own: a second copy of the library would take this one's integrators."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(build, "accelerated", list)
    monkeypatch.setattr(build, "_FLAGS", QUICKLY)
    assert not build.is_built() and build.folder() == tmp_path / "kcons-device"
    begin = f"from kcons.openmm.device import build; build.accelerated, build._FLAGS = list, {QUICKLY}; "
    subprocess.run([sys.executable, "-c", begin + "build.library()"], check=True)
    made = build.folder() / build.digest() / "libKcons.so"
    when = made.stat().st_mtime_ns
    assert build.is_built() and list(made.parent.iterdir()) == [made]
    again = "build.compiler = list; build.library(); build.kernels_library('int other;')"  # none is needed any more
    told = subprocess.run([sys.executable, "-c", begin + again], capture_output=True, text=True, check=False)
    assert made.stat().st_mtime_ns == when
    assert "UnsupportedError: there is no C++ compiler, which steps on Reference and CPU" in told.stderr


def test_what_it_needs(monkeypatch, tmp_path):
    monkeypatch.setattr(build, "places", list)
    assert build.refusal() == ""
    monkeypatch.setattr(build, "HEADERS", tmp_path)
    assert "OpenMM's headers are not at" in build.refusal()
    monkeypatch.setattr(build, "compiler", list)
    assert "no C++ compiler; install g++" in build.refusal()
    with pytest.raises(UnsupportedError, match="no C\\+\\+ compiler"):
        wheel.make_wheel(tmp_path)
    monkeypatch.setattr(build.sys, "platform", "darwin")
    assert build.refusal().startswith("the plugin is made for Linux")


def test_the_compiler_is_that_of_the_user(monkeypatch):
    monkeypatch.setenv("CXX", "g++ -fno-strict-aliasing")
    assert build.compiler()[0].endswith("g++") and build.compiler()[1:] == ["-fno-strict-aliasing"]
    monkeypatch.setenv("CXX", "no-such-compiler -O3")
    assert build.compiler() and "-O3" not in build.compiler()


def test_a_source_that_does_not_compile_is_told(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    with pytest.raises(UnsupportedError, match="refused"):
        build.kernels_library("this is no C++")


def test_a_wheel_is_found_before_the_cache(tmp_path, monkeypatch):
    """Linked with empty libraries of OpenMM's names, for platforms that need not be here."""
    monkeypatch.setattr(build, "ACCELERATED", ("CUDA",))
    monkeypatch.setattr(build, "_FLAGS", QUICKLY)
    made = wheel.make_wheel(tmp_path)
    target = tmp_path / "site"
    install = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--target", str(target), str(made)]
    subprocess.run(install, check=True, capture_output=True)
    monkeypatch.syspath_prepend(str(target))
    place = build.places()[0]
    assert place == target / "kcons_device" / build.digest()
    assert sorted(path.name for path in place.iterdir()) == ["libKcons.so", "libKconsCUDA.so"]
