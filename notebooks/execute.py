"""Executes the notebooks and saves them with their outputs, or tells what has become of these.

    python -m notebooks.execute [NAME ...]           execute, and save
    python -m notebooks.execute --check [NAME ...]   execute, and compare with what is saved

A NAME is the beginning of a file's name, such as 03. What is saved is small and is the same from
one time to the next: pictures with their text alternatives, text, no times, no widgets. The picture
of the cell that is tagged ``opening`` is saved beside the notebook too, and opens it.
"""

import argparse
import base64
import copy
import hashlib
import io
import os
import re
import resource
import sys
import tempfile
import time
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from nbformat import NotebookNode
from PIL import Image

HERE = Path(__file__).parent
MOST_BYTES = 500_000  # of a notebook with its outputs
_NUMBER = re.compile(
    r"(?<![\w.])[-+]?(?:\d{1,3}(?:,\d{3})+(?!\d)|\d+)?(?:(?<=\d)\.?|\.(?=\d))\d*(?:e[-+]?\d+)?\b"
)
_UNWANTED = {
    "a path of one machine": r"(?<![\w.:])/(?:home|root|tmp|usr|var|work|Users|opt)/",
    "an address in memory": r"\b0x[0-9a-f]{6,}",
    "a time that was taken": r"\b\d[\d.]* ?(?:[mµ]?s|sec|seconds)\b",
    "a bar of progress": r"[█▏▎▍▌▋▊▉]|\r|\d+%\|",
}


def paths(names: list[str]) -> list[Path]:
    """The notebooks whose names begin with one of these; all, if there is none."""
    return [
        path
        for path in sorted(HERE.glob("*.ipynb"))
        if not names or path.stem.startswith(tuple(names))
    ]


def packages(notebook: NotebookNode) -> list[str]:
    """What a notebook imports."""
    found = re.findall(r"^\s*(?:import|from) (\w+)", _code(notebook), re.MULTILINE)
    return sorted(set(found))


def execute(notebook: NotebookNode) -> NotebookNode:
    """The notebook with the outputs that it has now, as they are saved.

    It runs in an empty folder, and its programs are compiled as users get them.
    """
    fresh = copy.deepcopy(notebook)
    with tempfile.TemporaryDirectory() as folder:
        NotebookClient(
            fresh,
            timeout=900,
            record_timing=False,
            store_widget_state=False,
            resources={"metadata": {"path": folder}},
        ).execute(env={**os.environ, "XLA_FLAGS": ""})
    for cell in fresh.cells:
        if cell.cell_type == "code":
            cell.outputs = _tidied(cell.outputs)
            _tell_the_cell(cell)
    fresh.metadata["kernelspec"] = {
        "display_name": "Python 3",
        "language": "python",
        "name": "python3",
    }
    fresh.metadata["language_info"] = {
        "file_extension": ".py",
        "mimetype": "text/x-python",
        "name": "python",
    }
    fresh.metadata["outputs_of"] = sources(fresh)
    return fresh


def sources(notebook: NotebookNode) -> str:
    """What says of which code the saved outputs are."""
    return hashlib.sha256(_code(notebook).encode()).hexdigest()[:16]


def open_with_picture(notebook: NotebookNode, name: str) -> bytes:
    """Puts the picture of the cell tagged ``opening`` under the title; returns the picture.

    Raises:
      ValueError: there is not one such cell with one picture.
    """
    found = [
        output
        for cell in notebook.cells
        if "opening" in cell.metadata.get("tags", ())
        for output in cell.outputs
        if "image/png" in output.get("data", {})
    ]
    if len(found) != 1:
        raise ValueError(
            f'{name}: {len(found)} pictures open it; tag one cell that shows one as "opening".'
        )
    title, _, rest = notebook.cells[0].source.partition("\n\n")
    rest = re.sub(r"\A!\[[^\]]*\]\([^)]*\)\n\n", "", rest)
    alt = found[0].metadata["image/png"]["alt"]
    notebook.cells[0].source = f"{title}\n\n![{alt}](pictures/{name}.png)\n\n{rest}"
    return base64.b64decode(found[0].data["image/png"])


