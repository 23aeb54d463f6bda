"""Timing with compilation apart, and peers interleaved so that drift hits both."""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax


def once(function: Callable[[], Any]) -> tuple[float, Any]:
    """Seconds of one call, and its result, which has been computed by then."""
    begin = time.perf_counter()
    result = jax.block_until_ready(function())
    return time.perf_counter() - begin, result


def compare(ours: Callable[[], Any], peer: Callable[[], Any], *, repeats: int) -> dict[str, float]:
    """Median seconds of both, called in turn, the median ratio, and our first call's excess."""
    first, _ = once(ours)
    once(peer)
    pairs = [(once(ours)[0], once(peer)[0]) for _ in range(repeats)]
    mine = statistics.median(p[0] for p in pairs)
    return {
        "compile_seconds": max(first - mine, 0.0),
        "seconds": mine,
        "peer_seconds": statistics.median(p[1] for p in pairs),
        "ratio": statistics.median(p[0] / p[1] for p in pairs),
        "ratio_min": min(p[0] / p[1] for p in pairs),
        "ratio_max": max(p[0] / p[1] for p in pairs),
    }


class Spent(NamedTuple):
    """Seconds of a call, those of all its threads, and the mean number of threads ready to run.

    The last does not depend on other programs that share the cores; without them the call takes
    `processor_seconds / threads`.
    """

    seconds: float
    processor_seconds: float
    threads: float


_COUNT = """
import os, signal, sys, time
place, looks, ready = f"/proc/{sys.argv[1]}/task", 0, 0
def end(*_):
    print(ready / max(looks, 1), flush=True)
    os._exit(0)
signal.signal(signal.SIGTERM, end)
print(flush=True)
while True:
    for thread in os.listdir(place):
        try:
            ready += open(f"{place}/{thread}/stat").read().rpartition(")")[2].split()[0] == "R"
        except OSError:
            pass
    looks += 1
    time.sleep(0.002)
"""


def spent(function: Callable[[], Any]) -> Spent:
    """What a call spends; on Linux."""
    command = [sys.executable, "-S", "-c", _COUNT, str(os.getpid())]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as counter:
        assert counter.stdout is not None
        counter.stdout.readline()
        begin = time.perf_counter(), time.process_time()
        jax.block_until_ready(function())
        end = time.perf_counter(), time.process_time()
        counter.terminate()
        threads = float(counter.stdout.readline())
    return Spent(end[0] - begin[0], end[1] - begin[1], threads)
