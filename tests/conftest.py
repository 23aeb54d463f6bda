"""Tests compare with exact references, so they run in double precision, and compile in haste.

The library sets none of this; single precision is tested by ``jax.enable_x64(False)``.

Compiling is what tests spend their time on, for programs that run once. So the compiler hardly
optimises, and what one worker or run has compiled is read by the next. What the environment says
stands: ``XLA_FLAGS= pytest`` tests the programs as users get them, ``JAX_PLATFORMS=cuda`` on a GPU.
"""

import atexit
import collections
import gc
import getpass
import hashlib
import importlib
import inspect
import os
import platform
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path

import jaxlib
import pytest

from jaxltl.app.compilation import cache_all_programs, xla_flags

_HASTE = {
    "xla_backend_optimization_level": "0",
    "xla_llvm_disable_expensive_passes": "true",
    "xla_cpu_use_fusion_emitters": "false",
    "xla_cpu_parallel_codegen_split_count": "1",
}


def _cache() -> Path | None:
    """A directory of this user, compiler and processor; none if it is somebody else's."""
    processor = Path("/proc/cpuinfo")
    features = processor.read_text().split("\n\n")[0] if processor.exists() else ""
    lines = sorted(x for x in features.splitlines() if x.startswith(("flags", "Features", "model")))
    key = hashlib.sha256("\n".join([platform.machine(), *lines]).encode()).hexdigest()[:12]
    user = getattr(os, "getuid", getpass.getuser)()  # containers have users without a name
    place = Path(tempfile.gettempdir()) / f"jaxltl-tests-{user}"
    place.mkdir(mode=0o700, exist_ok=True)
    if hasattr(os, "getuid") and place.stat().st_uid != os.getuid():
        return None
    return place / f"jaxlib-{jaxlib.__version__}-{key}"


