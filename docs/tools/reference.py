#!/usr/bin/env python3
"""Writes the reference pages: the command line from the program's own help, Python from the package's stubs.

    python3 docs/tools/reference.py SIXFOLD SIXFOLD-EXPERIMENTS            write docs/reference/cli.md and docs/reference/python.md
    python3 docs/tools/reference.py SIXFOLD SIXFOLD-EXPERIMENTS --check    exit status 1, naming the page, where they differ

SIXFOLD is the program with its default features; what a feature adds (serve) is not in the page.
"""

import ast
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
REFERENCE = ROOT / "docs/reference"
STUBS = ROOT / "python/package/sixfold"


# ---- command line --------------------------------------------------------------------------------------------------


def help_of(program, words):
    """The help of a command as it is printed where there is no terminal: 100 columns, no settings of this machine."""
    clean = {key: text for key, text in os.environ.items() if not key.startswith(("SIXFOLD_", "XDG_"))}
    clean.pop("COLUMNS", None)
    # In an empty folder: a help text may show what it finds there.
    with tempfile.TemporaryDirectory() as empty:
        run = subprocess.run([program, *words, "--help"], capture_output=True, text=True, env=clean, cwd=empty, stdin=subprocess.DEVNULL)
    if run.returncode != 0:
        raise SystemExit(f"reference.py: {program} {' '.join(words)} --help ended with {run.returncode}: {run.stderr.strip()}")
    return run.stdout.rstrip()


def commands(programs, words=()):
    """All commands below `words`, each with its help."""
    # `sixfold reproduce` and two commands of `grasp` are run by the other program.
    other = words[:1] == ("reproduce",) or words[:2] in (("grasp", "compare"), ("grasp", "measure"))
    text = help_of(programs[other], words)
    yield words, text
    listed = re.search(r"^Commands:\n(.*?)(?:\n\n|\Z)", text, re.DOTALL | re.MULTILINE)
    for name in re.findall(r"^  ([a-z][\w-]*)", listed.group(1), re.MULTILINE) if listed else []:
        if name != "help":
            yield from commands(programs, (*words, name))


def command_line(programs):
    pages = [(" ".join(("sixfold", *words)), text) for words, text in commands(programs)]
    contents = "\n".join(f"- [{name}](#{name.replace(' ', '-')})" for name, _ in pages)
    bodies = "\n".join(f"## {name}\n\n```text\n{text}\n```\n" for name, text in pages)
    return f"""# Command line

Written by `docs/tools/reference.py` from the program's `--help`; do not edit. [Commands](../commands.md) explains them with examples.
`sixfold serve` is in programs built with the feature `serve` ([Pages and HTTP API](../serve.md)).

{contents}

{bodies}"""


# ---- Python --------------------------------------------------------------------------------------------------------


def signature(node, name=""):
    """A function with the first line of what its stub says about it."""
    said = ast.get_docstring(node)
    return plain_signature(node, name) + (f"\n    # {said.splitlines()[0]}" if said else "")


def plain_signature(node, name):
    """A function as one line, or one argument a line where that is too long."""
    returns = f" -> {ast.unparse(node.returns)}" if node.returns else ""
    arguments = ast.unparse(node.args)
    name = name or node.name
    line = f"{name}({arguments}){returns}"
    if len(line) <= 110:
        return line
    single = ast.parse(f"def f({arguments}): ...").body[0].args
    parts, plain = [], single.posonlyargs + single.args
    defaults = [None] * (len(plain) - len(single.defaults)) + single.defaults
    show = lambda argument, default: ast.unparse(argument) + (f" = {ast.unparse(default)}" if default else "")  # noqa: E731
    parts += [show(argument, default) for argument, default in zip(plain, defaults)]
    if single.vararg:
        parts.append("*" + ast.unparse(single.vararg))
    elif single.kwonlyargs:
        parts.append("*")
    parts += [show(argument, default) for argument, default in zip(single.kwonlyargs, single.kw_defaults)]
    if single.kwarg:
        parts.append("**" + ast.unparse(single.kwarg))
    return name + "(\n" + "".join(f"    {part},\n" for part in parts) + f"){returns}"


def class_lines(node):
    """Constructor, attributes and methods of a class."""
    fields = [f"{ast.unparse(item.target)}: {ast.unparse(item.annotation)}" for item in node.body if isinstance(item, ast.AnnAssign)]
    lines = []
    for item in node.body:
        if not isinstance(item, ast.FunctionDef) or (item.name.startswith("_") and item.name != "__init__"):
            continue
        decorators = {ast.unparse(decorator) for decorator in item.decorator_list}
        if any(text.endswith(".setter") for text in decorators):
            continue
        if item.args.args and item.args.args[0].arg in ("self", "cls"):
            item.args.args = item.args.args[1:]
            item.args.defaults = item.args.defaults[-len(item.args.args):] if item.args.args else []
        if item.name == "__init__":
            item.returns = None
            lines.insert(0, signature(item, node.name))
        elif "property" in decorators:
            fields.append(f"{item.name}: {ast.unparse(item.returns)}" if item.returns else item.name)
        else:
            kind = next((f"{node.name}." for text in decorators if text in ("classmethod", "staticmethod")), ".")
            lines.append(signature(item, f"{kind}{item.name}"))
    return [*lines[:1], *(f".{field}" for field in fields), *lines[1:]] if lines and lines[0].startswith(node.name + "(") else \
        [*(f".{field}" for field in fields), *lines]


def python():
    text = """# Python package

Written by `docs/tools/reference.py` from the package's stubs; do not edit. Every function has a docstring with shapes, units and an
example: `help(sixfold.estimate_ppf)`. `python/README.md` says what belongs together.
"""
    for stub in ("__init__.pyi", "bop.pyi", "coco.pyi", "metrics.pyi"):
        module = "sixfold" if stub == "__init__.pyi" else f"sixfold.{stub[:-4]}"
        tree = ast.parse((STUBS / stub).read_text())
        text += f"\n## {module}\n"
        functions = [signature(node) for node in tree.body if isinstance(node, ast.FunctionDef) and not node.name.startswith("_")]
        if functions:
            text += "\n```python\n" + "\n\n".join(functions) + "\n```\n"
        for node in tree.body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                bases = [ast.unparse(base) for base in node.bases]
                lines = class_lines(node)
                text += f"\n### {module}.{node.name}\n"
                text += f"\nAn error, a kind of `{bases[0]}`.\n" if not lines and bases else ""
                text += "\n```python\n" + "\n".join(lines) + "\n```\n" if lines else ""
    return text


def main():
    arguments = [argument for argument in sys.argv[1:] if argument != "--check"]
    if len(arguments) != 2 or any(argument.startswith("-") for argument in arguments):
        print(__doc__, file=sys.stderr)
        return 2
    check, wrong = "--check" in sys.argv, 0
    programs = [str(Path(argument).resolve()) for argument in arguments]
    for name, text in (("cli.md", command_line(programs)), ("python.md", python())):
        page = REFERENCE / name
        old = page.read_text() if page.exists() else ""
        if old == text:
            continue
        wrong += 1
        if check:
            line = next((number for number, (a, b) in enumerate(zip(old.splitlines(), text.splitlines()), 1) if a != b), "at its end")
            print(f"docs/reference/{name} differs from the program or the stubs (line {line}): run docs/tools/reference.py")
        else:
            REFERENCE.mkdir(exist_ok=True)
            page.write_text(text)
            print(f"docs/reference/{name} written")
    print(f"2 pages, {wrong} {'differ' if check else 'written'}")
    return int(check and wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
