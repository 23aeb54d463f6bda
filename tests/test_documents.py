"""Every snippet of the README and of the pages runs, and prints what stands beside it.

The blocks of a page run in order, in one namespace and an empty folder beside ``examples``. What is
printed is compared: with the block without a language that follows, with the comment behind a
``print``, and in ``pycon`` and ``console`` blocks with what stands there. Comments before a block
say what is not so, see CONTRIBUTING.md:

- ``<!-- not run: why -->``: it needs a cluster, another program, a file that is not there.
- ``<!-- minutes: why -->``: it runs with ``-m exhaustive`` only, with all of its page.
- ``<!-- needs: package -->``: it runs where that is installed.
- ``<!-- alone -->``: a namespace and a test of its own, as have those that come after it.
- ``<!-- single precision -->``: JAX's own setting, for all of the page; the tests' is double.
- ``<!-- before: code -->``, ``<!-- after: code -->``: Python that is not shown.
- ``<!-- within 0.1 -->``: numbers may differ by so much, by themselves or relatively.
"""

import contextlib
import doctest
import io
import re
import shlex
import warnings
from pathlib import Path
from typing import Any

import jax
import pytest
from click.testing import CliRunner

from jaxltl.cli import main
from notebooks.execute import difference
from tests.pages import MARKS, PAGES, ROOT, Block, blocks, name_of

MAX_PROGRAMS = 350  # that the default tests compile at most

RUN = ("python", "sh", "pycon", "console")
# Of a page that says nothing of how it is tested: what is slow in it, by a text.
SLOW = {"README.md": ("ppo.train(", "jaxltl learn", "mlirl.train(")}
ALL_SLOW = (
    "docs/answers.md",
    "docs/continuous-proofs.md",
    "docs/data.md",
    "docs/deployment.md",
    "docs/devices.md",
    "docs/gallery.md",
    "docs/guides/",
    "docs/models.md",
    "docs/parameters.md",
    "docs/prepared.md",
    "docs/tasks-in-environments.md",
    "docs/training-loops.md",
    "docs/training-runs.md",
    "docs/worlds-of-the-literature.md",
)
INSTALLED = re.compile(r"(pip install|pytest|python -m build|git clone|cd )\b")
PROMISE = re.compile(r"[-\[({'\"\d]|(True|False|None)\b|[!FGX] ?\(")


def chapters() -> list[Any]:
    """The tests: for each page, or part of one that stands alone, its blocks."""
    found = []
    for page in PAGES:
        parts: list[list[Block]] = [[]]
        for block in blocks(page.read_text()):
            if "alone" in block.marks:
                parts.append([])
            parts[-1].append(block)
        name = name_of(page)
        for part in (p for p in parts if any(runs(b) for b in p)):
            place = f"{name}:{part[0].line}" if len(parts) > 1 else name
            slow = [b for b in part if runs(b) and is_slow(name, b)]
            quick = part[: part.index(slow[0])] if slow else part
            if any(runs(b) for b in quick):
                found.append(pytest.param(name, quick, id=place))
            begin = beginning(part)
            if any(runs(b) and b not in quick for b in begin):
                found.append(pytest.param(name, begin, id=f"{place}-begin", marks=pytest.mark.slow))
            if slow:
                whole = pytest.mark.exhaustive  # before a release
                found.append(pytest.param(name, part, id=f"{place}-whole", marks=whole))
    return found


def beginning(part: list[Block], count: int = 3) -> list[Block]:
    """The blocks of a part until so many were run, or until one takes minutes."""
    found: list[Block] = []
    for block in part:
        minutes = "minutes" in block.marks or any(x in block.text for x in sum(SLOW.values(), ()))
        if runs(block) and (minutes or sum(map(runs, found)) == count):
            break
        found.append(block)
    return found


def runs(block: Block) -> bool:
    """Whether a block is run at all."""
    return block.language in RUN and "not run" not in block.marks


def is_slow(name: str, block: Block) -> bool:
    """Whether a block takes too long for the default tests."""
    return (
        name.startswith(ALL_SLOW)
        or "minutes" in block.marks
        or any(x in block.text for x in SLOW.get(name, ()))
    )


