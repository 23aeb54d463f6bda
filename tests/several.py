"""A run of several processes that saves its way: started, killed, and what became of it.

As a program: ``several.py WHAT DIRECTORY COORDINATOR PROCESS PROCESSES``; what to do is to learn
to solve, or what solvers are held to.
"""

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

ROOT = Path(__file__).parent.parent
STEPS, LANES = 4000, 4


class Ended(NamedTuple):
    """How a process ended, and what it printed."""

    status: int
    out: str
    err: str

    @property
    def errors(self) -> list[str]:
        return [line for line in self.err.splitlines() if "error" in line.lower()]


def free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


def start(number: int, *command: str, places: bool = True) -> list[subprocess.Popen]:
    """Processes 0 to `number` - 1 of a command, each with a group of its own.

    With `places` the command ends with where they meet, which it is, and of how many; else these
    are the options of the command line.
    """
    address, found = f"127.0.0.1:{free_port()}", []
    for i in range(number):
        names = ("--coordinator", "--process", "--processes")
        values = (address, str(i), str(number))
        more = values if places else [x for pair in zip(names, values, strict=True) for x in pair]
        found.append(
            subprocess.Popen(
                [sys.executable, *command, *more],
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
                cwd=ROOT,
                start_new_session=True,
                env={**os.environ, "PYTHONPATH": str(ROOT)},
            )
        )
    return found


def start_run(number: int, directory: Path, what: str = "learn") -> list[subprocess.Popen]:
    return start(number, str(Path(__file__)), what, str(directory))


def ended(processes: list[subprocess.Popen], seconds: float) -> list[Ended]:
    """When all have ended; whatever happens, nothing of them stays behind."""
    try:
        return [
            Ended(p.returncode, *texts)
            for p, texts in [(p, p.communicate(timeout=seconds)) for p in processes]
        ]
    finally:
        for process in processes:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()


# --- the program ------------------------------------------------------------------------------


def main(what: str, directory: Path, coordinator: str, process: int, processes: int) -> None:
    from jaxltl.app.processes import DeviceOptions, launched, process_group

    asked = DeviceOptions(0, coordinator, process, processes, wait=15)
    with process_group(asked, launched(asked, {}), print) as place:
        {"learn": run, "solve": solve, "laws": laws}[what](directory, place)


def problem_and_state() -> tuple[Any, Any, Any]:
    """A toy: what is to be approached, by steps that draw, and the first states of the lanes."""
    import jax
    import jax.numpy as jnp

    from jaxltl.core import struct

    @struct.dataclass
    class State:
        position: Any
        step: Any
        key: Any

    @struct.dataclass
    class Metrics:
        distance: Any

    def step(state: State, goal: Any, rate: Any) -> tuple[State, Metrics]:
        noise = jax.random.normal(jax.random.fold_in(state.key, state.step), goal.shape)
        position = state.position + rate * (goal - state.position) + 0.01 * noise
        return (State(position, state.step + 1, state.key), Metrics(jnp.abs(goal - position).max()))

    keys = jax.random.split(jax.random.key(0), LANES)
    states = State(jnp.zeros((LANES, 3)), jnp.zeros(LANES, jnp.int32), keys)
    return step, states, jnp.arange(3.0)


def run(directory: Path, place: Any) -> None:
    """Steps of the lanes, saved after every 50, and what comes out, printed by the first."""
    from jaxltl.algos.common.chunks import ChunkOptions, run_in_chunks
    from jaxltl.core.models.mesh.lanes import on_host

    step, states, goal = problem_and_state()
    path = directory / "run.npz"
    begun = place.sees(str(path), path.exists())
    made: list[int] = []
    found = run_in_chunks(
        step,
        states,
        goal,
        0.01,
        num_steps=STEPS,
        options=ChunkOptions(
            lanes=True,
            chunk=50,
            checkpoint=path,
            mesh=place.mesh,
            report=lambda done, _: made.append(done),
        ),
    )
    state = on_host(found.state)
    if place.is_first:
        print(f"went on: {begun and (not made or made[0] > 50)}")
        print(f"rows: {len(found.step)}")
        print(f"ended: {state.position.tobytes().hex()}")


