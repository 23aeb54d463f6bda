"""The command line: learning, synthesis, model checking, automata, published figures.

Heavy modules are imported inside the commands, so that their first line is printed at once.
"""

from __future__ import annotations

import contextlib
import importlib
import inspect
import json
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import click

import jaxltl
from jaxltl.app import compilation, processes, run_job
from jaxltl.app.command_options import (
    PATH as _PATH,
    CertifyOptions,
    DeviceOptions,
    Failure,
    RunOptions,
    SolveOptions,
    compiling,
    options as with_options,
    plain_errors,
    write_proofs,
)
from jaxltl.app.compilation import float64
from jaxltl.plot.drawing import artist
from jaxltl.app.wording import Record

if TYPE_CHECKING:
    from jaxltl.core.automata.automaton import Automaton

_task_file = click.argument("task_file", metavar="TASK.toml", type=_PATH)
_out = click.option("--out", type=_PATH, help="Directory for the results.  [default: out/NAME]")
_as_json = click.option(
    "--json", "as_json", is_flag=True, help="End with the result as one JSON line."
)


def _begin(text: str, process: int = 0) -> Callable[[str], None]:
    """Prints the first line, before slow imports, and returns the function that prints others.

    Both print to standard error, and nothing in other processes than the first.
    """

    def say(line: str) -> None:
        if process == 0:
            click.echo(line, err=True)

    say(f"jaxltl {jaxltl.__version__}: {text}")
    return say


def _print_json(result: object) -> None:
    click.echo(json.dumps(result, allow_nan=False))


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(jaxltl.__version__, prog_name="jaxltl")
def main() -> None:
    """Policies with certified guarantees for temporal-logic tasks."""


@main.command()
@_task_file
@with_options(RunOptions, "options")
@_as_json
@with_options(DeviceOptions, "devices")
@compiling(fast=True)
@plain_errors
def learn(task_file: Path, options: RunOptions, as_json: bool, devices: DeviceOptions) -> None:
    """Learn a policy for a formula, and certify its satisfaction probability.

    Writes policy.npz, result.json, report.html and pictures; with method = "todirl", the learned
    network.npz and the policies of the training worlds. With an environment in [world], a policy
    network is learned in simulated episodes and evaluated by fresh ones. An interrupted run
    resumes when it is started again with the same task and options.

    With --mesh the seeds are distributed over devices, also over those of several processes, each
    of which is started with the same arguments; see docs/devices.md.
    """
    launch = processes.launched(devices)
    say = _begin(f"learning from {task_file}", launch.process)
    # No subprocesses of several processes: they could outlive them.
    apart = compilation.is_fresh() and launch.processes == 1
    # First, so that matplotlib is imported in the background.
    with artist(apart=apart) as begin, processes.process_group(devices, launch, say) as group:
        console = run_job.Console(begin, say, group)
        finished = run_job.learn(task_file, options, console)
    if finished is None:
        return
    done = finished.before
    click.echo(finished.table)
    click.echo(
        f"\n{'finished before: see' if done else 'wrote'} {finished.out}/report.html and the files "
        f"beside it{'; --again repeats it' if done else ''}"
    )
    if as_json:
        _print_json(finished.result)


@main.command()
@_task_file
@compiling(fast=True)
@plain_errors
def check(task_file: Path) -> None:
    """Check a task or game file and the files that it names, without learning."""
    _begin(f"checking {task_file}")
    from jaxltl.app.files.schema import read_toml

    if "game" in read_toml(task_file, "the file")[0]:
        from jaxltl.app.files import game

        file = game.GameFile.read(task_file)
        world = game.load_game(file)
        play, _ = game.load_objective(file, world)
        click.echo(f"ok: {world.game.num_states} states, {play.num_states} in the product")
        return
    click.echo(f"ok: {run_job.check(task_file)}")


