"""Devices and distributed processes of the command line.

Processes of one run are connected by ``jax.distributed``, configured by the environment of Slurm
or Open MPI, or by options. All execute the same program on different devices; only the first
writes and prints. When one ends early the others end too, with an explanation.
"""

from __future__ import annotations

import contextlib
import errno
import inspect
import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from jaxltl.app.command_options import DeviceOptions
from jaxltl.app.wording import Record

if TYPE_CHECKING:
    from jax.sharding import Mesh

LOST = 3  # exit status if another process has ended
_TO_THE_END = 7 * 24 * 3600  # seconds that others wait while the first writes its results
# By launcher: variables of the number of processes and of this process, and those from which JAX
# derives the coordinator's address.
_LAUNCHERS = {
    "Open MPI": ("OMPI_COMM_WORLD_SIZE", "OMPI_COMM_WORLD_RANK", ("OMPI_MCA_orte_hnp_uri",)),
    "Slurm": (
        "SLURM_NTASKS",
        "SLURM_PROCID",
        ("SLURM_JOB_ID", "SLURM_STEP_NODELIST", "SLURM_LOCALID"),
    ),
}


@dataclass(frozen=True)
class Launch:
    """Number of this process, of processes, and the coordinator; None if JAX detects it."""

    process: int = 0
    processes: int = 1
    coordinator: str | None = None


def launched(options: DeviceOptions, environment: Mapping[str, str] = os.environ) -> Launch:
    """Launch of this process by its options, else by a launcher's environment."""
    names = ("coordinator", "process", "processes")
    options_of_launch = [x for x in names if getattr(options, x) is not None]
    if options.mesh is None:
        if options_of_launch:
            raise ValueError(f"--{options_of_launch[0]} needs --mesh; give that too.")
        return Launch()
    launcher, detected = _detect(environment)
    alone = options.processes == 1 and not options.process
    if alone or (not options_of_launch and (detected is None or detected.processes == 1)):
        return Launch()
    processes, process = options.processes, options.process
    if detected is not None:
        processes = detected.processes if processes is None else processes
        process = detected.process if process is None else process
    if processes is None or process is None:
        missing = "--processes" if processes is None else "--process"
        raise ValueError(
            f"{missing} is missing: give --coordinator HOST:PORT, --process I and "
            "--processes N, or start with srun or mpirun, which provide them."
        )
    if not 0 <= process < processes:
        raise ValueError(
            f"--process {process} is out of range for {processes} processes; number them from "
            f"0 to {processes - 1}."
        )
    address = options.coordinator or environment.get("JAX_COORDINATOR_ADDRESS")
    if address is not None:
        _host_and_port(address)
    elif detected is None or any(name not in environment for name in _LAUNCHERS[launcher][2]):
        source = f"{launcher} does not provide it" if detected else "no launcher provides it"
        raise ValueError(
            f"--coordinator is missing, and {source}: give all processes --coordinator "
            "HOST:PORT, the machine of process 0 and a free port of it."
        )
    return Launch(process, processes, address)


def _detect(environment: Mapping[str, str]) -> tuple[str, Launch | None]:
    """The launcher and its launch, from the environment."""
    for launcher, (number, this, _) in _LAUNCHERS.items():
        with contextlib.suppress(KeyError, ValueError):
            return launcher, Launch(int(environment[this]), int(environment[number]))
    return "", None


def _host_and_port(address: str) -> tuple[str, int]:
    host, _, port = address.rpartition(":")
    if not host or not port.isdigit() or not 0 < int(port) < 65536:
        raise ValueError(f"--coordinator {address!r} must be HOST:PORT, such as node1:12345.")
    return host.strip("[]"), int(port)


@dataclass(frozen=True)
class ProcessGroup:
    """The processes and devices of a run."""

    process: int = 0  # process, processes: number of this process, and of processes
    processes: int = 1
    mesh: Mesh | None = None  # of devices, on one axis; None for JAX's default device

    @property
    def is_first(self) -> bool:
        """True if this process writes and prints."""
        return self.process == 0

    @property
    def num_devices(self) -> int:
        return 1 if self.mesh is None else self.mesh.size

    def exchanged(self, text: str) -> list[str]:
        """All-gather of a text: the texts of all processes."""
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

    @contextlib.contextmanager
    def together(self) -> Iterator[None]:
        """Work that each process does; an expected error of any of them ends all."""
        if self.processes == 1:
            yield
            return
        message = ""
        try:
            yield
        except (ValueError, OSError) as error:
            message = str(error) or type(error).__name__
        every = self.exchanged(message)
        if any(every[: self.process]) or (any(every) and not message):
            raise SystemExit(2)
        if message:
            text = message if len(set(every)) == 1 else f"process {self.process}: {message}"
            raise ValueError(text) from None

    def agree(self, values: Mapping[str, object]) -> None:
        """Checks that all processes have the same values by name."""
        every = [json.loads(x) for x in self.exchanged(json.dumps(dict(values), default=str))]
        for process, other in enumerate(every):
            for name in {**every[0], **other}:
                one, two = (x.get(name, "nothing") for x in (every[0], other))
                if one != two:
                    raise _found_by_all(
                        self.process,
                        f"process {process} has {name} {two}, and process 0 {one}; start all "
                        "processes with the same arguments, files and versions.",
                    )

    def sees(self, name: str, here: bool) -> bool:
        """True if a file is present, which must be the same in all processes."""
        every = self.exchanged(str(here))
        if len(set(every)) > 1:
            raise _found_by_all(
                self.process,
                f"process {every.index('False')} does not see {name}; give --out a directory that "
                "all processes share.",
            )
        return here


