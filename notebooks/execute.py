"""Executes the notebooks and saves their outputs, or compares new outputs with the saved ones.

    python -m notebooks.execute [NAME ...]           execute and save
    python -m notebooks.execute --check [NAME ...]   execute and compare with the saved outputs

A NAME is a prefix of a file name, such as 03. Saved outputs are small and reproducible: pictures
with alternative texts, and text without times or widgets. The picture of the cell with the tag
``opening`` is also saved as a file in ``pictures`` and shown under the notebook's title.
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
MAX_BYTES = 500_000  # of a notebook with its outputs
_NUMBER = re.compile(
    r"(?<![\w.])[-+]?(?:\d{1,3}(?:,\d{3})+(?!\d)|\d+)?(?:(?<=\d)\.?|\.(?=\d))\d*(?:e[-+]?\d+)?\b"
)
_NOT_REPRODUCIBLE = {
    "an absolute path": r"(?<![\w.:])/(?:home|root|tmp|usr|var|work|Users|opt)/",
    "a memory address": r"\b0x[0-9a-f]{6,}",
    "a duration": r"\b\d[\d.]* ?(?:[mµ]?s|sec|seconds)\b",
    "a progress bar": r"[█▏▎▍▌▋▊▉]|\r|\d+%\|",
}


def paths(names: list[str]) -> list[Path]:
    """Paths of the notebooks with one of these name prefixes; all if `names` is empty."""
    return [
        path
        for path in sorted(HERE.glob("*.ipynb"))
        if not names or path.stem.startswith(tuple(names))
    ]


def packages(notebook: NotebookNode) -> list[str]:
    """Names of the packages that a notebook imports."""
    names = re.findall(r"^\s*(?:import|from) (\w+)", _code(notebook), re.MULTILINE)
    return sorted(set(names))


def execute(notebook: NotebookNode) -> NotebookNode:
    """A copy of the notebook with new outputs, in the form in which they are saved.

    It runs in an empty folder with the default XLA flags.
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
            cell.outputs = _reproducible(cell.outputs)
            _set_cell_alternative(cell)
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
    """Hash of the code cells, to detect outputs of other code."""
    return hashlib.sha256(_code(notebook).encode()).hexdigest()[:16]


def open_with_picture(notebook: NotebookNode, name: str) -> bytes:
    """Inserts the picture of the cell tagged ``opening`` under the title; returns its bytes.

    Raises:
      ValueError: if the number of pictures in tagged cells is not 1.
    """
    pictures = [
        output
        for cell in notebook.cells
        if "opening" in cell.metadata.get("tags", ())
        for output in cell.outputs
        if "image/png" in output.get("data", {})
    ]
    if len(pictures) != 1:
        raise ValueError(
            f'{name}: {len(pictures)} pictures in cells tagged "opening"; tag one cell with one picture.'
        )
    title, _, rest = notebook.cells[0].source.partition("\n\n")
    rest = re.sub(r"\A!\[[^\]]*\]\([^)]*\)\n\n", "", rest)
    alt = pictures[0].metadata["image/png"]["alt"]
    notebook.cells[0].source = f"{title}\n\n![{alt}](pictures/{name}.png)\n\n{rest}"
    return base64.b64decode(pictures[0].data["image/png"])


def faults(notebook: NotebookNode, name: str) -> list[str]:
    """Violations of the rules for saved notebooks, as messages."""
    messages = []
    if notebook.metadata.get("outputs_of") != sources(notebook):
        messages.append("the outputs are of other code; execute the notebook again")
    if len(nbformat.writes(notebook)) > MAX_BYTES:
        messages.append(f"the file has more than {MAX_BYTES:,} bytes")
    opening = rf"# .+\n\n!\[[^\]]{{20,}}\]\(pictures/{name}\.png\)\n"
    if not re.match(opening, notebook.cells[0].source):
        messages.append("no picture with an alternative text under the title")
    pictures, count = 0, 0
    for number, cell in enumerate(notebook.cells):
        if cell.cell_type != "code":
            continue
        count += 1
        if cell.execution_count != count:
            messages.append(f"cell {number} was not executed in order")
        for output in cell.outputs:
            messages += [f"cell {number}: {message}" for message in _faults_of(output)]
            pictures += bool(_pictures(output))
    if pictures < 3:
        messages.append("the notebook shows fewer than three pictures")
    return messages


def differences(saved: NotebookNode, fresh: NotebookNode) -> list[str]:
    """Differences of the texts of outputs, and of numbers beyond their tolerance, as messages.

    Numbers with decimals may differ by one in the last place. A cell whose numbers come from
    learning has a ``tolerance`` in its metadata: the largest absolute or relative difference from
    the saved number, whichever is larger.
    """
    messages = []
    for number, (before, now) in enumerate(zip(saved.cells, fresh.cells, strict=True)):
        if before.cell_type != "code":
            continue
        old, new = _texts(before.outputs), _texts(now.outputs)
        tolerance = float(before.metadata.get("tolerance", 0.0))
        if len(old) != len(new):
            messages.append(f"cell {number}: {len(old)} outputs are saved, {len(new)} are new")
        for a, b in zip(old, new, strict=False):
            if message := difference(a, b, tolerance):
                messages.append(f"cell {number}: {message}")
    return messages


