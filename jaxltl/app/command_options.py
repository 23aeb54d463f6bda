"""Decorators and options that commands share: errors, precision, compilation, devices."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import fields
from typing import IO, Any

import click

import jaxltl
from jaxltl.app import compilation, processes


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


def over_devices(command: Callable[..., None]) -> Callable[..., None]:
    """Adds the options of devices and processes to a command, as one argument."""

    @click.option(
        "--mesh",
        is_flag=False,
        flag_value="all",
        type=Devices(),
        help="Number of devices, or all. With srun or mpirun, those of all processes.",
    )
    @click.option(
        "--coordinator", metavar="HOST:PORT", help="Address of process 0, without such a launcher."
    )
    @click.option("--process", type=click.IntRange(0), metavar="I", help="Number of this process.")
    @click.option(
        "--processes",
        type=click.IntRange(1),
        metavar="N",
        help="Number of processes.",
    )
    @click.option(
        "--wait",
        default=processes.WAIT,
        show_default=True,
        metavar="SECONDS",
        type=click.FloatRange(1, 86400),
        help="Time after which a silent process is reported, at the start and later.",
    )
    @functools.wraps(command)
    def run(*args: object, **options: Any) -> None:
        names = [field.name for field in fields(processes.DeviceOptions)]
        devices = processes.DeviceOptions(**{name: options.pop(name) for name in names})
        command(*args, devices=devices, **options)

    return run
