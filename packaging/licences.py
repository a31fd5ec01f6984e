#!/usr/bin/env python3
"""Prints the crates that programs are linked with, and the texts of their licences, each once.

    python3 packaging/licences.py TARGET CRATE... > THIRD-PARTY.txt

TARGET is the triple that the programs were built for, CRATE the crates of ours that they are built from. The texts are those in the crates' own packages; which crates there are
says `cargo metadata`, without network.
"""

import json
import re
import subprocess
import sys
from pathlib import Path

TEXT = re.compile(r"(?i)^(licen[cs]e|copying|copyright|notice|unlicense)")


def linked(target, programs):
    """The packages below the programs by normal dependencies, by name and version."""
    command = ["cargo", "metadata", "--format-version", "1", "--offline", "--locked", "--filter-platform", target]
    told = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    # `cargo tree` knows which of them the programs' features ask for.
    edges = ["cargo", "tree", "--offline", "--locked", "--target", target, "-e", "normal,no-proc-macro", "--prefix", "none", "-f", "{p}"]
    tree = "".join(
        subprocess.run([*edges, "-p", program], check=True, capture_output=True, text=True).stdout for program in programs
    )
    named = {tuple(line.split()[:2]) for line in tree.splitlines() if line.strip()}
    found = [p for p in told["packages"] if p["source"] and (p["name"], f"v{p['version']}") in named]
    return sorted(found, key=lambda p: (p["name"], p["version"]))


def main():
    if len(sys.argv) < 3 or sys.argv[1].startswith("-"):
        print(__doc__, file=sys.stderr)
        return 2
    packages = linked(sys.argv[1], sys.argv[2:])
    texts = {}
    print(f"What is built from {' and '.join(sys.argv[2:])} is linked with these crates:\n")
    for package in packages:
        print(f"    {package['name']} {package['version']}: {package['license'] or 'see its text below'}")
        for file in sorted(Path(package["manifest_path"]).parent.iterdir()):
            if file.is_file() and TEXT.match(file.name):
                text = "\n".join(line.rstrip() for line in file.read_text(errors="replace").strip().splitlines())
                texts.setdefault(text, []).append(f"{package['name']} {package['version']} ({file.name})")
    for text, named in sorted(texts.items(), key=lambda pair: pair[1][0]):
        print("\n" + "-" * 100 + "\n" + "\n".join(named) + "\n\n" + text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