def difference(old: str, new: str, tolerance: float) -> str:
    """Difference of a text from the saved one, as a message; empty if there is none."""
    if [re.sub(r"\s", "", x) for x in _NUMBER.split(old)] != [
        re.sub(r"\s", "", x) for x in _NUMBER.split(new)
    ]:
        return f"the saved text is {old.strip()!r}, the new one {new.strip()!r}"
    for a, b in zip(_NUMBER.findall(old), _NUMBER.findall(new), strict=True):
        x, y = (float(n.replace(",", "")) for n in (a, b))
        if abs(x - y) > 1.01 * max(_last_place(a), _last_place(b)) and (
            abs(x - y) > tolerance * max(1.0, abs(x))
        ):
            line = next((n for n in new.splitlines() if b in n), new).strip()
            return f"the saved number is {a}, the new one {b}, in {line!r}"
    return ""


def _code(notebook: NotebookNode) -> str:
    return "\n\n".join(cell.source for cell in notebook.cells if cell.cell_type == "code")


def _reproducible(outputs: list[NotebookNode]) -> list[NotebookNode]:
    """Outputs with adjacent streams joined and interactive pages replaced by their pictures."""
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
                    kind: _quantized(x) if kind == "image/png" else x
                    for kind, x in output.data.items()
                    if kind == "text/plain" or kind.startswith("image/")
                }
            )
        kept.append(output)
    return kept


def _quantized(png: str) -> str:
    """The picture in at most 256 colours, which takes a third of the bytes."""
    buffer = io.BytesIO()
    with Image.open(io.BytesIO(base64.b64decode(png))) as image:
        image.convert("RGB").quantize(256, dither=Image.Dither.NONE).save(
            buffer, format="png", optimize=True
        )
    return base64.b64encode(buffer.getvalue()).decode("ascii")


def _set_cell_alternative(cell: NotebookNode) -> None:
    """Copies a picture's alternative text to the cell's metadata, which MyST-NB reads."""
    pictures = [x for output in cell.outputs for x in _pictures(output)]
    cell.metadata.pop("mystnb", None)
    if pictures:
        image = {key: str(x) for key, x in pictures[0].items() if key in ("alt", "width")}
        cell.metadata["mystnb"] = {"image": image}


def _pictures(output: NotebookNode) -> list[dict]:
    """Metadata of each picture in an output, with its alternative text as ``alt``."""
    pictures = []
    for kind, content in output.get("data", {}).items():
        if kind == "image/svg+xml":
            title = re.search(r"<title[^>]*>([^<]+)</title>|aria-label=\"([^\"]+)\"", content)
            is_image = re.search(r"<svg[^>]*role=\"img\"", content)
            pictures.append({"alt": title[1] or title[2]} if title and is_image else {})
        elif kind.startswith("image/"):
            pictures.append(dict(output.metadata.get(kind, {})))
    return pictures


def _faults_of(output: NotebookNode) -> list[str]:
    if output.output_type == "error":
        return [f"{output.ename}: {output.evalue}"]
    if output.output_type == "stream" and output.name != "stdout":
        return [f"output on {output.name}: {output.text[:80]!r}"]
    messages = [
        "a picture without an alternative text" for x in _pictures(output) if not x.get("alt")
    ]
    data = output.get("data", {})
    if any(kind.startswith("application/") for kind in data) or (
        "text/html" in data and "<script" in data["text/html"]
    ):
        messages.append("an interactive output without a picture")
    text = "\n".join([*_texts([output]), str(data.get("text/html", ""))])
    messages += [
        f"{kind}: {match[0]!r}"
        for kind, pattern in _NOT_REPRODUCIBLE.items()
        if (match := re.search(pattern, text))
    ]
    return messages


def _texts(outputs: list[NotebookNode]) -> list[str]:
    return [
        output["text"] if output.output_type == "stream" else output.data.get("text/plain", "")
        for output in outputs
        if output.output_type != "error"
    ]


def _last_place(number: str) -> float:
    """Unit of the last decimal place of a number; 0 for an integer."""
    mantissa, _, exponent = number.lower().partition("e")
    decimals = len(mantissa.partition(".")[2])
    return 10.0 ** (int(exponent or 0) - decimals) if decimals or exponent else 0.0


def main() -> int:
    """Runs the command line; returns 1 if a notebook has a fault or a difference."""
    parser = argparse.ArgumentParser(
        description=__doc__,
        prog="python -m notebooks.execute",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("names", nargs="*", metavar="NAME")
    parser.add_argument(
        "--check", action="store_true", help="compare with the saved outputs, save nothing"
    )
    arguments = parser.parse_args()
    failed = False
    for path in paths(arguments.names):
        saved = nbformat.read(path, as_version=4)
        start, before = time.monotonic(), resource.getrusage(resource.RUSAGE_CHILDREN)
        fresh = execute(saved)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        print(f"{path.stem}: {cpu:.0f} s CPU, {time.monotonic() - start:.0f} s elapsed")
        if arguments.check:
            messages = differences(saved, fresh)
        else:
            picture = open_with_picture(fresh, path.stem)
            messages = faults(fresh, path.stem)
            (HERE / "pictures").mkdir(exist_ok=True)
            (HERE / "pictures" / f"{path.stem}.png").write_bytes(picture)
            nbformat.write(fresh, path)
        for message in messages:
            print("   ", message)
        failed = failed or bool(messages)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