@main.command()
@click.argument("game_file", metavar="GAME.toml", type=_PATH)
@_out
@click.option(
    "--environment",
    nargs=2,
    type=int,
    metavar="ROW COLUMN",
    help="The cell of the environment's robot in moves.svg, from 1.  "
    "[default: the cell where the strategy forbids most moves]",
)
@click.option("--again", is_flag=True, help="Overwrite the result of another game.")
@_as_json
@compiling(fast=True)
@plain_errors
def synthesize(
    game_file: Path,
    out: Path | None,
    environment: tuple[int, int] | None,
    again: bool,
    as_json: bool,
) -> None:
    """Solve a game: winning region, permissive strategy, and counter-strategy.

    Prints the winning region, a permissive strategy of the system, with which any choice among its
    moves wins, the result of an independent check, and a play that the environment wins, if there
    is one. Writes strategy.npz, counter_strategy.npz, result.json, report.html and pictures.

    The exit status is 0 for either winner; 2 for errors, and for a task that is unrealizable from
    every initial state if the file demands a strategy by a table [strategy].
    """
    begin = time.perf_counter()
    _begin(f"solving {game_file}")
    from jaxltl.app.files.game import GameFile, solve_game
    from jaxltl.app.reports import synthesize as report
    from jaxltl.core.games.synthesis import STAGES

    file = GameFile.read(game_file)
    out = run_job.directory(out, file.name)
    with contextlib.ExitStack() as held:
        # Before the work, since the directory may not be writable.
        held.enter_context(run_job.claimed(out, "game.toml", game_file.read_bytes(), again))
        held.enter_context(float64())
        bar = held.enter_context(run_job.progress_bar(len(STAGES), visible=sys.stderr.isatty()))

        def progress(stage: str) -> None:
            bar.set_description_str(stage, refresh=False)
            bar.update(STAGES.index(stage) - bar.n)

        solved = solve_game(file, progress)
        place = report.place_of(solved, environment)
        progress("writing")
        written = report.write(solved, out, place, time.perf_counter() - begin)
    click.echo(report.report_of(solved).table(written, out))
    click.echo(f"\nwrote {out}/result.json and the files beside it")
    if as_json:
        _print_json(written)
    if not report.is_confirmed(written):
        raise Failure(
            "the independent check refutes the result, which is a bug of jaxltl; "
            "please report it with the game file."
        )
    solved.demand()


@main.command()
@click.argument("formulas", metavar="FORMULA...", nargs=-1)
@click.option(
    "-F",
    "--file",
    "source",
    metavar="FILE",
    help="Read one formula a line from a file; - is standard input.",
)
@click.option(
    "--to",
    "form",
    default="text",
    show_default=True,
    type=click.Choice(["text", "dot", "svg", "json", "hoa"]),
)
@click.option(
    "--acceptance",
    default="auto",
    show_default=True,
    type=click.Choice(["auto", "dfa", "buchi", "parity"]),
    help="Acceptance condition; auto takes the simplest one of the language.",
)
@plain_errors
def automaton(
    formulas: tuple[str, ...],
    source: str | None,
    form: str,
    acceptance: Literal["auto", "dfa", "buchi", "parity"],
) -> None:
    """Translate formulas to small deterministic automata, in order.

    Any formula of linear temporal logic, in the syntax that Spot reads:
    ! & | -> <-> xor X F G U R W M, true, false, and propositions.

    Acceptance is by final states where a finite prefix decides (dfa), else by accepting
    transitions met for ever (buchi) where that is possible, else by min-even parity.
    """
    from jaxltl.core.automata.translate import to_automaton

    numbered = [("", f) for f in formulas] + _formula_lines(source)
    if not numbered:
        raise click.UsageError("give at least one formula, or a file of them with -F.")
    for i, (where, formula) in enumerate(numbered):
        try:
            result = to_automaton(formula, acceptance=acceptance)
        except ValueError as error:
            raise ValueError(f"{where}{error}") from None
        if i and form == "text":
            click.echo()
        click.echo(_render(result, form, formula))


def _formula_lines(source: str | None) -> list[tuple[str, str]]:
    """The non-empty lines of a file, each with the place to name in an error."""
    if source is None:
        return []
    text = sys.stdin.read() if source == "-" else Path(source).read_text()
    name = "standard input" if source == "-" else source
    return [
        (f"{name}, line {i}: ", line.strip())
        for i, line in enumerate(text.splitlines(), start=1)
        if line.strip()
    ]


