"""The pages of the documentation as data: blocks of code, marks, links, anchors, pictures."""

import re
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parent.parent
PAGES = sorted(
    [
        ROOT / "README.md",
        ROOT / "CHANGELOG.md",
        *ROOT.glob("*.md"),
        *(p for p in ROOT.glob("docs/**/*.md") if "reference" not in p.relative_to(ROOT).parts),
    ]
)
PAGES = list(dict.fromkeys(PAGES))
# What may stand in a comment before a block; see CONTRIBUTING.md.
MARKS = ("not run", "minutes", "needs", "alone", "before", "after", "within", "single precision")


class Block(NamedTuple):
    """A fenced block: where it is, in what language, its text, and the marks before it."""

    line: int
    section: str
    language: str
    text: str
    marks: dict[str, str]


def name_of(page: Path) -> str:
    """A page's path from the root."""
    return page.relative_to(ROOT).as_posix()


def blocks(text: str) -> list[Block]:
    """The fenced blocks of a page, each with the comments right before it."""
    found: list[Block] = []
    marks: dict[str, str] = {}
    section, lines, i = "", text.split("\n"), 0
    while i < len(lines):
        line = lines[i]
        if fence := re.match(r"( *)(`{3,})(.*)$", line):
            end = next(
                j for j in range(i + 1, len(lines)) if re.fullmatch(rf" *{fence[2]}`*\s*", lines[j])
            )
            body = [x.removeprefix(fence[1]) for x in lines[i + 1 : end]]
            code = "".join(f"{x}\n" for x in body)
            found.append(Block(i + 1, section, fence[3].strip(), code, marks))
            marks, i = {}, end
        elif line.startswith("<!--"):
            end = next(j for j in range(i, len(lines)) if lines[j].rstrip().endswith("-->"))
            mark = "\n".join(lines[i : end + 1]).removeprefix("<!--").rstrip().removesuffix("-->")
            key, _, value = mark.strip().partition(":")
            if key.strip().split(" ")[0] == "within":
                key, value = "within", key.removeprefix("within")
            marks = {**marks, key.strip(): value.strip("\n ") if key != "before" else value}
            i = end
        elif line.startswith("#"):
            section, marks = line, {}
        elif line.strip():
            marks = {}
        i += 1
    return found


def without_code(text: str) -> str:
    """A page without fenced blocks and code in lines, in which nothing is a link."""
    text = re.sub(r"^( *)(`{3,}).*?^ *\2`*\s*$", "", text, flags=re.DOTALL | re.MULTILINE)
    return re.sub(r"(`+)(?!`).+?(?<!`)\1(?!`)", "", text)


def links(text: str) -> list[tuple[str, str, str]]:
    """Links and pictures: ``"!"`` or nothing, what is shown, where it leads."""
    return re.findall(
        r"(!?)\[((?:[^\[\]]|!\[[^\]]*\]\([^)]*\))*)\]\(([^()\s]+)\)", without_code(text)
    )


def anchors(text: str) -> set[str]:
    """The anchors of a page's headings, as GitHub and MyST make them."""
    plain = re.sub(r"^( *)(`{3,}).*?^ *\2`*\s*$", "", text, flags=re.DOTALL | re.MULTILINE)
    found: set[str] = set()
    for title in re.findall(r"^#+ +(.+?) *$", plain, re.MULTILINE):
        title = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", title)
        slug = re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-")
        count = 1
        while (f"{slug}-{count}" if slug in found else slug) in found:
            count += 1
        found.add(f"{slug}-{count}" if slug in found else slug)
    return found


def entries(text: str) -> list[str]:
    """What the tables of contents of a page list."""
    found = []
    for block in blocks(text):
        if block.language == "{toctree}":
            found += [
                re.sub(r"^.*<(.*)>$", r"\1", x.strip())
                for x in block.text.split("\n")
                if x.strip() and not x.startswith(":")
            ]
    return found
