"""Runs a learning job from its task file to a directory of results, with progress and resumption.

Heavy modules are imported inside functions, so that the command's first line comes at once.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import json
import os
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias, TypeVar, cast

from jaxltl.app.command_options import RunOptions
from jaxltl.app.compilation import float64
from jaxltl.app.wording import Record, Result, postfix

if TYPE_CHECKING:
    import numpy as np
    from tqdm import tqdm

    from jaxltl.algos.common.seeds import Training
    from jaxltl.app.files.task import FormulaFile
    from jaxltl.app.processes import ProcessGroup
    from jaxltl.plot.drawing import Artist, Drawing, Picture
    from jaxltl.app.reports.page import Report, Section

_LINE_SECONDS = 10.0  # between lines of progress in a pipe
_JOBS = {  # the module of each kind of job, and that of its task file
    "environment": ("learn_environment", "task_rl", "EnvironmentFile"),
    "grounding": ("learn_grounding", "task_irl", "GroundingFile"),
    "controller": ("learn_controller", "task_rl", "ControllerFile"),
    "todirl": ("learn_todirl", "task_irl", "TodirlFile"),
    "mlirl": ("learn", "task_irl", "MlirlFile"),
}

Drawn = Callable[[], bytes]  # waits for a picture
Begun: TypeAlias = "tuple[Section, dict[str, Drawn]]"  # with its drawings by name
T = TypeVar("T", bound="FormulaFile")
S = TypeVar("S")
O = TypeVar("O")  # noqa: E741


class Job(Protocol[T, S, O]):
    """A kind of learning job, with its task, setup and outcome; implemented by modules."""

    @property
    def DOUBLE(self) -> bool: ...  # True if figures are computed in double precision
    @property
    def FILE(self) -> type[T]: ...  # the schema of task files
    @property
    def report(self) -> Report: ...
    def prepare(self, task: T, seed: int) -> S: ...  # the objects that a task file describes
    def describe(self, setup: S) -> str: ...  # sizes of a setup, in one line
    def learn(self, setup: S, training: Training) -> O: ...  # with several seeds, keeping one
    def summary(self, outcome: O) -> Record: ...  # the contents of ``result.json``
    def save(self, out: Path, outcome: O) -> None: ...  # writes the policy into a directory
    def task_pictures(self, setup: S) -> list[Picture]: ...  # those that need no outcome
    def sections(self, outcome: O) -> list[Section]: ...  # of the report


SomeJob: TypeAlias = Job[Any, Any, Any]  # of a kind that a task file decides


@dataclass(frozen=True)
class Finished:
    """The result of a job."""

    out: Path
    result: Result  # contents of result.json
    table: str  # its text for the terminal
    before: bool  # whether an earlier run wrote it


@dataclass(frozen=True)
class Console:
    """Output of a job: drawing, progress reports, and the processes of the run."""

    artist: Artist
    say: Callable[[str], None]
    group: ProcessGroup


def job_of(task_file: Path) -> SomeJob:
    """The kind of job that a task file describes; mistakes in its keys come before slow imports."""
    from jaxltl.app.files.task import kind_of

    job, module, file = _JOBS[kind_of(task_file)]
    getattr(importlib.import_module(f"jaxltl.app.files.{module}"), file).read(task_file)
    return cast("SomeJob", importlib.import_module(f"jaxltl.app.{job}"))


def _precision(job: SomeJob) -> contextlib.AbstractContextManager[None]:
    """Double precision for solvers; simulators are written for single precision."""
    return float64() if job.DOUBLE else contextlib.nullcontext()


def check(task_file: Path) -> str:
    """Sizes of the problem of a task file, whose parts are all read and checked."""
    job = job_of(task_file)
    with _precision(job):
        return job.describe(job.prepare(job.FILE.read(task_file), seed=0))


def learn(task_file: Path, options: RunOptions, console: Console) -> Finished | None:
    """Runs the job of a task file unless it is finished; None in all processes but the first."""
    group = console.group
    with group.together():
        job = job_of(task_file)
    from jaxltl.app.wording import fingerprint

    with group.together():
        task = job.FILE.read(task_file)
    out = directory(options.out, task.name)
    with _precision(job):
        mark = fingerprint(task.digest, options.seed, options.num_seeds)
        group.agree(
            {
                "--out": out,
                "--seed": options.seed,
                "--seeds": options.num_seeds,
                "--again": options.again,
                "the task or versions": mark,
            }
        )
        result = None if options.again else _finished(out, mark)
        before = group.sees(f"{out}/result.json", result is not None)
        result = result or _run(job, task, options, console, out / f"checkpoint-{mark}.npz", mark)
    if not group.is_first or result is None:
        return None
    return Finished(out, result, job.report.table(result, out), before)


def directory(out: Path | None, name: str) -> Path:
    """The directory of results, by default one of a name in `out`."""
    return out or Path("out") / name.replace(" ", "_")


def _finished(out: Path, mark: str) -> Result | None:
    """The result in a directory, if it has the job's fingerprint."""
    try:
        result = json.loads((out / "result.json").read_text())
    except (OSError, ValueError):
        return None
    same = isinstance(result, dict) and result.get("fingerprint") == mark
    return result if same and (out / "report.html").exists() else None