def _render(result: Automaton, form: str, formula: str) -> str:
    from jaxltl.core.automata.text import to_dict, to_dot, to_text

    if form in ("text", "dot"):
        return to_text(result) if form == "text" else to_dot(result)
    if form == "json":
        return json.dumps(to_dict(result))
    if form == "hoa":
        from jaxltl.io.hoa.hoa import write_hoa

        return write_hoa(result, name=formula).removesuffix("\n")
    program = shutil.which("dot")
    if program is not None:
        with contextlib.suppress(OSError, subprocess.CalledProcessError):
            drawn = subprocess.run(
                [program, "-Tsvg"], input=to_dot(result).encode(), capture_output=True, check=True
            )
            return drawn.stdout.decode()
    from jaxltl import plot

    return plot.to_bytes(plot.automaton(result), "svg").decode()


@main.command()
@click.argument("model_file", metavar="MODEL", type=_PATH)
@click.argument("properties", metavar="PROPERTY...", nargs=-1, required=True)
@with_options(SolveOptions, "options")
@with_options(DeviceOptions, "devices")
@plain_errors
def solve(
    model_file: Path, properties: tuple[str, ...], options: SolveOptions, devices: DeviceOptions
) -> None:
    """Solve properties of a model, or of a program in the PRISM language, with certified bounds.

    A PROPERTY is written as for PRISM and Storm, such as 'Pmax=? [ F "goal" ]',
    'R{"time"}min=? [ C<=10 ]', 'P>=0.9 [ G !"crash" ]', or any formula of linear temporal logic in
    P; or it is a file of properties that ends in .props, .prop or .pctl. See docs/solve.md.

    Values are those of the initial states; of several properties a line each is repeated at the end.
    The exit status is 0 if all properties are solved, 1 if some value did not converge or some
    threshold is undecided, 2 if one was refused, and for other errors of usage. All are tried.

    With --mesh the model is distributed over devices, also over those of several processes, each of
    which is started with the same arguments; see docs/devices.md.
    """
    launch = processes.launched(devices)
    say = _begin(f"solving {model_file}", launch.process)
    options.check(devices.mesh)
    if devices.mesh is not None:
        compilation.use_cache(True)
    from jaxltl.app import solve as solving

    program, questions = solving.read_queries(model_file, options.const, properties)
    if program is not None and devices.mesh is not None:
        raise ValueError(f"--mesh takes built models; {model_file} is a program.")
    strategy, certificate = options.strategy, options.certificate
    how = {name: getattr(options, name) for name in ("relative", "exact", "fair")}
    partial = options.method == "partial"
    if partial and (not program or strategy or certificate or any(how.values())):
        others = "--strategy, --relative, --exact, --fair and --certificate"
        raise ValueError(f"--method partial is for programs, without {others}.")
    from jaxltl.core.files import atomic_write

    # Before the work, since the directory may not be writable.
    written = contextlib.nullcontext() if strategy is None else atomic_write(strategy)
    double = contextlib.nullcontext if devices.mesh is None else float64
    with written as file, processes.process_group(devices, launch, say) as group, double():
        if program is not None and partial:
            entry: Record = {"kind": program.kind}
            answers = solving.solve(program, questions, options.tolerance, options.max_states)
        elif group.mesh is None:
            begin = time.perf_counter()
            model = solving.load(model_file, program, options.max_states)
            entry = solving.model_entry(model, time.perf_counter() - begin)
            answers = solving.solve(model, questions, options.tolerance, **how)
        else:
            from jaxltl.app import solve_on_mesh

            sharded, fingerprint, entry = solve_on_mesh.read(model_file, questions, group)
            solver = solve_on_mesh.MeshSolver(
                group, sharded, fingerprint, options.tolerance, options.checkpoint
            )
            solver.agree(list(properties))
            answers = solver.solve(questions)
        if group.is_first and "states" in entry:
            sizes = "{states} states, {choices} choices, {transitions} transitions"
            click.echo(f"{{kind}} of {sizes}, read in {{seconds:.3f}} s".format(**entry))
        results = []
        for result in answers:
            results.append(result)
            if group.is_first:
                click.echo(f"\n{solving.text(result)}")
        if file is not None:
            file.write(solving.strategies(model, results, model_file))
        proofs: Record = {}
        if certificate is not None:
            click.echo()
            answered = [solving.certifiable(model, result) for result in results]
            proofs = {"certificates": write_proofs(certificate, answered)}
    if options.as_json and group.is_first:
        entries = [solving.result_entry(r) for r in results]
        _print_json({"model": entry, "results": entries, **proofs})
    elif group.is_first and len(results) > 1:
        click.echo(f"\n{solving.summary(results)}")
    if status := max(result.exit_status for result in results):
        raise SystemExit(status)


