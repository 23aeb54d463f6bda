"""Pictures drawn in other processes, in parallel to the work."""

from __future__ import annotations

import contextlib
import dataclasses
import gc
import os
import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor
from multiprocessing import get_context, parent_process
from multiprocessing.util import Finalize
from typing import Any


_PROCESSES = 2


@dataclasses.dataclass(frozen=True)
class Drawing:
    """A deferred call of a function of :mod:`jaxltl.plot`."""

    function: str
    arguments: tuple[Any, ...]
    options: Mapping[str, object]


@dataclasses.dataclass(frozen=True)
class Picture:
    """Picture of a report, left out of a page with the interactive part `live`."""

    name: str
    title: str
    drawing: Drawing | bytes | None  # or its SVG; None if it is drawn elsewhere
    caption: str
    live: str = ""


Artist = Callable[[Drawing], Callable[[], bytes]]


def drawing(function: str, *arguments: object, **options: object) -> Drawing:
    """A deferred call of a function of :mod:`jaxltl.plot`, with NumPy arrays."""
    return Drawing(function, tuple(map(_on_the_host, arguments)), options)


def _on_the_host(argument: object) -> Any:
    """A dataclass with NumPy arrays: unpickling JAX arrays would import JAX."""
    if not dataclasses.is_dataclass(argument) or isinstance(argument, type):
        return argument
    import jax
    import numpy as np

    return jax.tree.map(np.asarray, argument)


def automaton_picture(automaton: object, live: str) -> Picture:
    """The picture of the formula's automaton."""
    return Picture(
        "automaton.svg",
        "Automaton of the formula",
        drawing("automaton", automaton),
        "Double circle: any continuation satisfies the formula. Grey: it is violated. States are "
        "named by the remaining formula.",
        live,
    )


def learning_picture(history: Mapping[str, Any], caption: str, show: Sequence[str]) -> Picture:
    """The picture of some learning curves."""
    series = {k: history[k].T for k in show if k in history}
    drawn = drawing("curves", series, steps=history["step"])
    return Picture("learning.svg", "Learning", drawn, caption, "learning")


def short_name(text: str, width: int = 44) -> str:
    """A name truncated to `width` characters."""
    return text if len(text) <= width else text[: width - 1] + "…"


def draw(picture: Drawing) -> bytes:
    """The SVG of a drawing."""
    # Import here: learning alone does not need matplotlib.
    from jaxltl import plot

    figure = getattr(plot, picture.function)(*picture.arguments, **picture.options)
    return figure.encode() if isinstance(figure, str) else plot.to_bytes(figure)


@contextlib.contextmanager
def artist(apart: bool) -> Iterator[Artist]:
    """A function that begins a drawing and returns a function that waits for its SVG."""
    if not apart:
        yield lambda picture: lambda: draw(picture)
        return
    # Spawned: JAX has threads, and a process with threads must not fork.
    pool = ProcessPoolExecutor(_PROCESSES, get_context("spawn"), _prepare)

    def begin(picture: Drawing) -> Callable[[], bytes]:
        with _interrupts_blocked():
            drawn = pool.submit(draw, picture)
            pool.submit(int)  # starts the next process if this one is busy

        def finish() -> bytes:
            try:
                return drawn.result()
            except BrokenExecutor:
                return draw(picture)

        return finish

    try:
        with _interrupts_blocked():
            pool.submit(int)
        yield begin
    finally:
        # Waits, since Python warns of semaphores that are left at exit.
        pool.shutdown(cancel_futures=True)


@contextlib.contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Blocks interrupts, also in processes started here, which would print a traceback."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _prepare() -> None:
    gc.set_threshold(20_000, 50, 100)  # saves a tenth of the time
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # without pthread_sigmask
    threading.Thread(target=_end_with_parent, daemon=True).start()
    # Skips the interpreter's teardown, which takes half a second after matplotlib.
    Finalize(None, os._exit, args=(0,), exitpriority=-1)
    import jaxltl.plot  # noqa: F401


def _end_with_parent() -> None:
    """Ends with the parent: a pool's process would wait for work for ever."""
    if (parent := parent_process()) is not None:
        parent.join()
        os._exit(1)