def faults(notebook: NotebookNode, name: str) -> list[str]:
    """What a notebook must not be saved with, in words."""
    found = []
    if notebook.metadata.get("outputs_of") != sources(notebook):
        found.append("its outputs are of other code; execute it again")
    if len(nbformat.writes(notebook)) > MOST_BYTES:
        found.append(f"it has more than {MOST_BYTES:,} bytes")
    opening = rf"# .+\n\n!\[[^\]]{{20,}}\]\(pictures/{name}\.png\)\n"
    if not re.match(opening, notebook.cells[0].source):
        found.append("no picture with a text alternative under the title")
    pictures, count = 0, 0
    for number, cell in enumerate(notebook.cells):
        if cell.cell_type != "code":
            continue
        count += 1
        if cell.execution_count != count:
            found.append(f"cell {number} was not executed in order")
        for output in cell.outputs:
            found += [f"cell {number}: {told}" for told in _faults_of(output)]
            pictures += bool(_pictures(output))
    if pictures < 3:
        found.append("it shows fewer than three pictures")
    return found


def differences(saved: NotebookNode, fresh: NotebookNode) -> list[str]:
    """Where the texts of the outputs differ, and numbers by more than is allowed.

    Numbers with decimals may differ in their last place. A cell whose numbers come of learning has
    a ``tolerance`` in its metadata: how far each may be off, absolute or relative to what is saved,
    whichever is more.
    """
    found = []
    for number, (before, now) in enumerate(zip(saved.cells, fresh.cells, strict=True)):
        if before.cell_type != "code":
            continue
        old, new = _texts(before.outputs), _texts(now.outputs)
        tolerance = float(before.metadata.get("tolerance", 0.0))
        if len(old) != len(new):
            found.append(f"cell {number}: {len(old)} outputs were saved, there are {len(new)}")
        for a, b in zip(old, new, strict=False):
            if told := difference(a, b, tolerance):
                found.append(f"cell {number}: {told}")
    return found


def difference(old: str, new: str, tolerance: float) -> str:
    """How a text differs from one that was saved, in words; empty if it does not."""
    if [re.sub(r"\s", "", x) for x in _NUMBER.split(old)] != [
        re.sub(r"\s", "", x) for x in _NUMBER.split(new)
    ]:
        return f"it was {old.strip()!r} and is {new.strip()!r}"
    for a, b in zip(_NUMBER.findall(old), _NUMBER.findall(new), strict=True):
        x, y = (float(n.replace(",", "")) for n in (a, b))
        if abs(x - y) > 1.01 * max(_last_place(a), _last_place(b)) and (
            abs(x - y) > tolerance * max(1.0, abs(x))
        ):
            line = next((n for n in new.splitlines() if b in n), new).strip()
            return f"{a} was saved, it is {b}, in {line!r}"
    return ""


def _code(notebook: NotebookNode) -> str:
    return "\n\n".join(cell.source for cell in notebook.cells if cell.cell_type == "code")


def _tidied(outputs: list[NotebookNode]) -> list[NotebookNode]:
    """Streams as one text each, whenever they were flushed; what moves as its picture."""
    kept: list[NotebookNode] = []
    for output in outputs:
        if (
            kept
            and output.output_type == kept[-1].output_type == "stream"
            and (output.name == kept[-1].name)
        ):
            kept[-1].text += output.text
            continue
        if _pictures(output):
            output.data = NotebookNode(
                {
                    kind: _smaller(x) if kind == "image/png" else x
                    for kind, x in output.data.items()
                    if kind == "text/plain" or kind.startswith("image/")
                }
            )
        kept.append(output)
    return kept


