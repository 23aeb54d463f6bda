"""Timing with compilation apart, and peers interleaved so that drift hits both."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any

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