def make_directory(out: Path) -> Path:
    """The directory of the results, created if it does not exist."""
    with _writable(out):
        out.mkdir(parents=True, exist_ok=True)
    return out


@contextlib.contextmanager
def _writable(out: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise ValueError(
            f"cannot write into {str(out)!r}: {error.strerror}; choose another with --out."
        ) from None


@contextlib.contextmanager
def claimed(out: Path, name: str, content: bytes, again: bool) -> Iterator[None]:
    """Keeps a directory of results, with a copy of the file that they are of, for one process.

    The lock is released also if the process is killed.

    Raises:
      ValueError: it cannot be written to, another process writes into it, or it has a result of
        another file and `again` is False.
    """
    copy, path = make_directory(out) / name, out / ".lock"
    with ExitStack() as held:
        with contextlib.suppress(ImportError):  # not a POSIX system
            import fcntl

            with _writable(out):
                file = held.enter_context(path.open("w"))
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                mine = path.stat().st_ino == os.fstat(file.fileno()).st_ino
            except (BlockingIOError, FileNotFoundError):  # locked, or removed by the process before
                mine = False
            if not mine:
                raise ValueError(
                    f"another run writes into {str(out)!r}; wait for its end, or choose another "
                    "directory with --out."
                )
            held.callback(path.unlink, missing_ok=True)
        done = (out / "result.json").exists()
        if done and not again and not (copy.exists() and copy.read_bytes() == content):
            raise ValueError(
                f"{str(out)!r} has the result of another file, or of this one before it was "
                "changed; choose another directory with --out, or overwrite it with --again."
            )
        write_files(out, [(name, content)])
        yield


def _run(
    job: Job[T, S, O], task: T, options: RunOptions, console: Console, checkpoint: Path, mark: str
) -> Result | None:
    """Runs a job, and returns ``result.json``; None in all processes but the first."""
    from jaxltl.algos.common import checkpoint as files
    from jaxltl.algos.common.seeds import Training
    from jaxltl.app.wording import took
    from jaxltl.io.certificate.results import write_certificates

    start, out = time.perf_counter(), checkpoint.parent
    group, say = console.group, console.say
    try:
        with ExitStack() as held:
            with group.together():
                setup = job.prepare(task, options.seed)
            say(job.describe(setup))
            if group.mesh is not None:
                say(seed_distribution(options.num_seeds, group.num_devices))
            # Before the work, since the directory may not be writable.
            with group.together():
                if group.is_first:
                    held.enter_context(
                        claimed(out, "task.toml", task.path.read_bytes(), options.again)
                    )
            if group.sees(str(checkpoint), checkpoint.exists()):
                say(f"going on from {checkpoint}")
            group.sees(str(out), (out / "task.toml").exists())
            bar = held.enter_context(progress_bar(task.learner.steps, visible=group.is_first))
            begun = begin_drawing(
                job.task_pictures(setup) if group.is_first else [], console.artist
            )

            def report(step: int, metrics: Mapping[str, np.ndarray]) -> None:
                bar.set_description_str("learning", refresh=False)
                bar.update(step - bar.n)
                bar.set_postfix(postfix(metrics))

            training = Training(
                options.seed,
                options.num_seeds,
                report=report,
                stage=bar.set_description_str,
                checkpoint=checkpoint,
                mesh=group.mesh,
            )
            outcome = job.learn(setup, training)
            if not group.is_first:
                return None
            files.remove(checkpoint)
            seconds = time.perf_counter() - start
            bar.set_description_str("drawing")
            begun += begin_drawing(job.sections(outcome), console.artist)
            result = {**job.summary(outcome), **took(seconds), "fingerprint": mark}
            job.save(out, outcome)
            # Of jobs whose result is a policy of a finite model.
            certifiable = getattr(job, "certifiable", lambda outcome: "the result is a network")
            result["certificates"] = write_certificates(out, certifiable(outcome))
            write_results(out / "task.toml", job.report, result, begun)
            return result
    except KeyboardInterrupt:
        hint = "; the same command goes on from the last checkpoint"
        say(f"interrupted{hint if checkpoint.exists() else ''}")
        raise SystemExit(130) from None


def begin_drawing(sections: Iterable[Section], artist: Artist) -> list[Begun]:
    """Begins the drawings of sections; those of pictures may be drawn already."""
    from jaxltl.plot.drawing import Picture

    def begin(drawing: Drawing | bytes) -> Drawn:
        return (lambda: drawing) if isinstance(drawing, bytes) else artist(drawing)

    begun: list[Begun] = []
    for x in sections:
        drawings = {"": x.drawing or b""} if isinstance(x, Picture) else x.drawings
        begun.append((x, {key: begin(each) for key, each in drawings.items()}))
    return begun


def write_results(file: Path, report: Report, result: Result, begun: Iterable[Begun]) -> None:
    """Writes pictures, report and result beside the copy of the task or game file."""
    from jaxltl.plot.drawing import Picture

    drawn = [(x, {key: wait() for key, wait in each.items()}) for x, each in begun]
    pictures = [(x, svg[""]) for x, svg in drawn if isinstance(x, Picture)]
    parts = [
        (x, {key: each.decode() for key, each in svg.items()})
        for x, svg in drawn
        if not isinstance(x, Picture)
    ]
    page = report.page(result, parts, pictures, file.read_text())
    content = json.dumps(result, indent=2, allow_nan=False) + "\n"
    write_files(
        file.parent,
        [
            *((picture.name, svg) for picture, svg in pictures),
            ("report.html", page.encode()),
            # Last, so that its presence implies that all other files are complete.
            ("result.json", content.encode()),
        ],
    )


def write_files(out: Path, files: Iterable[tuple[str, bytes]]) -> None:
    """Writes files by name into a directory, in order and each atomically."""
    from jaxltl.core.files import atomic_write

    for name, content in files:
        with atomic_write(out / name) as file:
            file.write(content)


def seed_distribution(num_seeds: int, num_devices: int) -> str:
    """Distribution of seeds over devices, in one line.

    Example:
      >>> seed_distribution(6, 4)
      '6 seeds on 4 devices, at most 2 on each; 3 devices are enough for that'
    """
    if num_seeds == 1:
        return "one seed is learned on one device" + (
            "" if num_devices == 1 else ", and the others are idle; --seeds N uses them"
        )
    seeds_per_device = -(-num_seeds // num_devices)
    used = -(-num_seeds // seeds_per_device)
    enough = f"{used} devices are" if used > 1 else "one device is"
    idle = f"; {enough} enough for that" if used < num_devices else ""
    noun = "devices" if num_devices > 1 else "device"
    return f"{num_seeds} seeds on {num_devices} {noun}, at most {seeds_per_device} on each{idle}"


@contextlib.contextmanager
def progress_bar(total: int, *, visible: bool) -> Iterator[tqdm[Any]]:
    """A progress bar that refreshes its clock each second, also while the work blocks.

    Where standard error is no terminal, each stage has a line, and another one each ten seconds.
    """
    from tqdm import tqdm

    class Lines(tqdm):
        stage, since = "", 0.0

        def display(self, msg: str | None = None, pos: int | None = None) -> None:
            now, stage = time.monotonic(), self.desc.removesuffix(": ")
            if msg != "" and (stage != self.stage or now - self.since >= _LINE_SECONDS):
                self.stage, self.since = stage, now
                steps = f", {self.n} of {self.total} steps" if self.n else ""
                figures = f", {self.postfix}" if self.postfix else ""
                elapsed = f", {self.format_dict['elapsed']:.0f} s"
                print(f"{stage}{steps}{figures}{elapsed}", file=sys.stderr, flush=True)

    terminal, done = sys.stderr.isatty(), threading.Event()
    file = None if terminal else io.StringIO()
    with (tqdm if terminal else Lines)(
        total=total, unit="step", desc="compiling", disable=not visible, leave=False, file=file
    ) as bar:

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
