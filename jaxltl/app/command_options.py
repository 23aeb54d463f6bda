# ruff: noqa: RUF009 - options are fields
"""Options of commands, as fields of data classes, and decorators for errors and compilation."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import click

import jaxltl
from jaxltl.app import compilation
from jaxltl.app.wording import Record

if TYPE_CHECKING:
    from jaxltl.core.statistics.confidence_sets import Method
    from jaxltl.io.certificate.results import Certifiable

PATH = click.Path(path_type=Path)
WAIT = 60.0  # seconds
_CERTIFICATE = "File for a certificate, which `jaxltl verify` checks; several are numbered."


class Failure(click.ClickException):
    """An error of usage, reported in one line."""

    exit_code = 2

    def show(self, file: IO[str] | None = None) -> None:
        click.echo(f"error: {self.message}", err=True)


def plain_errors(command: Callable[..., None]) -> Callable[..., None]:
    """Reports expected errors without a traceback; others are bugs, and keep it."""

    @functools.wraps(command)
    def run(*args: object, **options: object) -> None:
        try:
            command(*args, **options)
        except (ValueError, RuntimeError) as error:
            if "KeyboardInterrupt" in str(error):  # in a call of the host by a program of XLA
                raise _interrupted() from None
            # The second class imports JAX, which takes longer than to find a mistake in a file.
            if not isinstance(error, ValueError) and not isinstance(error, jaxltl.NotConverged):
                raise
            raise Failure(str(error)) from None
        except OSError as error:
            where = f"{error.filename!r}: " if error.filename else ""
            raise Failure(f"{where}{error.strerror or error}") from None
        except KeyboardInterrupt:
            raise _interrupted() from None

    return run


def _interrupted() -> SystemExit:
    click.echo("interrupted", err=True)
    return SystemExit(130)


def compiling(*, fast: bool) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Adds the option --no-cache to a command that compiles; `fast` is for short programs."""

    def wrap(command: Callable[..., None]) -> Callable[..., None]:
        @click.option(
            "--no-cache",
            is_flag=True,
            help="Neither read nor write the cache of compiled programs.",
        )
        @functools.wraps(command)
        def run(*args: object, no_cache: bool, **options: object) -> None:
            compilation.use_cache(not no_cache)
            if fast:
                compilation.compile_fast()
                compilation.use_one_thread()
            command(*args, **options)

        return run

    return wrap


class Devices(click.ParamType):
    """A number of devices; 0 for all of them."""

    name = "N"

    def convert(
        self, value: str | int, param: click.Parameter | None, ctx: click.Context | None
    ) -> int:
        if isinstance(value, int):
            return value
        if value == "all":
            return 0
        if value.isascii() and value.isdigit() and 0 < int(value) < 2**31:
            return int(value)
        raise Failure(
            f"--mesh {value}: give a number of devices, or all; other arguments come before --mesh."
        )


def write_proofs(path: Path, answers: Sequence[Certifiable]) -> list[Record]:
    """Writes certificates of the option --certificate, and prints what they prove."""
    from jaxltl.io.certificate.results import certificate_lines, write_certificates

    records = write_certificates(path.parent, answers, path.name)
    click.echo("\n".join(certificate_lines(records, path.parent)))
    return records


# --- the options of commands ----------------------------------------------------------------------


def option(text: str = "", name: str = "", **settings: Any) -> Any:
    """A field with its option: help, name if it is another one, and settings of ``click.option``."""
    blank = () if settings.get("multiple") else False if settings.get("is_flag") else None
    default = settings.get("default", blank)
    return field(default=default, metadata={"option": (text, name, settings)})


