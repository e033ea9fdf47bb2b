"""`kcons` as shells start it, many times: each in a fork of one interpreter that has imported what it needs."""

from __future__ import annotations

import atexit
import json
import os
import subprocess
import sys
from dataclasses import dataclass
from functools import cache

#: Reads a command a line, and forks. The child has the streams that Python makes of its environment at the start, and
#: ends as an interpreter ends, with all that is said when streams are flushed then.
SERVER = r"""
import importlib, io, json, os, runpy, subprocess, sys, tempfile

for name in json.loads(sys.argv[1]):
    importlib.import_module(name)

def stream(number, unbuffered, coding):
    try:
        os.fstat(number)
    except OSError:
        return None  # closed
    raw = io.FileIO(number, "w", closefd=False)
    made = io.TextIOWrapper(
        raw if unbuffered else io.BufferedWriter(raw),
        encoding=coding or None, errors="strict" if number == 1 else "backslashreplace",
        line_buffering=number == 2, write_through=unbuffered,
    )
    made.mode = "w"
    return made

def become(job, out, errors):
    os.dup2(errors, 2)
    os.dup2(out, 1)
    if job["errors_too"]:
        os.dup2(out, 2)
    if job["where"] == "closed":
        os.close(1)
    os.environ.update(job["variables"])
    unbuffered = bool(os.environ.get("PYTHONUNBUFFERED"))
    for number, name in ((1, "stdout"), (2, "stderr")):
        made = stream(number, unbuffered, os.environ.get("PYTHONIOENCODING", "").partition(":")[0])
        setattr(sys, name, made)
        setattr(sys, f"__{name}__", made)
    sys.argv = ["kcons", *job["words"]]

for line in sys.stdin:
    job = json.loads(line)
    with tempfile.TemporaryFile() as said, tempfile.TemporaryFile() as errors:
        reader = None
        if job["where"].startswith("|"):
            reader = subprocess.Popen(["bash", "-c", job["where"][1:]], stdin=subprocess.PIPE, stdout=said)
            out = os.dup(reader.stdin.fileno())
            reader.stdin.close()
        elif job["where"].startswith("/"):
            out = os.open(job["where"], os.O_WRONLY)
        else:
            out = os.dup(said.fileno())
        child = os.fork()
        if child == 0:
            become(job, out, errors.fileno())
            os.close(out)
            break
        os.close(out)
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        if reader:
            reader.wait()
        told = [status]
        for file in (said, errors):
            file.seek(0)
            told.append(file.read().decode("latin-1"))
    print(json.dumps(told), flush=True)
else:
    sys.exit()
runpy.run_module("kcons", run_name="__main__", alter_sys=False)
"""


@dataclass(frozen=True)
class Ended:
    """Exit status of the command, what came out (at the end of its pipe), and what it wrote of errors."""

    status: int
    out: bytes
    errors: str


@cache
def _server(modules: tuple[str, ...]) -> subprocess.Popen[str]:
    """Takes only UTF-8 mode away, as a shell of its own would: its commands differ in the rest."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith("PYTHONUTF8")}
    command = [sys.executable, "-c", SERVER, json.dumps(modules)]
    server = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment)
    atexit.register(server.communicate)
    return server


def shell(*words: object, where: str = "", errors_too: bool = False, modules: tuple[str, ...] = (), **variables: str):
    """`kcons words`, with its output captured, or where it says: `| command`, a file, `closed`.

    Parameters
    ----------
    *words : object
        Words of the command.
    where : str
        Where its output goes.
    errors_too : bool
        Errors go there as well.
    modules : tuple of str
        What the interpreter imports before it forks.
    **variables : str
        Of the environment of the command.
    """
    server = _server(modules)
    assert server.stdin is not None and server.stdout is not None
    job = {"words": [str(word) for word in words], "where": where, "errors_too": errors_too, "variables": variables}
    server.stdin.write(json.dumps(job) + "\n")
    server.stdin.flush()
    status, out, errors = json.loads(server.stdout.readline())
    return Ended(status, out.encode("latin-1"), errors.encode("latin-1").decode(errors="replace"))
