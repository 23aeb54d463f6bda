"""The command ``jaxltl``, also as ``python -m jaxltl``."""

import contextlib
import os
import signal
import sys
from types import FrameType
from typing import NoReturn


def run() -> NoReturn:
    """Runs the command and exits with its status."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _interrupt)
    # Imports here, since processes that draw load this file too.
    import click

    from jaxltl.app.compilation import collect_rarely
    from jaxltl.cli import main

    collect_rarely()
    status: object = 0
    try:
        status = main(standalone_mode=False)
    except click.ClickException as mistake:
        mistake.show()
        status = mistake.exit_code
    except SystemExit as stop:
        status = stop.code
    except (KeyboardInterrupt, click.Abort):
        status = _report_interrupt()
    try:
        sys.stdout.flush()
        sys.stderr.flush()
    except BrokenPipeError:  # the reader of a pipe has ended
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        status = 1
    sys.exit(status if isinstance(status, int) or status is None else 1)


_UNSAFE = ("__del__", "_xla_gc_callback")  # exceptions in these functions are lost


def _interrupt(number: int, frame: FrameType | None) -> None:
    """Raises KeyboardInterrupt, but not within an import or a finaliser.

    Some imports catch all exceptions, and exceptions of finalisers are lost.
    """
    while frame is not None:
        code = frame.f_code
        if code.co_filename.startswith("<frozen importlib") or code.co_name in _UNSAFE:
            if not hasattr(signal, "setitimer"):
                os._exit(_report_interrupt())
            signal.signal(signal.SIGALRM, _interrupt)
            signal.setitimer(signal.ITIMER_REAL, 0.01)
            return
        frame = frame.f_back
    raise KeyboardInterrupt


def _report_interrupt() -> int:
    """Prints a line, and returns the exit status of an interrupted command."""
    with contextlib.suppress(OSError):
        os.write(2, b"interrupted\n")
    return 130


if __name__ == "__main__":
    run()