def _found_by_all(process: int, text: str) -> ValueError | SystemExit:
    """An error that all processes find, and the first reports."""
    return SystemExit(2) if process else ValueError(text)


@contextlib.contextmanager
def process_group(
    options: DeviceOptions, launch: Launch, say: Callable[[str], None]
) -> Iterator[ProcessGroup]:
    """Joins the processes of a run before any device is used, and leaves them at the end."""
    if options.mesh is None:
        yield ProcessGroup()
        return
    _choose_devices(options, launch)
    if launch.processes == 1:
        group = ProcessGroup(mesh=_mesh(options, launch))
        say(f"on {_devices_of(group)}")
        yield group
        return
    if launch.coordinator is not None:
        _meet(launch, options.wait)
    _read_apart(launch)
    try:
        _join(launch, options.wait)
        group = ProcessGroup(launch.process, launch.processes, _mesh(options, launch))
        say(f"on {_devices_of(group)} of {launch.processes} processes")
        yield group
    except Exception as error:
        if not is_loss(error):
            raise
        from jaxltl.app import distributed_errors  # of several processes alone

        line = f"process {launch.process} stops: another process has ended. {distributed_errors.AGAIN}."
        os.write(2, f"{distributed_errors.END}{line}\n".encode())
        raise SystemExit(LOST) from None
    import jax

    jax.distributed.shutdown()  # when all are done; an early process would count as lost


def _choose_devices(options: DeviceOptions, launch: Launch) -> None:
    """JAX's settings that precede the creation of devices."""
    if options.mesh is not None and options.mesh % launch.processes:
        raise ValueError(
            f"--mesh {options.mesh} cannot be split evenly over {launch.processes} "
            "processes; give a multiple of them."
        )
    import jax

    if launch.processes > 1:
        jax.config.update("jax_cpu_collectives_implementation", "gloo")
        # Its handler of SIGTERM would keep the process alive.
        with contextlib.suppress(AttributeError):
            jax.config.update("jax_enable_preemption_service", False)
    flags = os.environ.get("XLA_FLAGS", "")
    if options.mesh and "xla_force_host_platform_device_count" not in flags:
        with contextlib.suppress(RuntimeError):  # devices exist already
            jax.config.update("jax_num_cpu_devices", options.mesh // launch.processes)


def _mesh(options: DeviceOptions, launch: Launch) -> Mesh:
    """Mesh of an equal number of devices of each process, on one axis."""
    import jax
    import numpy as np
    from jax.sharding import Mesh

    assert options.mesh is not None
    each = [[d for d in jax.devices() if d.process_index == p] for p in range(launch.processes)]
    number = len(each[0])
    other = next((p for p, x in enumerate(each) if len(x) != number), None)
    if other is not None:
        raise _found_by_all(
            launch.process,
            f"process {other} has another number of devices, {len(each[other])}, than "
            f"process 0, {number}; give all processes as many.",
        )
    per = options.mesh // launch.processes if options.mesh else number
    if number < per:
        several = launch.processes > 1
        takes = f" takes {per} devices of each process" if several else ""
        raise _found_by_all(
            launch.process,
            f"--mesh {options.mesh}{takes}: {'each has' if several else 'there are'} {number} "
            f"({jax.default_backend()}); give fewer, or --mesh alone for all.",
        )
    return Mesh(np.array([d for x in each for d in x[:per]]), ("devices",))


def _devices_of(group: ProcessGroup) -> str:
    mesh = group.mesh
    assert mesh is not None
    kind = mesh.devices.flat[0].device_kind
    name = "CPU" if kind == "cpu" else kind
    return f"{mesh.size} {name} device{'s' if mesh.size > 1 else ''}"


# --- joining ----------------------------------------------------------------------------------


def _meet(launch: Launch, wait: float) -> None:
    """Waits for process 0, or checks its port; JAX would end the process without explanation."""
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
        bind = address  # local, so not open to other machines
    later: Record = {"heartbeat_timeout_seconds": seconds, "shutdown_timeout_seconds": _TO_THE_END}
    known = inspect.signature(jax.distributed.initialize).parameters  # depends on JAX's version
    jax.distributed.initialize(
        address,
        launch.processes,
        launch.process,
        initialization_timeout=seconds,
        coordinator_bind_address=bind,
        **{k: v for k, v in later.items() if k in known},
    )


# --- the end ----------------------------------------------------------------------------------


def _read_apart(launch: Launch) -> None:
    """Redirects the runtime's output to a process that explains an early end in one line.

    The runtime writes to the file descriptors and ends at once; Python's streams get others.
    """
    from jaxltl.app import distributed_errors

    out, err = os.dup(1), os.dup(2)
    source, sink = os.pipe()
    subprocess.Popen(
        [sys.executable, "-I", "-S", str(Path(distributed_errors.__file__)), str(launch.process)],
        stdin=source,
        stdout=err,
        stderr=err,
    )
    os.close(source)
    os.dup2(sink, 1)
    os.dup2(sink, 2)
    os.close(sink)
    for name, target in (("stdout", os.devnull if launch.process else out), ("stderr", err)):
        old = getattr(sys, name)
        old.flush()
        by_line = 1 if name == "stderr" or old.line_buffering else -1
        new = open(target, "w", by_line, encoding=old.encoding, errors=old.errors)  # noqa: SIM115
        setattr(sys, name, new)
    with contextlib.suppress(ImportError, ValueError, OSError):  # no core dump
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, resource.getrlimit(resource.RLIMIT_CORE)[1]))


def is_loss(error: Exception) -> bool:
    """True if an error is a lost connection to another process."""
    text = str(error)
    return "Gloo" in text or "coordination" in text.lower() or "NCCL" in text
