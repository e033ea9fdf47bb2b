"""The plugin for all platforms as a wheel: ``python -m kcons.openmm.device.wheel [folder]``.

It serves the OpenMM that is installed here and the sources of this kcons; elsewhere the plugin is compiled as without.
"""

from __future__ import annotations

import base64
import hashlib
import platform
import sys
import tempfile
import zipfile
from pathlib import Path

import openmm

from kcons import __version__
from kcons.openmm.device import build


def make_wheel(folder: str | Path = ".") -> Path:
    """Write the wheel into a folder, and return its path.

    Raises
    ------
    UnsupportedError
        There is no compiler, or it refuses the sources.
    """
    libc = "_".join(platform.libc_ver()[1].split(".")[:2])
    tag = f"py3-none-manylinux_{libc}_{platform.machine()}"
    needed = openmm.version.version.split(".dev")[0]
    number = f"{__version__}+openmm{needed}"
    info = f"{build.PACKAGE}-{number}.dist-info"
    files: dict[str, bytes] = {f"{build.PACKAGE}/__init__.py": b'"""Libraries of kcons for OpenMM."""\n'}
    with tempfile.TemporaryDirectory() as made:
        build.build(Path(made), build.ACCELERATED)
        for path in sorted(Path(made).glob("*.so")):
            files[f"{build.PACKAGE}/{build.digest()}/{path.name}"] = path.read_bytes()
    needs = f"Requires-Dist: openmm=={needed}\nRequires-Dist: kcons=={__version__}\n"
    about = f"Metadata-Version: 2.1\nName: {build.PACKAGE}\nVersion: {number}\n{needs}"
    files[f"{info}/METADATA"] = about.encode()
    files[f"{info}/WHEEL"] = f"Wheel-Version: 1.0\nGenerator: kcons\nRoot-Is-Purelib: false\nTag: {tag}\n".encode()
    target, record = Path(folder) / f"{build.PACKAGE}-{number}-{tag}.whl", f"{info}/RECORD,,\n"
    target.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
            known = base64.urlsafe_b64encode(hashlib.sha256(content).digest()).rstrip(b"=").decode()
            record += f"{name},sha256={known},{len(content)}\n"
        archive.writestr(f"{info}/RECORD", record)
    return target


if __name__ == "__main__":
    print(make_wheel(*sys.argv[1:2]))
