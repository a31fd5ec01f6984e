"""Measures the house: lines per crate, the longest functions, the longest parameter lists, and public names that no other crate uses.

    python benches/house.py            lines per crate, the ten longest functions, the ten longest parameter lists
    python benches/house.py --unused   public items of the libraries whose name stands in no other crate, test, bench or example

Names are compared as words: an item whose name is also used for something else is not reported. The count of parameters leaves out
`self`, the count of lines takes in everything from `fn` to the closing brace, blank lines and comments too.
"""

import argparse
import pathlib
import re
import sys

ROOT = pathlib.Path(__file__).resolve().parent.parent
NOT_CODE = re.compile(
    r'''//[^\n]*|/\*.*?\*/|r(?P<hash>\#*)".*?"(?P=hash)|b?"(?:\\.|[^"\\])*"|b?'(?:\\.[^']*|[^'\\])\'''', re.S
)
FUNCTION = re.compile(r"\bfn\s+([a-z_0-9]+)")
PUBLIC = re.compile(
    r"^ *pub (?:const |async |unsafe )*(fn|struct|enum|trait|type|const|static|mod|union) (?:mut )?([A-Za-z_0-9]+)", re.M
)


def code(text):
    """The text with comments, strings and characters blanked, line for line."""
    return NOT_CODE.sub(lambda found: re.sub(r"[^\n]", " ", found.group()), text)


def closing(text, start):
    """The place of the bracket that closes the one at `start`."""
    pairs, open_ones = {")": "(", "]": "[", "}": "{"}, []
    for place in range(start, len(text)):
        if text[place] in "([{":
            open_ones.append(text[place])
        elif text[place] in pairs:
            open_ones.pop()
            if not open_ones:
                return place
    return len(text) - 1


def parameters(text):
    """How many parameters stand between the brackets, without `self`."""
    depth, parts, part = 0, [], ""
    for place, letter in enumerate(text):
        arrow = letter == ">" and text[place - 1] in "-="
        depth += letter in "([{<"
        depth -= letter in ")]}>" and not arrow
        if letter == "," and depth == 0:
            parts.append(part)
            part = ""
        else:
            part += letter
    parts = [p.strip() for p in [*parts, part] if p.strip()]
    return sum(not re.fullmatch(r"&?\s*('\w+\s+)?(mut\s+)?self(\s*:.*)?", p, re.S) for p in parts)


def functions(text):
    """Name, first line, lines and parameters of every function with a body."""
    for found in FUNCTION.finditer(text):
        place = found.end()
        if text[place : place + 1] == "<":
            depth = 0
            while place < len(text):
                depth += text[place] == "<"
                depth -= text[place] == ">" and text[place - 1] not in "-="
                place += 1
                if depth == 0:
                    break
        if text[place : place + 1] != "(":
            continue
        end = closing(text, place)
        body = re.compile(r"[{;]").search(text, end)
        while body and text[body.start()] == ";" and text.count("[", end, body.start()) > text.count("]", end, body.start()):
            body = re.compile(r"[{;]").search(text, body.end())
        if not body or text[body.start()] == ";":
            continue
        first = text.count("\n", 0, found.start()) + 1
        last = text.count("\n", 0, closing(text, body.start())) + 1
        yield found.group(1), first, last - first + 1, parameters(text[place + 1 : end])


def crates():
    """Name and folder of every crate."""
    return [(p.parent.name, p.parent) for p in sorted(ROOT.glob("crates/*/Cargo.toml"))] + [("python", ROOT / "python")]


def measured():
    """Prints the measures."""
    every, all_lines = [], 0
    print(f"{'crate':24} {'src':>6} {'tests, benches, examples':>25}")
    for name, folder in crates():
        counts = {True: 0, False: 0}
        for file in sorted(folder.rglob("*.rs")):
            if "target" in file.relative_to(folder).parts:
                continue
            text = file.read_text()
            counts[file.relative_to(folder).parts[0] == "src"] += text.count("\n")
            every += [(*f, file.relative_to(ROOT)) for f in functions(code(text))]
        all_lines += sum(counts.values())
        print(f"{name:24} {counts[True]:6} {counts[False]:25}")
    print(f"{all_lines} lines, {len(every)} functions\n")
    for title, key in [("lines", 2), ("parameters", 3)]:
        print(f"most {title}:")
        for found in sorted(every, key=lambda f: (-f[key], str(f[4]), f[1]))[:10]:
            print(f"{found[key]:5}  {found[0]}  {found[4]}:{found[1]}")


def unused():
    """Prints public names that are used in their own crate only."""
    words = {}
    for name, folder in crates():
        for file in [*folder.rglob("*.rs"), *folder.glob("README.md")]:
            parts = file.relative_to(folder).parts
            # Tests, benches and examples are other crates to the compiler, and so is a README's code, which rustdoc runs.
            owner = name if parts[0] == "src" else f"{name}/{parts[0]}"
            words.setdefault(owner, set()).update(re.findall(r"\w+", file.read_text()))
    for name, folder in crates():
        if not (folder / "src" / "lib.rs").exists():
            continue
        others = set().union(*(w for owner, w in words.items() if owner != name))
        for file in sorted((folder / "src").rglob("*.rs")):
            text = file.read_text()
            text = text.split("#[cfg(test)]\nmod tests")[0]
            for found in PUBLIC.finditer(code(text)):
                if found.group(2) not in others:
                    line = text.count("\n", 0, found.start()) + 1
                    print(f"{file.relative_to(ROOT)}:{line + (text[found.start()] == chr(10))} {found.group(1)} {found.group(2)}")


if __name__ == "__main__":
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--unused", action="store_true", help="list public names that no other crate uses")
    sys.exit(unused() if arguments.parse_args().unused else measured())
