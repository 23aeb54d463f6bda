"""Pictures drawn beside the work, so that nobody waits for matplotlib."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor
from multiprocessing import get_context, parent_process
from multiprocessing.util import Finalize
from typing import Any, NamedTuple

from jaxltl.app.compilation import collect_rarely

_PROCESSES = 2


class Drawing(NamedTuple):
    """A picture that is still to be drawn: a function of :mod:`jaxltl.plot` and what it takes."""

    function: str
    arguments: tuple[Any, ...]
    options: Mapping[str, Any]


class Picture(NamedTuple):
    """A picture of a report: its file's name, title, caption, and how it is drawn.

    A page leaves it out where it has the live part that says the same.
    """

    name: str
    title: str
    drawing: Drawing | bytes | None  # as SVG, or None, where it is drawn already
    caption: str
    live: str = ""


Artist = Callable[[Drawing], Callable[[], bytes]]


def drawing(function: str, *arguments: Any, **options: Any) -> Drawing:
    """The call of a function of :mod:`jaxltl.plot`, to be made later and elsewhere."""
    return Drawing(function, tuple(map(_on_the_host, arguments)), options)


def _on_the_host(argument: Any) -> Any:
    """An automaton or a world with NumPy's arrays; to read JAX's, a process has to load JAX."""
    if not dataclasses.is_dataclass(argument) or isinstance(argument, type):
        return argument
    import jax
    import numpy as np

    return jax.tree.map(np.asarray, argument)


def draw(picture: Drawing) -> bytes:
    """The SVG of a picture: of a figure, or as its function says."""
    # Deferred: learning alone does not need matplotlib.
    from jaxltl import plot

    found = getattr(plot, picture.function)(*picture.arguments, **picture.options)
    return found.encode() if isinstance(found, str) else plot.to_bytes(found)


@contextlib.contextmanager
def artist(apart: bool) -> Iterator[Artist]:
    """What begins to draw a picture and returns how to get it.

    Args:
      apart: draw in processes of their own, of which the first loads matplotlib from now on, the
        others with the first picture; else when the picture is asked for.
    """
    if not apart:
        yield lambda picture: lambda: draw(picture)
        return
    # Spawned, since a process with threads, which JAX has, must not fork.
    pool = ProcessPoolExecutor(_PROCESSES, get_context("spawn"), _prepare)

    def begin(picture: Drawing) -> Callable[[], bytes]:
        with _undisturbed():
            drawn = pool.submit(draw, picture)
            pool.submit(int)  # so that the next process begins to load if this one is busy

        def finish() -> bytes:
            try:
                return drawn.result()
            except BrokenExecutor:
                return draw(picture)

        return finish

    try:
        with _undisturbed():
            pool.submit(int)
        yield begin
    finally:
        # Waits, else the end of this process leaves semaphores, of which Python warns.
        pool.shutdown(cancel_futures=True)


@contextlib.contextmanager
def _undisturbed() -> Iterator[None]:
    """Interrupts come afterwards, to this process alone: one that is begun here never has them.

    It would tell of them while it loads, and the command itself says what is to be done.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _prepare() -> None:
    collect_rarely()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # where it could not be kept from here
    threading.Thread(target=_end_with_parent, daemon=True).start()
    # Else what was loaded is freed piece by piece, for half a second.
    Finalize(None, os._exit, args=(0,), exitpriority=-1)
    import jaxltl.plot  # noqa: F401


def _end_with_parent() -> None:
    """A process of a pool waits for work for ever, also where its parent was killed."""
    if (parent := parent_process()) is not None:
        parent.join()
        os._exit(1)
