"""Single lines of the package made wrong, and the tests that must notice.

By file in kcons/: its text, with what is made wrong of it as «right→wrong», and the tests that must fail. The text
occurs once in the file. Tests are written as ``file::name`` for `test_file.py::test_name`, with a folder where another
file has the name, several parted by blanks; parameters in brackets are left out where any will do.
"""

from importlib import import_module
from pathlib import Path

TESTS = Path(__file__).resolve().parents[2]
FILES = list(TESTS.rglob("test_*.py"))


def both(text: str) -> tuple[str, str]:
    """The text as it is, and made wrong."""
    head, _, rest = text.partition("«")
    right, _, rest = rest.partition("→")
    wrong, _, tail = rest.partition("»")
    return head + right + tail, head + wrong + tail


def found(test: str) -> str:
    """The test as pytest takes it."""
    place, sign, name = test.partition("::")
    folder, _, file = place.rpartition("/")
    (path,) = [path for path in FILES if path.name == f"test_{file}.py" and (TESTS / folder) in path.parents]
    return path.relative_to(TESTS.parent).as_posix() + (sign and f"::test_{name}")


#: (file in kcons/, its text, the wrong text, tests that must fail).
MUTANTS = [
    (file, *both(text), " ".join(map(found, tests.split())))
    for path in sorted(Path(__file__).parent.glob("[a-z]*.py"))
    for file, rows in import_module(f"mutants.{path.stem}").MUTANTS.items()
    for text, tests in rows.items()
]
