"""How the command line has programs compiled: soon, and once.

All of it by the environment, before JAX is imported, where what the user has set there stands. The
library itself leaves JAX's and Python's settings alone.
"""

from __future__ import annotations

import gc
import importlib.util
import mmap
import os
import sys
from collections.abc import Mapping
from pathlib import Path

# Halves the time that the compiler takes. What it makes of loops over successors, and the products
# of matrices, which it has from a library, are as fast.
SOON = {"xla_cpu_use_fusion_emitters": "false", "xla_backend_optimization_level": "1"}


def is_alone() -> bool:
    """Whether the process is the command's own, where nobody has imported JAX before."""
    return "jax" not in sys.modules


def compile_soon() -> None:
    """Has the compiler spend less on each program."""
    if is_alone() and "XLA_FLAGS" not in os.environ:
        os.environ["XLA_FLAGS"] = known_flags(SOON)


def one_thread() -> None:
    """Has NumPy solve its systems in one thread.

    On some hundred rows others gain nothing, and wait by turning, which holds up whoever is at
    work beside: the compiler, and the processes that draw.
    """
    if "numpy" not in sys.modules:
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def few_collections() -> None:
    """Has Python look for circles of garbage more seldom, in a process of the command's own.

    Imports and traces make many objects that stay; going over them takes a tenth of a short run.
    """
    gc.set_threshold(20_000, 50, 100)


def keep_programs(wanted: bool) -> None:
    """Tells JAX to keep compiled programs for the next time, or not to."""
    if not is_alone():
        return
    if not wanted:
        os.environ["JAX_ENABLE_COMPILATION_CACHE"] = "false"
        return
    if not os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        place = cache_directory()
        try:
            place.mkdir(parents=True, exist_ok=True)
        except OSError:
            return
        if not os.access(place, os.W_OK):
            return
        os.environ["JAX_COMPILATION_CACHE_DIR"] = str(place)
    keep_all_programs()


def keep_all_programs() -> None:
    """However small: a job has many, each of which takes longer to compile than to read."""
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")
    # XLA takes its own hints to the compiler for features that the processor lacks, and says so
    # as an error for each program that it reads.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")


def cache_directory() -> Path:
    """Where the command line keeps compiled programs: in the user's directory for caches."""
    home = Path.home()
    if sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA") or home / "AppData" / "Local")
    elif sys.platform == "darwin":
        base = home / "Library" / "Caches"
    else:
        given = os.environ.get("XDG_CACHE_HOME", "")
        base = Path(given) if os.path.isabs(given) else home / ".cache"
    return base / "jaxltl" / "programs"


def known_flags(flags: Mapping[str, str]) -> str:
    """Those flags that the installed compiler knows, which ends the process for others."""
    found = set()
    jaxlib = importlib.util.find_spec("jaxlib")
    home = Path(jaxlib.origin).parent if jaxlib and jaxlib.origin else Path()
    for library in home.glob("*.so"):
        with library.open("rb") as file:
            text = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
            # A whole text: names of flags that are gone stand among others for good.
            found |= {name for name in flags if text.find(b"\0%b\0" % name.encode()) >= 0}
    return " ".join(f"--{name}={value}" for name, value in flags.items() if name in found)
