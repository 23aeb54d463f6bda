"""Makes the pictures of pages by running the code that these pages show.

    python docs/pictures/make.py docs/gallery.md docs/guides/mlirl.md

runs the Python blocks of each page as its test does, those that are marked as alone in a namespace
of their own, each in an empty folder, and keeps the pictures that the page refers to next to this
file. It prints the seconds and the output of each block, says which output the page does not show
as it is, and ends with status 1 then. With `--check` nothing is written.
"""

import contextlib
import io
import os
import pathlib
import re
import shutil
import sys
import tempfile
import time

import matplotlib

HERE = pathlib.Path(__file__).parent
BLOCK = re.compile(
    r"(<!-- alone -->\n)?```python\n(.*?)```(?:\n\n(?:<!--.*?-->\n)?```\n(.*?)```)?", re.DOTALL
)


def run(page: pathlib.Path, keep: bool) -> bool:
    """True if each block prints the output under it."""
    text, same = page.read_text(), True
    wanted = set(re.findall(r"pictures/([\w.-]+)", text))
    names: dict = {}
    for number, (alone, code, shown) in enumerate(BLOCK.findall(text), 1):
        names = {"__name__": "page"} if alone else names
        with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
            printed, begin = io.StringIO(), time.process_time()
            with contextlib.redirect_stdout(printed):
                exec(compile(code, f"{page.name}, block {number}", "exec"), names)
            seconds = time.process_time() - begin
            made = sorted(wanted.intersection(os.listdir()))
            sizes = [f"{name} ({os.path.getsize(name) / 1000:.0f} kB)" for name in made]
            for name in made if keep else ():
                shutil.copyfile(name, HERE / name)
        print(f"{page.name} {number}: {seconds:.1f} s of processor time; {', '.join(sizes)}")
        if printed.getvalue() != shown:
            same = False
            print(f"the page shows\n{shown}but it printed\n{printed.getvalue()}")
    return same


if __name__ == "__main__":
    # The same picture gives the same bytes.
    matplotlib.rcParams["svg.hashsalt"] = "jaxltl"
    os.environ["SOURCE_DATE_EPOCH"] = "0"
    pages = [pathlib.Path(x).resolve() for x in sys.argv[1:] if x != "--check"]
    results = [run(page, keep="--check" not in sys.argv) for page in pages]
    sys.exit(not all(results))
