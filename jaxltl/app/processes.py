"""Several devices, and several processes, for the command line.

Processes of one run meet by ``jax.distributed``: from what Slurm or Open MPI say in the
environment, or from the options ``--coordinator``, ``--process`` and ``--processes``. All do the
same work, each on its own devices; the first alone writes and prints. When one dies the others end,
with a line that says so.
"""

from __future__ import annotations

import contextlib
import errno
import inspect
import io
import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from jaxltl.app import exit_message

if TYPE_CHECKING:
    from jax.sharding import Mesh

Found = TypeVar("Found")

LOST = 3  # the exit status where another process has died
WAIT = 60.0  # seconds
_TO_THE_END = 7 * 24 * 3600  # seconds that others wait for the first to write its results
# By launcher, the variables with the number of processes and of this one, and those that JAX takes
# the first one's address from.
_LAUNCHERS = {
    "Open MPI": ("OMPI_COMM_WORLD_SIZE", "OMPI_COMM_WORLD_RANK", ("OMPI_MCA_orte_hnp_uri",)),
    "Slurm": (
        "SLURM_NTASKS",
        "SLURM_PROCID",
        ("SLURM_JOB_ID", "SLURM_STEP_NODELIST", "SLURM_LOCALID"),
    ),
}


@dataclass(frozen=True)
class Asked:
    """What was asked for.

    Attributes:
      mesh: the number of devices; 0: all that there are; None: no mesh.
      coordinator: ``HOST:PORT`` where process 0 is met, or None.
      process, processes: which process this is, and of how many, or None.
      wait: seconds that another process may be silent for, at the start and later.
    """

    mesh: int | None = None
    coordinator: str | None = None
    process: int | None = None
    processes: int | None = None
    wait: float = WAIT


@dataclass(frozen=True)
class Launch:
    """Which process this is, of how many, and where the first is met; None: JAX finds out."""

    process: int = 0
    processes: int = 1
    coordinator: str | None = None


def launched(asked: Asked, environment: Mapping[str, str] = os.environ) -> Launch:
    """Which process this is, from the options, else from what a launcher says.

    Without a mesh every process is alone.

    Raises:
      ValueError: naming the option: it contradicts others, or one is missing.

    Example:
      >>> launched(Asked(mesh=0, coordinator="10.0.0.1:1234", process=1, processes=2), {})
      Launch(process=1, processes=2, coordinator='10.0.0.1:1234')
      >>> launched(Asked(mesh=0), {"SLURM_NTASKS": "4", "SLURM_PROCID": "3", "SLURM_JOB_ID": "7",
      ...                          "SLURM_STEP_NODELIST": "n[1-4]", "SLURM_LOCALID": "0"})
      Launch(process=3, processes=4, coordinator=None)
    """
    options = {
        "--coordinator": asked.coordinator,
        "--process": asked.process,
        "--processes": asked.processes,
    }
    given = [name for name, value in options.items() if value is not None]
    if asked.mesh is None:
        if given:
            raise ValueError(f"{given[0]} is of use with --mesh alone; give that too.")
        return Launch()
    if asked.processes == 1 and not asked.process:
        return Launch()
    launcher, told = _told(environment)
    processes, process = asked.processes, asked.process
    if told is not None:
        processes = told.processes if processes is None else processes
        process = told.process if process is None else process
    address = asked.coordinator or environment.get("JAX_COORDINATOR_ADDRESS")
    if not given and (told is None or told.processes == 1):
        return Launch()
    if processes is None or process is None:
        missing = "--processes" if processes is None else "--process"
        raise ValueError(
            f"{missing} is missing: give --coordinator HOST:PORT, --process I and "
            "--processes N, or start with srun or mpirun, which say so themselves."
        )
    if not 0 <= process < processes:
        raise ValueError(
            f"--process {process} is none of {processes} processes; number them from "
            f"0 to {processes - 1}."
        )
    if address is not None:
        _host_and_port(address)
    elif told is None or any(name not in environment for name in _LAUNCHERS[launcher][2]):
        who = f"{launcher} does not say where process 0 is" if told else "nobody else says it"
        raise ValueError(
            f"--coordinator is missing, and {who}: give all processes --coordinator "
            "HOST:PORT, the machine of process 0 and a free port of it."
        )
    return Launch(process, processes, address)


def _told(environment: Mapping[str, str]) -> tuple[str, Launch | None]:
    """What a launcher says in the environment."""
    for launcher, (number, this, _) in _LAUNCHERS.items():
        with contextlib.suppress(KeyError, ValueError):
            return launcher, Launch(int(environment[this]), int(environment[number]))
    return "", None


def _host_and_port(address: str) -> tuple[str, int]:
    host, _, port = address.rpartition(":")
    if not host or not port.isdigit() or not 0 < int(port) < 65536:
        raise ValueError(f"--coordinator {address!r} is no HOST:PORT, such as node1:12345.")
    return host.strip("[]"), int(port)