def options(kind: type, argument: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Adds the options of a data class to a command, which takes them as one argument."""

    def wrap(command: Callable[..., None]) -> Callable[..., None]:
        @functools.wraps(command)
        def run(*args: object, **values: Any) -> None:
            own = {x.name: values.pop(x.name) for x in fields(kind)}
            command(*args, **{argument: kind(**own)}, **values)

        for one in reversed(fields(kind)):
            text, name, settings = one.metadata["option"]
            settings = {
                "show_default": "default" in settings,
                "is_flag": one.type == "bool",
            } | settings
            if str(one.type).startswith("Path"):
                settings.setdefault("type", PATH)
            name = name or f"--{one.name.replace('_', '-')}"
            run = click.option(name, one.name, help=text or None, **settings)(run)
        return run

    return wrap


@dataclass(frozen=True)
class DeviceOptions:
    """Options of devices and processes."""

    mesh: int | None = option(  # 0 for all of them; None for no mesh
        "Number of devices, or all. With srun or mpirun, those of all processes.",
        is_flag=False,
        flag_value="all",
        type=Devices(),
    )
    coordinator: str | None = option(
        "Address of process 0, without such a launcher.", metavar="HOST:PORT"
    )
    process: int | None = option("Number of this process.", type=click.IntRange(0), metavar="I")
    processes: int | None = option("Number of processes.", type=click.IntRange(1), metavar="N")
    wait: float = option(
        "Time after which a silent process is reported, at the start and later.",
        default=WAIT,
        metavar="SECONDS",
        type=click.FloatRange(1, 86400),
    )


@dataclass(frozen=True)
class RunOptions:
    """Options of a run of a job."""

    out: Path | None = option("Directory for the results.  [default: out/NAME]")
    seed: int = option(default=0, type=click.IntRange(0, 2**31 - 1))
    num_seeds: int = option(
        "Number of seeds, which learn in parallel; the best is kept.",
        "--seeds",
        default=1,
        type=click.IntRange(1),
    )
    again: bool = option(
        "Repeat a finished run, or overwrite the result of another task.", is_flag=True
    )


@dataclass(frozen=True)
class SolveOptions:
    """Options of model checking."""

    strategy: Path | None = option("File of optimal strategies, as JSON.", metavar="FILE")
    tolerance: float = option(
        "Width of the bounds: absolute for probabilities, else relative.",
        default=1e-6,
        type=click.FloatRange(0, 1, min_open=True),
    )
    relative: bool = option("Width relative to the value in any case.", is_flag=True)
    exact: bool = option("Values as fractions, of models of moderate size.", is_flag=True)
    fair: bool = option("Probabilities over the fair strategies of an MDP.", is_flag=True)
    as_json: bool = option("End with the result as one JSON line.", "--json", is_flag=True)
    const: str | None = option("Constants of a program.", metavar="N=64,MAX=4")
    max_states: int | None = option("Most states of a program.", type=click.IntRange(1))
    method: str = option(
        "Of a program: build the model, or explore some states until the bounds are narrow.",
        default="build",
        type=click.Choice(["build", "partial"]),
    )
    certificate: Path | None = option(_CERTIFICATE, metavar="FILE")
    checkpoint: Path | None = option(
        "With --mesh: directory of checkpoints, from which long solves resume.",
        metavar="DIRECTORY",
    )

    def check(self, mesh: object) -> None:
        """Raises ValueError for an option that goes without `mesh`, or with it alone."""
        for name in ("strategy", "relative", "certificate", "exact", "fair", "checkpoint"):
            with_mesh = name == "checkpoint"
            if getattr(self, name) and (mesh is not None) != with_mesh:
                raise ValueError(
                    f"--{name} goes {'with' if with_mesh else 'without'} --mesh alone."
                )


@dataclass(frozen=True)
class CertifyOptions:
    """Options of the guarantee of a log."""

    confidence: float | None = option("In (0, 1), such as 0.95; required for a log.", type=float)
    initial: tuple[str, ...] = option("Initial state.", multiple=True, metavar="STATE")
    terminal: tuple[str, ...] = option("State where episodes end.", multiple=True, metavar="STATE")
    labels: Path | None = option("Table of states and labels.")
    model: Path | None = option("Model file with the transition graph.")
    graph: str | None = option(
        "Assumption on possible transitions: those in the log, or all (the default).",
        type=click.Choice(["seen", "complete"]),
    )
    least_probability: float | None = option(
        "Least chance of a transition.", type=float, metavar="P"
    )
    method: Method = option(
        default="anytime",
        type=click.Choice(["anytime", "clopper-pearson", "hoeffding", "weissman"]),
    )
    smallest: bool = option("Minimise the probability.", "--min", is_flag=True)
    policy: Path | None = option("File for the policy, .npz.")
    curve: Path | None = option("Draw the bound over the number of samples (.svg, .png or .pdf).")
    certificate: Path | None = option(_CERTIFICATE, metavar="FILE")
