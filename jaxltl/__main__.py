"""The command ``jaxltl``, also as ``python -m jaxltl``."""

import contextlib
import os
import sys
from typing import NoReturn


def run() -> NoReturn:
    """Runs the command and ends the process as soon as all is written."""
    # Here, since processes that draw load this file too.
    from jaxltl.app.programs import few_collections
    from jaxltl.cli import main

    few_collections()
    status: object = 0
    try:
        main()
    except SystemExit as stop:
        status = stop.code
    with contextlib.suppress(OSError):
        sys.stdout.flush()
        sys.stderr.flush()
    # Else JAX takes most of a second to free its compiled programs one by one.
    os._exit(status if isinstance(status, int) else 0 if status is None else 1)


if __name__ == "__main__":
    run()