@main.command()
@click.argument("log", metavar="LOG|POLICY", type=_PATH)
@click.argument("formula", required=False)
@with_options(CertifyOptions, "options")
@_as_json
@plain_errors
def certify(log: Path, formula: str | None, options: CertifyOptions, as_json: bool) -> None:
    """Learn a policy from logged transitions, with a guaranteed satisfaction probability.

    LOG is a table with the columns state, action and next; see docs/data.md. POLICY is a policy.npz
    that `jaxltl learn` wrote in a continuous world of make_dynamics, for which FORMULA, by default
    that of its task, is proven; see docs/continuous-proofs.md. The exit status is 1 if the bounds did
    not converge, 2 for errors of usage.
    """
    say = _begin(f"certifying {formula or 'the task'} from {log}")
    if log.suffix == ".npz":
        if replace(options, method="anytime") != CertifyOptions():
            raise ValueError("a POLICY takes no options of logs; give a formula and --json alone.")
        from jaxltl.app.learn_environment import certify_policy_file
        from jaxltl.app.reports.learn_environment import proof_entry, proof_sentence

        result = proof_entry(certify_policy_file(log, formula, say))
        click.echo(f"{result['formula']}\n{proof_sentence(result)}")
    elif formula is None or options.confidence is None:
        missing = "FORMULA" if formula is None else "--confidence, such as 0.95"
        raise ValueError(f"a LOG needs {missing}.")
    else:
        from jaxltl.app.certify import certify_and_write

        result = certify_and_write(log, formula, options)
    if as_json:
        _print_json(result)
    if result["status"] != "CONVERGED":
        raise SystemExit(1)


_EXPERIMENTS = {
    "mlirl": "section 2.5, inverse reinforcement learning with a temporal-logic task",
    "todirl": "section 3.5, reward networks that transfer to new worlds",
    "synthesis": "chapter 5, permissive strategies, and learning under them",
    "pac": "section 6.7, PAC learning under almost-sure winning strategies",
    "cce": "section 4.5, constrained cross-entropy search, with TRPO and CPO",
}


@main.command()
@click.argument("certificate", metavar="FILE", type=_PATH)
def verify(certificate: Path) -> None:
    """Check a certificate by exact arithmetic, independently of all solvers.

    The same as python jaxltl/checker.py FILE, which runs without the package. The exit status is 0 if
    the certificate is accepted, 1 if a condition does not hold, 2 if the file is no certificate, 3 if
    all but the automaton is proven. See docs/certificates.md.
    """
    from jaxltl import checker

    raise SystemExit(checker.main([str(certificate)]))


@main.command(epilog="\n\n".join(f"{k}: {v}." for k, v in _EXPERIMENTS.items()))
@click.argument("experiment", type=click.Choice(list(_EXPERIMENTS)))
@click.option("--out", type=_PATH, help="Directory of the pictures. [default: out/reproduce]")
@click.option(
    "--seeds",
    type=click.IntRange(1),
    help="Number of seeds, in todirl, pac and cce.  [default: 10; in cce "
    "50 for the regulator, 5 for the robot]",
)
@_as_json
@compiling(fast=False)
@plain_errors
def reproduce(experiment: str, out: Path | None, seeds: int | None, as_json: bool) -> None:
    """Print published and measured numbers side by side."""
    say = _begin(f"reproducing {experiment}")
    module = importlib.import_module(f"jaxltl.reproduce.{experiment}")
    options = {} if seeds is None else {"seeds": seeds}
    if seeds is not None and "seeds" not in inspect.signature(module.measure).parameters:
        raise ValueError(f"reproduce {experiment} has no seeds; leave --seeds out.")
    with float64():
        result = module.measure(say, **options)
        pictures = module.pictures(result) if hasattr(module, "pictures") else {}
    click.echo(module.table(result))
    if pictures:
        out = run_job.make_directory(out or Path("out") / "reproduce")
        from jaxltl import plot

        files = {f"{name}.svg": plot.to_bytes(figure) for name, figure in pictures.items()}
        run_job.write_files(out, files.items())
        click.echo(f"\nwrote {', '.join(files)} to {out}")
    if as_json:
        _print_json(result)
