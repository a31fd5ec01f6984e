#!/usr/bin/env python3
"""Runs the examples of the texts, so that they are true.

    python3 docs/tools/snippets.py SIXFOLD [TEXT...]                 run the marked `sh` examples, compare the marked Rust ones
    python3 docs/tools/snippets.py --python PYTHON [TEXT...]         run the marked Python examples with that interpreter

A line `<!-- run -->` above a code block marks an example that runs on the repository's sample data within seconds. The examples of a
text run one after the other in one empty folder, with `data`, `weights` and the other folders of the repository beside them; the
first that ends with another status than 0 is shown with its output, and the exit status is 1. A line `<!-- from: FILE -->` above a
block says that each of its lines stands in FILE, whose own checks compile it.

With SIXFOLD, every other `sh` example is read too: each option that it gives `sixfold` stands in that command's help, as
docs/reference/cli.md has it.
"""

import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
BLOCK = re.compile(r"(?m)^[ ]*<!-- (run|from: (\S+)) -->\n(?:[ ]*\n)?([ ]*)```(\w+)\n(.*?)^\3```", re.DOTALL)
LINKED = ("data", "weights", "benches", "crates")


def blocks(path):
    """The marked blocks of a text: line, mark, file to compare with, language, code."""
    text = path.read_text()
    for match in BLOCK.finditer(text):
        indent = len(match.group(3))
        code = "\n".join(line[indent:] for line in match.group(5).splitlines())
        yield text.count("\n", 0, match.start()) + 1, match.group(1), match.group(2), match.group(4), code


def texts(named):
    if named:
        return [Path(name).resolve() for name in named]
    return [ROOT / "README.md", ROOT / "python/README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def compare(code, file):
    """Lines of an example that its file does not have."""
    there = {re.sub(r"^//[!/] ?", "", line.strip()).strip() for line in (ROOT / file).read_text().splitlines()}
    return [line for line in code.splitlines() if line.strip() and line.strip() not in there]


def known_options():
    """The options of each command, from the reference page."""
    page = (ROOT / "docs/reference/cli.md").read_text()
    sections = re.findall(r"(?ms)^## (sixfold[^\n]*)\n\n```text\n(.*?)^```", page)
    return {name: set(re.findall(r"(?m)^ +(?:-\w, )?(--[a-z][\w-]*)", text)) for name, text in sections}


def unknown_options(path, commands):
    """Where the examples of a text give a command an option that it does not have."""
    text = path.read_text()
    for block in re.finditer(r"(?m)^([ ]*)```sh\n(.*?)^\1```", text, re.DOTALL):
        first = text.count("\n", 0, block.start()) + 2
        for line, code in enumerate(re.sub(r"\\\n", "  ", block.group(2)).split("\n"), first):
            for words in (part.split() for part in re.split(r"&&|;|\|", code.split(" #")[0])):
                if words[:1] != ["sixfold"] or words[1:2] == ["serve"]:
                    continue
                name = next(" ".join(words[:n]) for n in range(len(words), 0, -1) if " ".join(words[:n]) in commands)
                for option in (word.split("=")[0].strip("[]") for word in words if word.lstrip("[").startswith("--")):
                    if option not in commands[name] | commands["sixfold"]:
                        yield f"{path.relative_to(ROOT)}, near line {line}: {name} has no option {option}"


def main():
    arguments = sys.argv[1:]
    python = arguments[:1] == ["--python"]
    arguments = arguments[python:]
    if not arguments:
        print(__doc__, file=sys.stderr)
        return 2
    # A virtual environment's interpreter is a link that has to be called by its own name.
    program, named = Path(os.path.abspath(arguments[0])), arguments[1:]
    if not program.is_file():
        print(f"snippets.py: there is no program {program}", file=sys.stderr)
        return 2
    ran, started = 0, time.monotonic()
    commands = known_options()
    wrong = [] if python else [line for path in texts(named) for line in unknown_options(path, commands)]
    if wrong:
        print("\n".join(wrong))
        return 1
    for path in texts(named):
        with tempfile.TemporaryDirectory() as folder:
            tools = Path(folder) / "bin"
            tools.mkdir()
            work = Path(folder) / "work"
            work.mkdir()
            for name in LINKED:
                (work / name).symlink_to(ROOT / name)
            if not python:
                (tools / "sixfold").symlink_to(program)
            env = {**os.environ, "PATH": f"{tools}{os.pathsep}{os.environ['PATH']}", "XDG_CACHE_HOME": f"{folder}/cache"}
            for key in [key for key in env if key.startswith("SIXFOLD_")]:
                del env[key]
            for line, mark, file, language, code in blocks(path):
                where = f"{path.relative_to(ROOT)}:{line}"
                if file and not python:
                    missing = compare(code, file)
                    if missing:
                        print(f"{where}: {file} has no line `{missing[0].strip()}`")
                        return 1
                    ran += 1
                if mark != "run" or (language == "python") != python:
                    continue
                command = [str(program), "-c", code] if python else ["bash", "-euo", "pipefail", "-c", code]
                start = time.monotonic()
                run = subprocess.run(command, cwd=work, env=env, text=True, stdin=subprocess.DEVNULL,
                                     stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
                ran += 1
                print(f"{time.monotonic() - start:6.1f} s  {where}")
                if run.returncode != 0:
                    print(f"{code}\n{run.stdout}{where}: ended with {run.returncode}")
                    return 1
    print(f"{ran} examples, {time.monotonic() - started:.0f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main())
