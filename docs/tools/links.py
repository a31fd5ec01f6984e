#!/usr/bin/env python3
"""Checks the links of all texts: files that are linked exist, headings that are linked exist, the book holds together.

    python3 docs/tools/links.py            exit status 1, naming file and line of each broken link
    python3 docs/tools/links.py HTML       the same for a built book (mdbook build docs -d HTML)

Rules: a relative link names a file of the repository, a `#part` a heading of it; every page of the book stands in SUMMARY.md, and
links pages and images of the book alone, because the site has nothing else. Links to other sites are not followed. The files that
docs/coverage.md names exist.
"""

import re
import subprocess
import sys
import unicodedata
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

ROOT = Path(__file__).resolve().parents[2]
BOOK = ROOT / "docs"
LINK = re.compile(r"!?\[(?:[^\[\]]|\[[^\]]*\])*\]\(\s*<?([^)\s>]+)>?(?:\s+\"[^\"]*\")?\s*\)")
DEFINITION = re.compile(r"(?m)^\[[^\]]+\]:\s*(\S+)")


def prose(text):
    """A text without code, line for line, so that numbers of lines stay."""
    out, fence = [], None
    for line in text.split("\n"):
        mark = re.match(r"\s*(```+|~~~+)", line)
        if fence:
            out.append("")
            if mark and mark.group(1).startswith(fence):
                fence = None
        elif mark:
            fence = mark.group(1)
            out.append("")
        else:
            out.append(re.sub(r"(`+)(?:(?!\1).)+\1", lambda code: "`" + "x" * (len(code.group()) - 2) + "`", line))
    return "\n".join(out)


def slug(heading):
    """The id of a heading, as GitHub and mdBook make it."""
    plain = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).replace("`", "")
    kept = [c for c in plain.strip().lower() if c in "-_ " or unicodedata.category(c)[0] in "LN"]
    return "".join(kept).replace(" ", "-")


def headings(path, cache={}):
    """The ids of a text's headings."""
    if path not in cache:
        ids, fence = set(), None
        for line in path.read_text().split("\n"):
            mark = re.match(r"\s*(```+|~~~+)", line)
            if mark:
                fence = None if fence and mark.group(1).startswith(fence) else fence or mark.group(1)
            heading = None if fence else re.match(r"#{1,6}\s+(.*?)\s*#*$", line)
            if heading:
                base = name = slug(heading.group(1))
                number = 0
                while name in ids:
                    number += 1
                    name = f"{base}-{number}"
                ids.add(name)
            if not fence:
                ids.update(re.findall(r'\bid="([^"]+)"', line))
        cache[path] = ids
    return cache[path]


def texts():
    """All texts of the repository: those that git knows or would add."""
    run = subprocess.run(["git", "ls-files", "-co", "--exclude-standard", "*.md"], cwd=ROOT, capture_output=True, text=True)
    if run.returncode == 0:
        return sorted(path for path in (ROOT / line for line in run.stdout.splitlines()) if path.exists())
    return sorted(path for path in ROOT.rglob("*.md") if not {"target", "node_modules", "out"} & set(path.relative_to(ROOT).parts))


def check_texts():
    wrong = []
    summary = BOOK / "SUMMARY.md"
    pages = {summary} | {(BOOK / target.split("#")[0]).resolve() for target in LINK.findall(summary.read_text())}
    every, links = texts(), 0
    for path in every:
        text = prose(path.read_text())
        for match in [*LINK.finditer(text), *DEFINITION.finditer(text)]:
            target = match.group(1)
            if urlsplit(target).scheme or target.startswith("//"):
                continue
            links += 1
            where = f"{path.relative_to(ROOT)}:{text.count(chr(10), 0, match.start()) + 1}"
            name, _, part = target.partition("#")
            file = (path.parent / unquote(name)).resolve() if name else path
            if not file.exists():
                wrong.append(f"{where}: {target}: there is no such file")
            elif part and file.suffix == ".md" and unquote(part) not in headings(file):
                wrong.append(f"{where}: {target}: {file.relative_to(ROOT)} has no such heading")
            elif path in pages and path != summary and file not in pages and file.suffix not in (".jpg", ".png", ".svg"):
                wrong.append(f"{where}: {target}: is no page of the book (SUMMARY.md); name it as `code` instead")
    for path in every:
        if BOOK in path.parents and path not in pages:
            wrong.append(f"{path.relative_to(ROOT)}: is not in docs/SUMMARY.md")
    wrong += check_coverage()
    return wrong, f"{links} links in {len(every)} texts"


def check_coverage():
    """The files that docs/coverage.md names in its last column: `x/y.rs` is crates/sixfold-x/y.rs."""
    wrong, rows = [], 0
    for number, line in enumerate((BOOK / "coverage.md").read_text().split("\n"), 1):
        cells = line.strip("|").split(" | ")
        if not line.startswith("| ") or len(cells) < 3:
            continue
        rows += 1
        for name in re.findall(r"`([a-z0-9-]+/[^`]+)`", cells[-1]):
            if not (ROOT / "crates" / f"sixfold-{name}").exists():
                wrong.append(f"docs/coverage.md:{number}: {name}: there is no such file in crates")
    return wrong if rows > 100 else [*wrong, f"docs/coverage.md: only {rows} rows were read"]


class Page(HTMLParser):
    """The links and ids of a built page."""

    def __init__(self):
        super().__init__()
        self.links, self.ids = [], set()

    def handle_starttag(self, tag, attributes):
        for key, text in attributes:
            if key == "id" and text:
                self.ids.add(text)
            if key in ("href", "src") and text and tag in ("a", "img", "link", "script"):
                self.links.append(text)


def check_html(folder):
    pages = {}
    for path in sorted(folder.rglob("*.html")):
        pages[path.resolve()] = page = Page()
        page.feed(path.read_text())
    if not pages:
        return [f"{folder}: no pages"], "0 links"
    wrong, links = [], 0
    for path, page in pages.items():
        # The single page to print repeats all others, 404 has addresses of the site's root.
        if path.name in ("print.html", "404.html", "toc.html"):
            continue
        for target in page.links:
            parts = urlsplit(target)
            if parts.scheme or target.startswith(("//", "javascript:")):
                continue
            links += 1
            file = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            if not file.exists():
                wrong.append(f"{path.relative_to(folder.resolve())}: {target}: there is no such file")
            elif parts.fragment and file in pages and unquote(parts.fragment) not in pages[file].ids:
                wrong.append(f"{path.relative_to(folder.resolve())}: {target}: no such part")
    return wrong, f"{links} links in {len(pages)} built pages"


def main():
    if len(sys.argv) > 2:
        print(__doc__, file=sys.stderr)
        return 2
    wrong, count = check_html(Path(sys.argv[1])) if len(sys.argv) == 2 else check_texts()
    print("\n".join(wrong) if wrong else f"{count}, none broken")
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
