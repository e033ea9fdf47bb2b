"""Install, import, a step and a command on each Python from 3.11 on that this machine has.

First with the source distribution, then with the wheel. `--oldest 3.12` prints the path of the oldest Python from 3.12
on that this machine has, and nothing where there is none.

Looks for python3.x on the PATH and for what pyenv has installed. Says what is left out, and why.
"""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

OLDEST = (3, 11)
STEP = """
import numpy as np
from kcons import ConstraintSet
from kcons.constraints import Distance
from kcons.motion import Motion
from kcons.steppers import Rattle, System, run
x = np.array([[0.0, 0, 0], [1.0, 0, 0], [1.5, 0.8, 0]])
held = ConstraintSet(Distance([[0, 1], [1, 2]]), x, np.array([1.0, 2.0, 3.0]))
system = System(Motion(held, x), lambda x, t: -x)
end = run(system, system.initial_state(x, np.zeros_like(x)), 0.01, 10, stepper=Rattle())
assert np.abs(held.value(end.positions)).max() < 1e-14 and np.abs(end.positions - x).max() > 1e-4
"""


def candidates():
    """Paths of interpreters, those on the PATH first."""
    for folder in os.environ["PATH"].split(os.pathsep):
        if Path(folder).is_dir():
            yield from sorted(p for p in Path(folder).iterdir() if re.fullmatch(r"python3\.\d+", p.name))
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv"))
    yield from sorted(pyenv.glob("versions/*/bin/python3"))


def version_of(python):
    """(major, minor, micro, 'final' or another level), or what the interpreter says instead."""
    code = "import sys, venv, ensurepip; print(*sys.version_info[:4])"
    result = subprocess.run([python, "-c", code], capture_output=True, text=True)
    words = result.stdout.split()
    if result.returncode or len(words) != 4:
        return (result.stderr or result.stdout).strip().splitlines()[:1] or ["says nothing"]
    return (*map(int, words[:3]), words[3])


def smoke(python, folder):
    shutil.rmtree(folder, ignore_errors=True)
    place = folder / "bin"
    install = [place / "python", "-m", "pip", "install", "--quiet"]
    used = [[place / "python", "-c", STEP], [place / "kcons", "doctor"]]
    (source,), (wheel,) = folder.parent.glob("dist/*.tar.gz"), folder.parent.glob("dist/*.whl")
    commands = [
        [python, "-m", "venv", folder],
        [*install, source],
        *used,
        [*install, "--force-reinstall", "--no-deps", wheel],
        *used,
    ]
    for command in commands:
        # Elsewhere than in the source tree, so that what was installed is what is imported.
        result = subprocess.run(command, cwd=folder.parent, capture_output=True, text=True)
        if result.returncode:
            print(f"   FAILED: {' '.join(map(str, command))}\n{result.stdout}{result.stderr}")
            return False
    # Without any extra, what needs one says which.
    for words, extra in ((["kcons", "compare", "water"], "plots"), (["python", "-c", "import kcons.openmm"], "openmm")):
        command = [place / words[0], *words[1:]]
        result = subprocess.run(command, cwd=folder.parent, capture_output=True, text=True)
        if not result.returncode or f"'kcons[{extra}]'" not in result.stderr:
            print(f"   FAILED to name the extra {extra}: {' '.join(words)}\n{result.stdout}{result.stderr}")
            return False
    shutil.rmtree(folder)
    return True


def oldest(least):
    """Path of the oldest released Python from `least` on; '' without any."""
    found = [(version_of(python), python) for python in candidates()]
    good = [(v[:3], str(python)) for v, python in found if len(v) == 4 and v[3] == "final" and v[:2] >= least]
    return min(good, default=(None, ""))[1]


def main(work):
    good, done = True, {}
    for python in candidates():
        version = version_of(python)
        if isinstance(version, list):
            print(f"-- {python}: skipped, does not run: {version[0]}")
            continue
        name = ".".join(map(str, version[:3]))
        if version[:2] < OLDEST:
            print(f"-- {python} ({name}): skipped, older than {OLDEST[0]}.{OLDEST[1]}")
        elif version[3] != "final":
            print(f"-- {python} ({name}): skipped, not released yet")
        elif version[:2] in done:
            print(f"-- {python} ({name}): skipped, {version[0]}.{version[1]} {done[version[:2]]}")
        else:
            done[version[:2]] = "was here already"
            print(f"-- {python} ({name})", flush=True)
            good &= smoke(python, work / f"python{name}")
    return 0 if good else 1


if __name__ == "__main__":
    if sys.argv[1] == "--oldest":
        print(oldest(tuple(map(int, sys.argv[2].split(".")))))
    else:
        sys.exit(main(Path(sys.argv[1])))