def walk(size: int = 11) -> Any:
    """A walk between ruin and what is won, from 0.4 of the way: sure numbers take many sweeps."""
    from jaxltl.core.models.sparse import make_sparse

    ends = [[s] if s in (0, size - 1) else [s - 1, s + 1] for s in range(size)]
    return make_sparse(
        None,
        np.cumsum([0] + [len(x) for x in ends]),
        [t for x in ends for t in x],
        [1 / len(x) for x in ends for _ in x],
        initial=np.eye(size)[2 * (size // 5)],
        label={"win": [size - 1]},
    )


def solve(directory: Path, place: Any) -> None:
    """The probability of winning, with bounds that are saved again and again."""
    import jax

    from jaxltl.app import solve_on_mesh
    from jaxltl.io.prism.properties import parse_queries

    made: list[int] = []
    save = solve_on_mesh.files.save

    def noted(path: Path, state: Any, given: Any) -> None:
        save(path, state, given)
        made.append(int(state["made"]))

    solve_on_mesh.steps_between = lambda model: 16
    solve_on_mesh.files.save = noted  # type: ignore[assignment]
    text = 'Pmax=? [ F "win" ]'
    with jax.enable_x64(True):
        model = solve_on_mesh.on_mesh(walk(), place)
        solver = solve_on_mesh.MeshSolver(place, model, {}, 1e-6, directory)
        solver.agree([text])
        (found,) = solver.solve(parse_queries([text]))
    if place.is_first:
        print(f"went on: {bool(made) and made[0] > 16}")
        print(f"saved: {len(made)}")
        print(
            f"ended: {found.answer.lower.tobytes().hex()}, {found.answer.upper.tobytes().hex()}, "
            f"{found.answer.status.name}, {found.answer.value[0]!r}"
        )


def laws(directory: Path, place: Any) -> None:
    """What solvers find over the devices of all processes, as lines of JSON."""
    import jax

    from jaxltl.core.logic.properties import parse_property
    from jaxltl.core.models.mesh.lanes import on_host
    from jaxltl.core.models.mesh.shard import from_mesh, shard
    from jaxltl.core.values.discounted.discounted import optimal_value
    from jaxltl.core.values.discounted.soft import soft_value
    from jaxltl.core.values.properties.solve_on_mesh import first_bounds, question_on_mesh
    from tests.core.values.properties.test_solve_on_mesh import PROPERTIES, gambler

    with jax.enable_x64(True):
        model = shard(gambler(), place.mesh)
        for text in PROPERTIES:
            question = question_on_mesh(model, parse_property(text))
            found = question.advance(
                first_bounds(model, question), question.tolerance(1e-6), 10_000
            )
            there = question.answer(found, 1e-6)
            told = {
                "property": text,
                "lower": there.lower.tolist(),
                "upper": there.upper.tolist(),
                "holds": there.holds,
                "status": there.status.name,
            }
            if place.is_first:
                print(json.dumps(told), flush=True)
        for name, solve in (("optimal", optimal_value), ("soft", soft_value)):
            found = jax.jit(lambda x, solve=solve: solve(x, x.rewards["games"], 0.9))(model)
            told = {
                "property": name,
                "value": from_mesh(model, found.value).tolist(),
                "status": int(on_host(found.status)),
            }
            if place.is_first:
                print(json.dumps(told), flush=True)


if __name__ == "__main__":
    from tests.several import main as of_that_name  # by which what is saved knows its functions

    where, number, of = sys.argv[3], int(sys.argv[4]), int(sys.argv[5])
    try:
        of_that_name(sys.argv[1], Path(sys.argv[2]), where, number, of)
    except ValueError as error:  # as the command line tells it
        sys.exit(f"error: {error}")
    except SystemExit as stop:
        os._exit(int(stop.code or 0))
    sys.stdout.flush()
    os._exit(0)
