"""JAX settings of the command line: fast compilation, a persistent cache, double precision.

Most are environment variables, set before JAX is imported unless the user has set them.
"""

from __future__ import annotations

import contextlib
import gc
import os
import re
import sys
from collections.abc import Iterator, Mapping
from importlib import metadata
from pathlib import Path

# About 10 % less processor time for a first `learn`; loops over successors and matrix products,
# which come from a library, run as fast (docs/benchmarks.md).
FAST_COMPILATION = {"xla_cpu_use_fusion_emitters": "false", "xla_backend_optimization_level": "1"}
# XLA ends the process for a flag that it does not know. Those used here and in the tests are known
# to the first and the last of these versions of jaxlib; other versions get none.
_TESTED = ((0, 7), (0, 11))


def is_fresh() -> bool:
    """True if JAX has not been imported, so that its settings can still be made."""
    return "jax" not in sys.modules


def xla_flags(flags: Mapping[str, str], version: str | None = None) -> str:
    """Value of ``XLA_FLAGS``; empty for versions of jaxlib without tested flags."""
    version = version or metadata.version("jaxlib")
    first, end = _TESTED
    if not first <= tuple(int(part) for part in re.findall(r"\d+", version)[:2]) < end:
        return ""
    return " ".join(f"--{name}={value}" for name, value in flags.items())


def compile_fast() -> None:
    """Makes XLA optimise less, for programs that run shortly."""
    if is_fresh() and "XLA_FLAGS" not in os.environ:
        os.environ["XLA_FLAGS"] = xla_flags(FAST_COMPILATION)


def use_one_thread() -> None:
    """Makes NumPy solve linear systems in one thread.

    More threads do not help with some hundred rows, and delay the compiler by spinning.
    """
    if "numpy" not in sys.modules:
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def collect_rarely() -> None:
    """Makes Python collect garbage less often, which saves a tenth of a short command's time."""
    gc.set_threshold(20_000, 50, 100)


@contextlib.contextmanager
def float64() -> Iterator[None]:
    """Double precision in a command, set for all threads.

    `jax.enable_x64` is local to a thread, and callbacks in others would get single precision.
    """
    import jax

    before = jax.config.values["jax_enable_x64"]
    jax.config.update("jax_enable_x64", True)
    try:
        yield
    finally:
        jax.config.update("jax_enable_x64", before)


def use_cache(wanted: bool) -> None:
    """Turns JAX's persistent cache of compiled programs on or off."""
    if not is_fresh():
        return
    if not wanted:
        os.environ["JAX_ENABLE_COMPILATION_CACHE"] = "false"
        return
    if not os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        directory = cache_directory()
        try:
            directory.mkdir(parents=True, exist_ok=True)
        except OSError:
            return
        if not os.access(directory, os.W_OK):
            return
        os.environ["JAX_COMPILATION_CACHE_DIR"] = str(directory)
    cache_all_programs()


def cache_all_programs() -> None:
    """Makes the cache keep small programs too: each takes longer to compile than to read."""
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")
    # XLA mistakes its own hints to LLVM for missing features of the processor, and logs an error
    # for each program that it reads.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")


def cache_directory() -> Path:
    """Directory of compiled programs, in the user's directory of caches."""
    home = Path.home()
    if sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA") or home / "AppData" / "Local")
    elif sys.platform == "darwin":
        base = home / "Library" / "Caches"
    else:
        xdg = os.environ.get("XDG_CACHE_HOME", "")
        base = Path(xdg) if os.path.isabs(xdg) else home / ".cache"
    return base / "jaxltl" / "programs"