@pytest.mark.parametrize(("page", "part"), chapters())
@pytest.mark.filterwarnings("ignore:Brax System:UserWarning")
def test_the_snippets_run(page, part, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    names: dict[str, Any] = {"__name__": "page"}
    needs = [x for b in part for x in b.marks.get("needs", "").split()]
    # Other packages are imported, and written, in single precision.
    single = needs or any("single precision" in b.marks for b in part)
    precision = jax.enable_x64(False) if single else contextlib.nullcontext()
    with precision, warnings.catch_warnings():
        for package in needs:
            warnings.simplefilter("ignore", DeprecationWarning)
            pytest.importorskip(package)
        printed = None
        for block in part:
            where = f"{page}, line {block.line}"
            if runs(block):
                printed = run(block, names, tmp_path, where)
            elif block.language == "" and printed is not None:
                compare(block.text, printed, block, where)
                printed = None


def run(block: Block, names: dict[str, Any], folder: Path, where: str) -> str:
    """Runs a block; what it prints."""
    hide(block.marks.get("before", ""), names, where)
    if block.language == "pycon":
        test = doctest.DocTestParser().get_doctest(block.text, names, where, where, block.line)
        test.globs = names
        told = io.StringIO()
        with contextlib.redirect_stdout(io.StringIO()):
            failed = doctest.DocTestRunner().run(test, out=told.write, clear_globs=False).failed
        assert not failed, told.getvalue()
        printed = ""
    elif block.language == "console":
        printed = ""
        for command in re.split(r"^\$ ", block.text, flags=re.MULTILINE)[1:]:
            line, promised = command.split("\n", 1)
            output = called(shlex.split(line)[1:], where, may_fail=True)
            assert output.strip() == promised.strip(), f"{where}: {line}"
    elif block.language == "sh":
        printed = shell(block.text, folder, where)
    else:
        printed = execute(block.text, names, where)
        kept_promises(block, printed, where)
    hide(block.marks.get("after", ""), names, where)
    return printed


def hide(code: str, names: dict[str, Any], where: str) -> None:
    """Runs what a page does not show."""
    execute(code, names, f"{where}, before or after it")


def execute(code: str, names: dict[str, Any], where: str) -> str:
    """Runs Python; what it prints."""
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        exec(compile(code, where, "exec"), names)
    return printed.getvalue()


def shell(text: str, folder: Path, where: str) -> str:
    """Does what lines for a shell say, those of ours, here and now; what they print."""
    printed, lines = "", text.replace("\\\n", " ").split("\n")
    while lines:
        line = lines.pop(0).strip()
        if here := re.match(r"cat > (\S+) <<'(\w+)'$", line):
            end = lines.index(here[2])
            (folder / here[1]).write_text("".join(f"{x}\n" for x in lines[:end]))
            lines = lines[end + 1 :]
            continue
        for command in re.split(r" && ", line):
            words = shlex.split(command, comments=True)
            if not words or INSTALLED.match(command):
                continue
            assert words[0] == "jaxltl", f"{where}: {command!r} is not run here; mark the block"
            target = words[words.index(">") + 1] if ">" in words else None
            output = called(words[1 : words.index(">")] if target else words[1:], where)
            if target:
                (folder / target).write_text(output)
            else:
                printed += output
    return printed


def called(arguments: list[str], where: str, may_fail: bool = False) -> str:
    """What the command line prints, both streams where it may fail."""
    done = CliRunner().invoke(main, arguments, catch_exceptions=False)
    assert may_fail or done.exit_code == 0, f"{where}: {done.output}"
    return done.output if may_fail else done.stdout


def steady(text: str) -> str:
    """A text without the seconds that something took."""
    text = re.sub(r", read in [^\n]*|\b[0-9.]+ s, |^ *[0-9.]+ s\n", "", text, flags=re.MULTILINE)
    return text.strip()


def compare(promised: str, printed: str, block: Block, where: str) -> None:
    """Words are as they stand; numbers with decimals may differ in their last place."""
    within = float(block.marks.get("within") or 1e-6)
    told = difference(steady(promised), steady(printed), within)
    assert not told, f"{where}: {told}"


def kept_promises(block: Block, printed: str, where: str) -> None:
    """Comments behind prints that begin with a value are lines of what was printed, in order."""
    lines = printed.splitlines()
    for comment in re.findall(r"^[^#\n]*\bprint\(.*\)\s+# (.*)$", block.text, re.MULTILINE):
        if not PROMISE.match(comment):
            continue
        for i, line in enumerate(lines):
            words = comment.strip("'").split()[: len(line.split())]
            if words and words[-1] != line.split()[-1]:
                words[-1] = words[-1].rstrip(":;,'")
            within = float(block.marks.get("within") or 1e-6)
            if words and not difference(" ".join(words), " ".join(line.split()), within):
                lines = lines[i + 1 :]
                break
        else:
            raise AssertionError(f"{where}: nothing that was printed is {comment!r}:\n{printed}")


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_block_is_run_or_says_why_not(page):
    seen = ""
    for block in blocks(page.read_text()):
        where = f"{name_of(page)}, line {block.line}"
        assert set(block.marks) <= {*MARKS, ""} or block.language not in RUN, where
        if "not run" in block.marks or "minutes" in block.marks:
            assert block.marks.get("not run", block.marks.get("minutes")), f"{where}: why?"
        known = (*RUN, "", "text", "toml", "json", "{toctree}", "csv", "html", "bash", "c")
        assert block.language in known, f"{where}: {block.language!r}"
        if block.language == "":
            assert seen == block.section, f"{where}: the output of what? ```text is no output"
        if block.language in ("python", "sh"):
            seen = block.section