def _smaller(png: str) -> str:
    """The picture in at most 256 colours: a third of the bytes."""
    buffer = io.BytesIO()
    with Image.open(io.BytesIO(base64.b64decode(png))) as image:
        image.convert("RGB").quantize(256, dither=Image.Dither.NONE).save(
            buffer, format="png", optimize=True
        )
    return base64.b64encode(buffer.getvalue()).decode("ascii")


def _tell_the_cell(cell: NotebookNode) -> None:
    """Repeats a picture's text where MyST-NB looks for it, at the cell."""
    found = [x for output in cell.outputs for x in _pictures(output)]
    cell.metadata.pop("mystnb", None)
    if found:
        image = {key: str(x) for key, x in found[0].items() if key in ("alt", "width")}
        cell.metadata["mystnb"] = {"image": image}


def _pictures(output: NotebookNode) -> list[dict]:
    """What is told of each picture in an output."""
    told = []
    for kind, content in output.get("data", {}).items():
        if kind == "image/svg+xml":
            title = re.search(r"<title[^>]*>([^<]+)</title>|aria-label=\"([^\"]+)\"", content)
            is_image = re.search(r"<svg[^>]*role=\"img\"", content)
            told.append({"alt": title[1] or title[2]} if title and is_image else {})
        elif kind.startswith("image/"):
            told.append(dict(output.metadata.get(kind, {})))
    return told


def _faults_of(output: NotebookNode) -> list[str]:
    if output.output_type == "error":
        return [f"{output.ename}: {output.evalue}"]
    if output.output_type == "stream" and output.name != "stdout":
        return [f"it wrote to {output.name}: {output.text[:80]!r}"]
    found = ["a picture without a text alternative" for x in _pictures(output) if not x.get("alt")]
    data = output.get("data", {})
    if any(kind.startswith("application/") for kind in data) or (
        "text/html" in data and "<script" in data["text/html"]
    ):
        found.append("it moves, and no picture stands in its place")
    text = "\n".join([*_texts([output]), str(data.get("text/html", ""))])
    found += [
        f"{what}: {match[0]!r}"
        for what, pattern in _UNWANTED.items()
        if (match := re.search(pattern, text))
    ]
    return found


def _texts(outputs: list[NotebookNode]) -> list[str]:
    return [
        output["text"] if output.output_type == "stream" else output.data.get("text/plain", "")
        for output in outputs
        if output.output_type != "error"
    ]


def _last_place(number: str) -> float:
    """What one more in the last place adds; nothing to a whole number."""
    mantissa, _, exponent = number.lower().partition("e")
    decimals = len(mantissa.partition(".")[2])
    return 10.0 ** (int(exponent or 0) - decimals) if decimals or exponent else 0.0


def main() -> int:
    """Executes what the command line names."""
    parser = argparse.ArgumentParser(
        description=__doc__,
        prog="python -m notebooks.execute",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("names", nargs="*", metavar="NAME")
    parser.add_argument("--check", action="store_true", help="save nothing, compare")
    arguments = parser.parse_args()
    failed = False
    for path in paths(arguments.names):
        saved = nbformat.read(path, as_version=4)
        began, spent = time.monotonic(), resource.getrusage(resource.RUSAGE_CHILDREN)
        fresh = execute(saved)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        cpu = after.ru_utime + after.ru_stime - spent.ru_utime - spent.ru_stime
        print(f"{path.stem}: {cpu:.0f} s of the processor, {time.monotonic() - began:.0f} s")
        if arguments.check:
            told = differences(saved, fresh)
        else:
            picture = open_with_picture(fresh, path.stem)
            told = faults(fresh, path.stem)
            (HERE / "pictures").mkdir(exist_ok=True)
            (HERE / "pictures" / f"{path.stem}.png").write_bytes(picture)
            nbformat.write(fresh, path)
        for line in told:
            print("   ", line)
        failed = failed or bool(told)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
