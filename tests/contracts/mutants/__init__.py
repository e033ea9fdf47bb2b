"""Single lines of the package made wrong, and the tests that must notice.

By file in kcons/: its text, with what is made wrong of it as «right→wrong», and the tests that must fail. The text
occurs once in the file. Tests are named as pytest takes them, by the name of their file where no other has it, several
parted by blanks; parameters in brackets are left out where any will do.
"""

from pathlib import Path

from mutants import (
    ase_dynamics,
    batched,
    device,
    files,
    free_energies,
    models,
    openmm_programs,
    solvers,
    steppers,
    studies,
    torchsim,
)

TESTS = Path(__file__).resolve().parents[2]
MODULES = (
    solvers,
    openmm_programs,
    models,
    steppers,
    files,
    studies,
    free_energies,
    ase_dynamics,
    device,
    torchsim,
    batched,
)


def both(text: str) -> tuple[str, str]:
    """The text as it is, and made wrong."""
    head, _, rest = text.partition("«")
    right, _, rest = rest.partition("→")
    wrong, _, tail = rest.partition("»")
    return head + right + tail, head + wrong + tail


def found(test: str) -> str:
    """The test with the path of its file, from the folder that `tests` is in."""
    file, sign, name = test.partition("::")
    (path,) = [TESTS / file] if "/" in file else TESTS.rglob(file)
    return path.relative_to(TESTS.parent).as_posix() + sign + name


#: (file in kcons/, its text, the wrong text, tests that must fail).
MUTANTS = [
    (file, *both(text), " ".join(map(found, tests.split())))
    for module in MODULES
    for file, rows in module.MUTANTS.items()
    for text, tests in rows
]