@dataclass(frozen=True)
class Place:
    """Where a run takes place.

    Attributes:
      process, processes: which process this is, and of how many.
      mesh: of devices, on one axis; None: what JAX does by default.
    """

    process: int = 0
    processes: int = 1
    mesh: Mesh | None = None

    @property
    def is_first(self) -> bool:
        """Whether this process writes and prints."""
        return self.process == 0

    @property
    def num_devices(self) -> int:
        return 1 if self.mesh is None else self.mesh.size

    def exchanged(self, text: str) -> list[str]:
        """What every process gives, in each of them."""
        if self.processes == 1:
            return [text]
        import numpy as np
        from jax.experimental.multihost_utils import process_allgather

        data = np.frombuffer(text.encode(), np.uint8)
        sizes = np.asarray(process_allgather(np.array([data.size], np.int32))).ravel()
        padded = np.zeros(max(int(sizes.max()), 1), np.uint8)
        padded[: data.size] = data
        every = np.asarray(process_allgather(padded))
        return [row[:n].tobytes().decode() for row, n in zip(every, sizes.tolist(), strict=True)]

    def together(self, work: Callable[[], Found]) -> Found:
        """What a piece of work yields that is each process's own, or a mistake told once.

        Raises:
          ValueError: a mistake, in the first of the processes that made it.
          SystemExit: another process tells of its mistake.
        """
        if self.processes == 1:
            return work()
        mistake, found = "", None
        try:
            found = work()
        except (ValueError, OSError) as error:
            mistake = str(error) or type(error).__name__
        every = self.exchanged(mistake)
        if not any(every):
            return found  # type: ignore[return-value]
        if any(every[: self.process]) or not mistake:
            raise SystemExit(2)
        raise ValueError(mistake if len(set(every)) == 1 else f"process {self.process}: {mistake}")

    def agree(self, given: Mapping[str, Any]) -> None:
        """Checks that all processes have the same of what is given by name.

        Raises:
          ValueError: naming what differs, in the first process; the others end without a word.
        """
        every = [json.loads(x) for x in self.exchanged(json.dumps(dict(given), default=str))]
        for process, other in enumerate(every):
            for name in {**every[0], **other}:
                one, two = (x.get(name, "nothing") for x in (every[0], other))
                if one == two:
                    continue
                if not self.is_first:
                    raise SystemExit(2)
                raise ValueError(
                    f"process {process} has {name} {two}, and process 0 {one}; start all processes "
                    "with the same arguments, files and versions."
                )

    def sees(self, what: str, here: bool) -> bool:
        """Whether something of the file system is there, if all processes agree.

        Raises:
          ValueError: they do not.
        """
        every = self.exchanged(str(here))
        if len(set(every)) > 1:
            without = every.index("False")
            if not self.is_first:
                raise SystemExit(2)
            raise ValueError(
                f"process {without} does not see {what}; give --out a directory that "
                "all processes share."
            )
        return here


@contextlib.contextmanager
def taking_part(asked: Asked, launch: Launch, say: Callable[[str], None]) -> Iterator[Place]:
    """The run of this process among the others: joined before any device is used, left at the end.

    Args:
      asked: the options.
      launch: of :func:`launched`.
      say: takes the line on what it runs on.

    Raises:
      ValueError: the others cannot be reached, or there are fewer devices than asked for.
      SystemExit: another process has died; told in one line, with the status :data:`LOST`.
    """
    if asked.mesh is None:
        yield Place()
        return
    _choose_devices(asked, launch)
    if launch.processes == 1:
        place = Place(mesh=_mesh(asked, launch))
        say(f"on {_devices_of(place)}")
        yield place
        return
    if launch.coordinator is not None:
        _meet(launch, asked.wait)
    _read_apart(launch)
    try:
        _join(launch, asked.wait)
        place = Place(launch.process, launch.processes, _same_mesh(asked, launch))
        say(f"on {_devices_of(place)} of {launch.processes} processes")
        yield place
    except Exception as error:
        if not is_loss(error):
            raise
        line = (
            f"process {launch.process} stops, for another process has ended; {exit_message.AGAIN}."
        )
        os.write(2, f"{exit_message.END}{line}\n".encode())
        raise SystemExit(LOST) from None
    _leave()