def _limit_memory(most: int = 8 * 2**30, least: int = 6 * 2**30) -> None:
    """Bounds the data of this process and of those that it starts, on Linux.

    A test that fills the memory then fails with its name. Otherwise the kernel ends workers, also
    those of other tests, and the run waits for them.
    """
    if sys.platform != "linux" or os.environ["JAX_PLATFORMS"] != "cpu":
        return  # drivers of accelerators map more than they use
    resource = importlib.import_module("resource")
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    for name in ("memory.max", "memory/memory.limit_in_bytes"):  # of a container
        file = Path("/sys/fs/cgroup", name)
        text = file.read_text().strip() if file.is_file() else ""
        memory = min(memory, int(text)) if text.isdigit() else memory
    soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
    limit = max(least, min(most, memory // 2))
    limits = [limit, *(x for x in (soft, hard) if x != resource.RLIM_INFINITY)]
    resource.setrlimit(resource.RLIMIT_DATA, (min(limits), hard))


# Before JAX reads them; workers and subprocesses inherit them.
os.environ.setdefault("JAX_PLATFORMS", "cpu")  # also where there is an accelerator
if "XLA_FLAGS" not in os.environ:
    os.environ["XLA_FLAGS"] = xla_flags(_HASTE)
if "JAX_COMPILATION_CACHE_DIR" not in os.environ and (place := _cache()):
    os.environ["JAX_COMPILATION_CACHE_DIR"] = str(place)
_limit_memory()
cache_all_programs()

import jax  # noqa: E402
import jax.experimental  # noqa: E402

# Tests find two functions where later versions than JAX 0.7 and 0.8 have them.
if not hasattr(jax, "enable_x64"):
    jax.enable_x64 = jax.experimental.enable_x64
if not hasattr(jax.monitoring, "unregister_event_duration_listener"):
    of_private = importlib.import_module("jax._src.monitoring")
    remove = of_private._unregister_event_duration_listener_by_callback
    jax.monitoring.unregister_event_duration_listener = remove
jax.config.update("jax_enable_x64", True)
# Meshes of one, two and four devices; all else stays on the first.
jax.config.update("jax_num_cpu_devices", 4)
# Among as many objects as compiled programs leave, a tenth of the time would go into looking for
# circles of some hundred new ones.
gc.set_threshold(200_000, 20, 20)

# Freeing thousands of compiled programs one by one takes seconds, for a worker that ends anyway.
if "PYTEST_XDIST_WORKER" in os.environ:
    atexit.register(os._exit, 0)


def _share_contexts(most: int = 100) -> None:
    """Has programs share what each is written down in, which takes a quarter of a small one's time.

    JAX makes a context, and loads all dialects into it, anew for each program.
    """
    lowering = importlib.import_module("jax._src.interpreters.mlir")
    make = getattr(lowering, "make_ir_context", None)
    if make is None:
        return
    mine = threading.local()

    def shared() -> object:
        mine.count = getattr(mine, "count", -1) + 1
        if mine.count % most == 0:
            mine.context = make()
        return mine.context

    lowering.make_ir_context = shared


def _cache_programs_with_callbacks() -> None:
    """Has the cache keep programs that call the host, which JAX compiles anew in each process.

    A program names its callbacks by their numbers, so one that is read is given those of this process.
    """
    compiler = importlib.import_module("jax._src.compiler")
    cache = importlib.import_module("jax._src.compilation_cache")
    client = importlib.import_module("jax._src.lib")._jax.Client
    takes = "host_callbacks: collections.abc.Sequence[collections.abc.Callable]"
    parts = [*inspect.signature(compiler.compile_or_get_cached).parameters][:5]
    if takes not in str(client.deserialize_executable.__doc__) or parts[-1:] != ["host_callbacks"]:
        return  # another version's
    compile_or_read, read, write = (
        compiler.compile_or_get_cached,
        cache.get_executable_and_time,
        compiler._cache_write,
    )
    mine = threading.local()

    class Backend:
        """A client of which programs that are read have the callbacks of this process."""

        def __init__(self, backend, callbacks):
            self.backend, self.callbacks = backend, callbacks

        def __getattr__(self, name):
            return getattr(self.backend, name)

        def deserialize_executable(self, *arguments):
            return self.backend.deserialize_executable(*arguments, self.callbacks)

    def with_callbacks(backend, module, devices, options, callbacks, *rest, **more):
        mine.callbacks = callbacks
        try:
            return compile_or_read(backend, module, devices, options, callbacks, *rest, **more)
        finally:
            mine.callbacks = ()

    def read_with_callbacks(key, options, backend, devices):
        if callbacks := getattr(mine, "callbacks", ()):
            backend = Backend(backend, callbacks)
        return read(key, options, backend, devices)

    compiler.compile_or_get_cached = with_callbacks
    cache.get_executable_and_time = read_with_callbacks
    compiler._cache_write = lambda *arguments: write(*arguments[:-1], ())


if "xla_backend_optimization_level=0" in os.environ["XLA_FLAGS"]:
    _share_contexts()
    _cache_programs_with_callbacks()


@pytest.hookimpl(tryfirst=True)  # before markers choose
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """After the first n cases of ``few(n, m)``, m are slow and the rest exhaustive; all, without m.

    Of cases that are exhaustive, none is slow.
    """
    seen: collections.Counter[str] = collections.Counter()
    for item in items:
        if item.get_closest_marker("exhaustive"):
            item.own_markers = [mark for mark in item.own_markers if mark.name != "slow"]
        elif few := item.get_closest_marker("few"):
            function = item.nodeid.partition("[")[0]
            seen[function] += 1
            if seen[function] > sum(few.args) and len(few.args) > 1:
                item.own_markers = [mark for mark in item.own_markers if mark.name != "slow"]
                item.add_marker(pytest.mark.exhaustive)
            elif seen[function] > few.args[0]:
                item.add_marker(pytest.mark.slow)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[object]:
    """Collection without looking for garbage, which there is none of: imported modules stay."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


_MAPS, _MAX_MAPS = Path("/proc/self/maps"), Path("/proc/sys/vm/max_map_count")
_compiled, _all_compiled = [0], [0]
MAX_PROGRAMS = (
    300  # that a file's default tests compile at most; one that needs more declares its own
)


def _count(event: str, *_: object, **__: object) -> None:
    is_program = event.endswith("backend_compile_duration")
    _compiled[0] += is_program
    _all_compiled[0] += is_program


jax.monitoring.register_event_duration_secs_listener(_count)


@pytest.fixture(autouse=True, scope="module")
def declared_programs(request: pytest.FixtureRequest):
    """A file whose default tests compile more programs than it declares fails, with its last test.

    Declared are some more than it compiles in a process of its own, about twice those after others.
    """
    before = _all_compiled[0]
    yield
    number, module = _all_compiled[0] - before, getattr(request.node, "obj", None)
    most = getattr(module, "MAX_PROGRAMS", MAX_PROGRAMS)
    is_default = request.config.option.markexpr == "not exhaustive and not slow"
    assert number <= most or not is_default, (
        f"{request.node.nodeid} compiled {number} programs, of at most {most}: share shapes and jitted "
        "functions, use NumPy outside of jit, or declare MAX_PROGRAMS in the file"
    )


@pytest.fixture(autouse=True, scope="module")
def few_compiled_programs():
    """Frees compiled programs after a file, if there are many, which takes seconds.

    Each takes some nine memory maps, of which Linux allows a process 65,530; the compiler crashes
    when there are no more. Left are those of another 1,400 programs: of one file, and of 500 that
    nobody looked at, since to count the maps takes time too.
    """
    yield
    if _compiled[0] < 500 or not _MAPS.exists():
        return
    _compiled[0] = 0
    if _MAPS.read_bytes().count(b"\n") > int(_MAX_MAPS.read_text()) - 13_000:
        jax.clear_caches()
