"""A job of learning from a task file to a directory of results: shown, and gone on from.

A job is a module such as :mod:`jaxltl.app.learn`, with its `Outcome` and its functions by the same
names. Heavy modules are imported inside, so that the command's first line comes at once.
"""

from __future__ import annotations

import contextlib
import json
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np

    from jaxltl.app.drawing import Artist, Picture
    from jaxltl.app.processes import Place


def job_of(task_file: Path) -> Any:
    """The module that does what a task file asks for."""
    from jaxltl.app.files.task import method_of
    from jaxltl.app.files.task_environment import is_environment_task

    if is_environment_task(task_file):
        from jaxltl.app import learn_environment

        return learn_environment
    if method_of(task_file) == "todirl":
        from jaxltl.app import learn_todirl

        return learn_todirl
    from jaxltl.app import learn

    return learn


def finished(out: Path, mark: str) -> dict[str, Any] | None:
    """The result of the same task and options, if a directory has it."""
    try:
        result = json.loads((out / "result.json").read_text())
    except (OSError, ValueError):
        return None
    same = isinstance(result, dict) and result.get("fingerprint") == mark
    return result if same and (out / "report.html").exists() else None


def make_directory(out: Path) -> Path:
    """A directory for results, made if it is not there.

    Raises:
      ValueError: it cannot be made.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(
            f"cannot write into {str(out)!r}: {error.strerror}; choose another with --out."
        ) from None
    return out


def run_job(
    job: Any,
    task: Any,
    out: Path,
    seeds: tuple[int, int],
    mark: str,
    begin: Artist,
    say: Callable[[str], None],
    place: Place,
) -> dict[str, Any] | None:
    """Does the whole job, shows how far it is, and returns what ``result.json`` holds.

    In several processes the first alone draws and writes, and returns something.

    Args:
      job: of :func:`job_of`; `task` is what its ``read_task`` gives.
      out: the directory of results, in which an interrupted job leaves its checkpoint.
      seeds: the first, and how many.
      mark: the job's fingerprint, which a checkpoint must have to be gone on from.
      begin: begins to draw a picture.
      say: takes lines on how far it is.
      place: the devices and processes.
    """
    checkpoint = out / f"checkpoint-{mark}.npz"
    try:
        return _done(job, task, out, seeds, mark, begin, say, place, checkpoint)
    except KeyboardInterrupt:
        kept = "; the same command goes on from the last checkpoint"
        say(f"interrupted{kept if checkpoint.exists() else ''}")
        raise SystemExit(130) from None


def _done(
    job: Any,
    task: Any,
    out: Path,
    seeds: tuple[int, int],
    mark: str,
    begin: Artist,
    say: Callable[[str], None],
    place: Place,
    checkpoint: Path,
) -> dict[str, Any] | None:
    from jaxltl.algos.common import checkpoint as files

    start = time.perf_counter()
    setup = place.together(lambda: job.prepare(task, seeds[0]))
    say(job.describe(setup))
    if place.mesh is not None:
        say(spread(seeds[1], place))
    place.together(lambda: _claim(out, task, place))
    if place.sees(str(checkpoint), checkpoint.exists()):
        say(f"going on from {checkpoint}")
    place.sees(str(out), (out / "task.toml").exists())
    steps = task.learner.get("steps", job.STEPS)
    with _learning(steps, shown=place.is_first) as bar:
        pictures = [(p, begin(p.drawing)) for p in job.task_pictures(setup) if place.is_first]

        def report(step: int, figures: Mapping[str, np.ndarray]) -> None:
            bar.set_description_str("learning", refresh=False)
            bar.update(step - bar.n)
            bar.set_postfix(job.postfix(figures))

        parts = job.learn(
            setup,
            *seeds,
            report=report,
            checkpoint=checkpoint,
            progress=bar.set_description_str,
            mesh=place.mesh,
        )
        if not place.is_first:
            return None
        files.remove(checkpoint)
        outcome = job.Outcome(setup, *parts, seed=seeds[0], seconds=time.perf_counter() - start)
        bar.set_description_str("drawing")
        pictures += [(p, _begun(begin, p)) for p in job.pictures(outcome)]
        live = [(x, {k: begin(d) for k, d in x.drawings.items()}) for x in job.live(outcome)]
        return _write(job, outcome, out, mark, pictures, live)


def _claim(out: Path, task: Any, place: Place) -> None:
    """The directory of results; one that cannot be written to must be known before the work."""
    from jaxltl.algos.common.checkpoint import atomic_write

    if place.is_first:
        make_directory(out)
        with atomic_write(out / "task.toml") as file:
            file.write(task.path.read_bytes())


def spread(num_seeds: int, place: Place) -> str:
    """How seeds come to lie on several devices, and what that brings, in one line.

    Example:
      >>> from types import SimpleNamespace
      >>> spread(6, SimpleNamespace(num_devices=4))
      '6 seeds on 4 devices, at most 2 on each; 3 devices are enough for that'
    """
    number = place.num_devices
    if num_seeds == 1:
        return "one seed is learned on one device" + (
            "" if number == 1 else ", and the others bring nothing; --seeds N uses them"
        )
    most = -(-num_seeds // number)
    used = -(-num_seeds // most)
    enough = f"{used} devices are" if used > 1 else "one device is"
    idle = f"; {enough} enough for that" if used < number else ""
    many = "devices" if number > 1 else "device"
    return f"{num_seeds} seeds on {number} {many}, at most {most} on each{idle}"


def _begun(begin: Artist, picture: Picture) -> Callable[[], bytes]:
    """How to get a picture, which may be drawn already."""
    drawn: Any = picture.drawing
    return (lambda: drawn) if isinstance(drawn, bytes) else begin(drawn)


@contextlib.contextmanager
def _learning(total: int, *, shown: bool) -> Iterator[Any]:
    """A progress bar that moves each second, whatever the work is at."""
    from tqdm import tqdm

    done = threading.Event()
    with tqdm(total=total, unit="step", leave=False, desc="compiling", disable=not shown) as bar:

        def tick() -> None:
            while not done.wait(1):
                bar.refresh()

        clock = threading.Thread(target=tick, daemon=True)
        clock.start()
        try:
            yield bar
        finally:
            done.set()
            clock.join()


def _write(
    job: Any,
    outcome: Any,
    out: Path,
    mark: str,
    pictures: list[tuple[Picture, Callable[[], bytes]]],
    live: list[tuple[Any, dict[str, Callable[[], bytes]]]],
) -> dict[str, Any]:
    from jaxltl.algos.common.checkpoint import atomic_write

    result = {**job.summary(outcome), "fingerprint": mark}
    job.save(out, outcome)
    shown = []
    for picture, drawn in pictures:
        shown.append((picture, drawn()))
        with atomic_write(out / picture.name) as file:
            file.write(shown[-1][1])
    parts = [(x, {k: drawn().decode() for k, drawn in each.items()}) for x, each in live]
    page = report_of(result).page(result, parts, shown, (out / "task.toml").read_text())
    with atomic_write(out / "report.html") as file:
        file.write(page.encode())
    # Last, so that its presence says that all the rest is there.
    with atomic_write(out / "result.json") as file:
        file.write((json.dumps(result, indent=2, allow_nan=False) + "\n").encode())
    return result


def report_of(result: Mapping[str, Any]) -> Any:
    """The module that shows a result."""
    from jaxltl.app.files.task_environment import METHODS
    from jaxltl.app.reports import learn as report
    from jaxltl.app.reports import learn_environment as report_environment
    from jaxltl.app.reports import learn_todirl as report_todirl

    if result["method"] in METHODS:
        return report_environment
    return report_todirl if result["method"] == "todirl" else report