def _choose_devices(asked: Asked, launch: Launch) -> None:
    """What JAX must know before it makes its devices."""
    if asked.mesh is not None and asked.mesh % launch.processes:
        raise ValueError(
            f"--mesh {asked.mesh} cannot be split evenly over {launch.processes} "
            "processes; give a multiple of them."
        )
    import jax

    if launch.processes > 1:
        jax.config.update("jax_cpu_collectives_implementation", "gloo")
        # Whose handler of SIGTERM notes that the end is near, and lets the process go on.
        with contextlib.suppress(AttributeError):
            jax.config.update("jax_enable_preemption_service", False)
    if asked.mesh and "xla_force_host_platform_device_count" not in os.environ.get("XLA_FLAGS", ""):
        with contextlib.suppress(RuntimeError):  # there are devices already, from which to choose
            jax.config.update("jax_num_cpu_devices", asked.mesh // launch.processes)


def _same_mesh(asked: Asked, launch: Launch) -> Mesh:
    """Of all processes, of which each sees the same devices, so that a mistake is told once."""
    try:
        return _mesh(asked, launch)
    except ValueError:
        if launch.process:
            raise SystemExit(2) from None
        raise


def _mesh(asked: Asked, launch: Launch) -> Mesh:
    """The devices, as many of each process, on one axis."""
    import jax
    import numpy as np
    from jax.sharding import Mesh

    assert asked.mesh is not None
    each = [[d for d in jax.devices() if d.process_index == p] for p in range(launch.processes)]
    number = len(each[0])
    other = next((p for p, x in enumerate(each) if len(x) != number), None)
    if other is not None:
        raise ValueError(
            f"process {other} has another number of devices, {len(each[other])}, than "
            f"process 0, {number}; give all processes as many."
        )
    per = asked.mesh // launch.processes if asked.mesh else number
    if number < per:
        several = launch.processes > 1
        takes = f" takes {per} devices of each process" if several else ""
        raise ValueError(
            f"--mesh {asked.mesh}{takes}: {'each has' if several else 'there are'} {number} "
            f"({jax.default_backend()}); give fewer, or --mesh alone for all."
        )
    return Mesh(np.array([d for x in each for d in x[:per]]), ("devices",))


def _devices_of(place: Place) -> str:
    mesh = place.mesh
    assert mesh is not None
    kind = mesh.devices.flat[0].device_kind
    name = "CPU" if kind == "cpu" else kind
    return f"{mesh.size} {name} device{'s' if mesh.size > 1 else ''}"


# --- meeting ----------------------------------------------------------------------------------


def _meet(launch: Launch, wait: float) -> None:
    """Waits for process 0 to be there, or makes sure that it can be met here.

    JAX ends the process where that fails, without a word that helps.
    """
    assert launch.coordinator is not None
    host, port = _host_and_port(launch.coordinator)
    if launch.process == 0:
        try:
            with socket.socket() as one:
                one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                one.bind(("", port))
        except OSError as error:
            used = error.errno == errno.EADDRINUSE
            raise ValueError(
                f"--coordinator {launch.coordinator}: "
                + (
                    f"port {port} of this machine is in use; choose another."
                    if used
                    else f"{error.strerror}."
                )
            ) from None
        return
    end = time.monotonic() + wait
    while True:
        try:
            socket.create_connection((host, port), timeout=max(end - time.monotonic(), 0.1)).close()
            return
        except OSError as error:
            if time.monotonic() > end:
                raise ValueError(
                    f"process {launch.process} has not reached process 0 at {launch.coordinator} "
                    f"in {wait:g} s ({error.strerror or error}); start it there, with the same "
                    "--coordinator, or give it longer by --wait."
                ) from None
        time.sleep(0.2)


def _join(launch: Launch, wait: float) -> None:
    import jax

    seconds = max(int(wait), 1)
    address, bind = launch.coordinator, None
    if address is not None and _host_and_port(address)[0] in ("127.0.0.1", "localhost"):
        bind = address  # of no use to other machines, and so not open to them
    later: dict[str, Any] = {
        "heartbeat_timeout_seconds": seconds,
        "shutdown_timeout_seconds": _TO_THE_END,
    }
    known = inspect.signature(jax.distributed.initialize).parameters  # by the version of JAX
    jax.distributed.initialize(
        address,
        launch.processes,
        launch.process,
        initialization_timeout=seconds,
        coordinator_bind_address=bind,
        **{k: v for k, v in later.items() if k in known},
    )


def _leave() -> None:
    """When all are done. Whoever is the first to leave would seem dead to the others."""
    import jax

    jax.distributed.shutdown()


# --- the end ----------------------------------------------------------------------------------


def _read_apart(launch: Launch) -> None:
    """Has what the runtime writes read by another process, which tells of its end in a line.

    The runtime ends a process at once where another has died, with its own words, on the file
    descriptors; Python's streams get other ones. Processes but the first print nothing else.
    """
    out, err = os.dup(1), os.dup(2)
    source, sink = os.pipe()
    subprocess.Popen(
        [sys.executable, "-I", "-S", str(Path(exit_message.__file__)), str(launch.process)],
        stdin=source,
        stdout=err,
        stderr=err,
    )
    os.close(source)
    os.dup2(sink, 1)
    os.dup2(sink, 2)
    os.close(sink)
    for name, number in (("stdout", out), ("stderr", err)):
        old = getattr(sys, name)
        old.flush()
        setattr(
            sys,
            name,
            io.TextIOWrapper(
                io.BufferedWriter(io.FileIO(number, "w")),
                encoding=old.encoding,
                errors=old.errors,
                line_buffering=name == "stderr" or old.line_buffering,
            ),
        )
    if launch.process:
        sys.stdout = io.TextIOWrapper(io.BufferedWriter(io.FileIO(os.devnull, "w")))
    with contextlib.suppress(ImportError, ValueError, OSError):  # no dump of all that it holds
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, resource.getrlimit(resource.RLIMIT_CORE)[1]))


def is_loss(error: Exception) -> bool:
    """Whether an error says that a process could not reach another one."""
    text = str(error)
    return "Gloo" in text or "coordination" in text.lower() or "NCCL" in text
