#!/usr/bin/env python3
"""Writes man pages from the program's own help: one for `sixfold` and one for each of its commands.

    python3 packaging/man.py SIXFOLD SIXFOLD-EXPERIMENTS DIR    write DIR/sixfold.1, DIR/sixfold-demo.1, ...

The pages say what `--help` says, so they cost no dependency of the program.
"""

import re
import subprocess
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "docs/tools"))
sys.dont_write_bytecode = True

from reference import commands  # noqa: E402

WIDTH = 100  # of a help text
TITLE = re.compile(r"^([A-Z][a-z]+):$")


def escaped(text):
    """A text as troff prints it, character for character."""
    text = text.replace("\\", "\\e").replace("-", "\\-").replace("'", "\\(aq").replace("`", "\\(ga")
    return "\\&" + text if text.startswith(".") else text


def unwrapped(lines):
    """Lines that help broke at its width, whole again: a line continues where the next has its indent and its first word had no room."""
    out, room, before = [], 0, None
    for line in lines:
        indent, words = len(line) - len(line.lstrip()), line.split()
        if words and indent == before and len(words[0]) + 1 > room:
            out[-1] += f" {line.strip()}"
        else:
            out.append(line)
        room, before = WIDTH - len(line), indent if words else None
    return out


def parted(text):
    """The help in its parts: (title, lines); what has no title stands under ''."""
    parts = [("", [])]
    for line in text.splitlines():
        title = TITLE.match(line)
        if title:
            parts.append((title.group(1), []))
        elif line.startswith("Usage: "):
            parts.append(("Usage", [line.removeprefix("Usage: ")]))
        elif parts[-1][0] in ("Usage", "Arguments", "Options", "Commands") and line and not line.startswith(" "):
            parts.append(("", [line]))
        else:
            parts[-1][1].append(line)
    return parts


def entries(lines):
    """The entries of a list of options, arguments or commands: what it is called, and paragraphs about it."""
    least = min((len(line) - len(line.lstrip()) for line in lines if line.strip()), default=0)
    found = []
    for line in lines:
        indent = len(line) - len(line.lstrip())
        # Options without a short name stand four columns further in.
        if line.strip() and indent <= (least + 4 if line.lstrip().startswith("-") else least):
            name, _, said = line.strip().partition("  ")
            found.append((name, [said.strip()] if said.strip() else []))
        elif line.strip() and found:
            paragraphs = found[-1][1]
            if line.lstrip().startswith("- "):  # one of the possible values
                paragraphs.append(" ".join(line.split()))
            elif paragraphs and paragraphs[-1] is not None:
                paragraphs[-1] += f" {line.strip()}"
            else:
                paragraphs[-1:] = [line.strip()]
        elif found and found[-1][1]:
            found[-1][1].append(None)
    return [(name, [text for text in paragraphs if text]) for name, paragraphs in found]


def listed(lines):
    out = []
    for name, paragraphs in entries(lines):
        out.append(f".TP\n.B {escaped(name)}\n" + "\n.IP\n".join(escaped(text) for text in paragraphs or [" "]))
    return "\n".join(out)


def told(lines):
    """Prose and examples: what is indented is kept as it stands."""
    out, inside = [], False
    for line in unwrapped(lines):
        if line.startswith("  ") != inside and line.strip():
            inside = not inside
            out.append(".PP\n.RS 2\n.nf" if inside else ".fi\n.RE\n.PP")
        out.append(escaped(line.strip()) if line.strip() else ("" if inside else ".PP"))
    if inside:
        out.append(".fi\n.RE")
    text = "\n".join(out).strip("\n")
    return re.sub(r"(?:^|(?<=\n))(?:\.PP\n)+(?=\.PP|$)", "", re.sub(r"\n{2,}", "\n", text)).removesuffix("\n.PP")


def page(words, text, below, version):
    name = "-".join(("sixfold", *words))
    parts = parted(text)
    about = " ".join(parts[0][1]).strip() or name
    out = [f'.TH {name.upper()} 1 "" "sixfold {version}" "Sixfold"\n.nh\n.ad l', f".SH NAME\n{escaped(name)} \\- {escaped(about)}"]
    rest = []
    for title, lines in parts[1:]:
        if title == "Usage":
            synopsis = " ".join(line.strip() for line in lines if line.strip())
            out.append(f".SH SYNOPSIS\n{escaped(synopsis)}")
        elif title in ("Arguments", "Options", "Commands"):
            out.append(f".SH {title.upper()}\n{listed(lines)}")
        elif title in ("Example", "Examples"):
            rest.append(f".SH {title.upper()}\n{told(lines)}")
        else:
            rest.append(f".SH {title.upper() if title else 'NOTES'}\n{told(lines)}")
    out += rest
    others = ["-".join(("sixfold", *other)) for other in ([words[:-1]] if words else []) + below]
    out.append(".SH SEE ALSO\n" + ",\n".join(f".BR {escaped(other)} (1)" for other in others))
    return name, "\n".join(out) + "\n"


def main():
    if len(sys.argv) != 4:
        print(__doc__, file=sys.stderr)
        return 2
    programs = [str(Path(argument).resolve()) for argument in sys.argv[1:3]]
    folder = Path(sys.argv[3])
    folder.mkdir(parents=True, exist_ok=True)
    version = subprocess.run([programs[0], "--version"], capture_output=True, text=True, check=True).stdout.split()[1]
    known = list(commands(programs))
    for words, text in known:
        below = [other for other, _ in known if len(other) == len(words) + 1 and other[: len(words)] == words]
        name, made = page(words, text, below, version)
        (folder / f"{name}.1").write_text(made)
    return 0


if __name__ == "__main__":
    sys.exit(main())
