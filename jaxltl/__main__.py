"""The command ``jaxltl``, also as ``python -m jaxltl``."""

import contextlib
import os
import signal
import sys
from types import FrameType
from typing import NoReturn


def run() -> NoReturn:
    """Runs the command and ends the process as soon as all is written."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _interrupt)
    # Here, since processes that draw load this file too.
    import click

    from jaxltl.app.programs import few_collections
    from jaxltl.cli import main

    few_collections()
    status: object = 0
    try:
        status = main(standalone_mode=False)
    except click.ClickException as mistake:
        mistake.show()
        status = mistake.exit_code
    except SystemExit as stop:
        status = stop.code
    except (KeyboardInterrupt, click.Abort):
        status = _told()
    except BrokenPipeError:
        status = 1
    with contextlib.suppress(OSError):
        sys.stdout.flush()
        sys.stderr.flush()
    # Else JAX takes most of a second to free its compiled programs one by one.
    os._exit(status if isinstance(status, int) else 0 if status is None else 1)


_LOST = ("__del__", "_xla_gc_callback")


def _interrupt(number: int, frame: FrameType | None) -> None:
    """As usual, but not before what is under way can be interrupted.

    Some imports catch whatever is raised, and modules that are half there then tell of themselves;
    what is raised while memory is collected is lost.
    """
    while frame is not None:
        code = frame.f_code
        if code.co_filename.startswith("<frozen importlib") or code.co_name in _LOST:
            if not hasattr(signal, "setitimer"):
                os._exit(_told())
            signal.signal(signal.SIGALRM, _interrupt)
            signal.setitimer(signal.ITIMER_REAL, 0.01)
            return
        frame = frame.f_back
    raise KeyboardInterrupt


def _told() -> int:
    """Says that the command was interrupted, and returns the status for it."""
    with contextlib.suppress(OSError):
        os.write(2, b"interrupted\n")
    return 130


if __name__ == "__main__":
    run()
