"""Environments and learners of task files: the set-up of reinforcement learning by simulation."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
import importlib.util
import inspect
import math
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import chex
import jax
import jax.numpy as jnp
from jax.tree_util import Partial

from jaxltl.algos import cce, ppo, trust_region
from jaxltl.algos.cce.exponential_family import diagonal_gaussian
from jaxltl.algos.common.actor_critic import default_network
from jaxltl.algos.common.schedules import Linear
from jaxltl.algos.common.seeds import Algorithm, make_hparams
from jaxltl.app.files.task_environment import CceTable, CpoTable, EnvironmentFile
from jaxltl.app.wording import Record
from jaxltl.core.continuous.dynamics import Dynamics
from jaxltl.core.environments import Agent, Box, Finite, Timestep, Verdict
from jaxltl.core.environments.environment import Environment, make_environment, require_environment
from jaxltl.core.environments.episodes import with_time_limit
from jaxltl.core.models.protocols import PyTree
from jaxltl.core.validation import errors_in
from jaxltl.core.values.evaluation.evaluation import episode_evaluator
from jaxltl.envs.continuous_worlds import BenchmarkWorld
from jaxltl.envs.networks import make_network, network_agent

BUILT_IN = {
    "flat_world": "jaxltl.envs.flat_world:flat_world",
    "letter_world": "jaxltl.envs.letter_world:letter_world",
    "zone_world": "jaxltl.envs.zone_world:zone_world",
}
# By package, the module and function that make the argument of its adapter.
PACKAGES = {
    "brax": ("brax.envs", "get_environment"),
    "craftax": ("craftax.craftax_env", "make_craftax_env_from_name"),
    "gymnax": ("gymnax", "make"),
    "jumanji": ("jumanji", "make"),
    "navix": ("navix", "make"),
    "xminigrid": ("xminigrid", "make"),
}


def load_environment(
    task: EnvironmentFile, world: Environment | Dynamics | None = None
) -> Environment:
    """The environment of a task file, with its labels and its horizon."""
    world, table = load_world(task) if world is None else world, task.world
    with errors_in(f"{task.path}: [world] "):
        world = require_environment(world)
        return world if table.horizon is None else with_time_limit(world, table.horizon)


def load_world(task: EnvironmentFile) -> Environment | Dynamics:
    """The environment or the dynamics of a task file, with its labels."""
    table, folder = task.world, task.path.parent
    if table.dynamics is not None:
        with errors_in(f"{task.path}: [world] dynamics: "):
            return _made_dynamics(table.dynamics, table.arguments, folder)
    with errors_in(f"{task.path}: [world] labels: "):
        labels = None if table.labels is None else _function(table.labels, folder)
    with errors_in(f"{task.path}: [world] environment: "):
        names = table.propositions or []
        return _made(table.environment or "", table.arguments, folder, labels, names)


def _made_dynamics(name: str, arguments: Mapping[str, object], folder: Path) -> Dynamics:
    """The dynamics that a user's function returns."""
    value = _called(name, _function(name, folder), arguments)
    if isinstance(value, BenchmarkWorld):
        return value.dynamics
    if isinstance(value, Dynamics):
        return value
    raise ValueError(
        f"{name!r} returns a {type(value).__name__}, no dynamics; let it return those of "
        "make_dynamics, or write environment = for one that is only simulated."
    )


def _called(name: str, function: Callable[..., object], arguments: Mapping[str, object]) -> object:
    """The result of a user's function."""
    try:
        inspect.signature(function).bind(**arguments)
    except TypeError as problem:
        raise ValueError(f"{name!r} does not take [world.arguments]: {problem}.") from None
    with _user_errors(name):
        return function(**arguments)


def _made(
    name: str,
    arguments: Mapping[str, object],
    folder: Path,
    labels: Callable[..., Any] | None,
    propositions: list[str],
) -> Environment:
    root, _, rest = name.partition(":")
    if root in PACKAGES and rest:
        return _of_package(root, rest, arguments, labels, propositions)
    environment = _called(name, _function(BUILT_IN.get(name, name), folder), arguments)
    if isinstance(environment, Dynamics):
        raise ValueError(f"{name!r} returns dynamics; write dynamics = {name!r} for them.")
    if not isinstance(environment, Environment):
        raise ValueError(
            f"{name!r} returns a {type(environment).__name__}, no Environment; let it return one of "
            "make_environment, or of an adapter such as from_gymnax."
        )
    if labels is None:
        return environment
    with _user_errors("labels"):
        names = ["actions", "allowed", "observations", "horizon", "starts", "outcomes", "ending"]
        return make_environment(
            *(environment.reset, environment.step, environment.observe),
            **{name: getattr(environment, name) for name in names},
            labels=labels,
            propositions=propositions,
        )


def _of_package(
    root: str,
    name: str,
    arguments: Mapping[str, object],
    labels: Callable[..., Any] | None,
    propositions: list[str],
) -> Environment:
    """An environment of another package, by its adapter."""
    module, function = PACKAGES[root]
    try:
        make = getattr(importlib.import_module(module), function)
    except ImportError as problem:
        raise ValueError(
            f'needs the package {root} ({problem}); pip install "jaxltl[{root}]".'
        ) from None
    extra = {"auto_reset": False} if root == "craftax" else {}
    adapter = getattr(importlib.import_module("jaxltl.envs"), f"from_{root}")
    ours = {x: arguments[x] for x in inspect.getfullargspec(adapter).kwonlyargs if x in arguments}
    with _user_errors(f"{root}:{name}"):
        value = make(name, **extra, **{k: v for k, v in arguments.items() if k not in ours})
        pair = value if isinstance(value, tuple) else (value,)
        return adapter(*pair, **ours | {"labels": labels, "propositions": propositions})


def _function(name: str, folder: Path) -> Callable[..., Any]:
    """The function of a name ``"package.module:function"`` or ``"file.py:function"``."""
    place, _, attribute = name.rpartition(":")
    if not place or not attribute.isidentifier():
        known = ", ".join((*BUILT_IN, *(f"{p}:NAME" for p in PACKAGES)))
        raise ValueError(
            f'{name!r} names no function; write "package.module:function", "file.py:function" '
            f"for a file beside the task file, or one of {known}."
        )
    module = _module_of_file(folder / place) if place.endswith(".py") else _module(place)
    value = getattr(module, attribute, None)
    if not callable(value):
        there = [
            n
            for n, x in vars(module).items()
            if callable(x)
            and not n.startswith("_")
            and getattr(x, "__module__", None) == module.__name__
        ]
        is_ = "is no function" if hasattr(module, attribute) else "is not there"
        raise ValueError(
            f"{attribute!r} {is_} in {place!r}; its functions are {', '.join(there) or '(none)'}."
        )
    return value


def _module(name: str) -> ModuleType:
    if not all(part.isidentifier() for part in name.split(".")):
        raise ValueError(
            f"{name!r} is neither the name of a module, package.module, nor that of a file, "
            "file.py."
        )
    try:
        return importlib.import_module(name)
    except ImportError as problem:
        missing = getattr(problem, "name", None) or ""
        if name != missing and not name.startswith(f"{missing}."):
            raise ValueError(f"{name!r} cannot be imported: {problem}.") from None
        raise ValueError(
            f"there is no module {name!r}: {problem}. Install its package, or name a file beside "
            'the task file, "file.py:function".'
        ) from None
    except (Exception, SystemExit) as problem:
        raise ValueError(_error_line(name, problem)) from problem


def _module_of_file(path: Path) -> ModuleType:
    """Imports a file, with its directory on the module path."""
    if not path.is_file():
        raise ValueError(f"there is no file {str(path)!r}.")
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.path.insert(0, str(path.parent.absolute()))
    before = sys.modules.get(path.stem)
    sys.modules[path.stem] = module  # needed by dataclasses
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as problem:
        raise ValueError(_error_line(path.name, problem)) from problem
    finally:
        sys.path.pop(0)
        if before is not None:
            sys.modules[path.stem] = before
    return module


@contextlib.contextmanager
def _user_errors(name: str) -> Iterator[None]:
    """Reports errors of a user's function in one line."""
    try:
        yield
    except (Exception, SystemExit) as problem:
        raise ValueError(_error_line(name, problem)) from problem


def _error_line(name: str, problem: BaseException) -> str:
    """The first line of an error, with its place in the user's code."""
    text = (str(problem).strip().splitlines() or [""])[0].rstrip(".: ")
    if isinstance(problem, ValueError) and text:
        return f"{name!r}: {text}."
    places = traceback.extract_tb(problem.__traceback__)
    # A SyntaxError names its own place.
    where = (
        ""
        if isinstance(problem, SyntaxError) or not places
        else (f" ({Path(places[-1].filename).name}, line {places[-1].lineno})")
    )
    return f"{name!r} raises {type(problem).__name__}{': ' if text else ''}{text}{where}."


# --- learners --------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class LearnerSetup:
    """A learner with its problem and hyperparameters."""

    algorithm: Algorithm  # its module
    problem: PyTree  # with `hparams`, arguments of its functions
    hparams: PyTree
    agent: Callable[[PyTree, bool], Agent]  # (state, likeliest) -> Agent, the policy of a state
    drawn: tuple[str, ...]  # names of the metrics that are drawn
    policy_fields: tuple[str, ...]  # names of the state's fields that determine a policy
    transitions: int  # bound of the environment's steps in a step of the learner
    description: str  # of the policy


def make_method(task: EnvironmentFile, environment: Environment, num_steps: int) -> LearnerSetup:
    """The learner of a task file."""
    make = {"ppo": _ppo, "cce": _cce, "cpo": _cpo}[task.learner.method]
    method = make(task, environment, num_steps)
    if method.transitions > _LARGEST_COUNT:
        raise ValueError(
            f"a step of the learner would make {method.transitions:,} simulated steps; at most "
            f"{_LARGEST_COUNT:,} are counted: simulate fewer or shorter episodes."
        )
    # With concrete numbers, so that the learner's own checks see them.
    jax.eval_shape(
        lambda key: method.algorithm.init(key, method.problem, method.hparams), jax.random.key(0)
    )
    return method


_LARGEST_COUNT = 2**31 - 1  # int32 counters of the learners


def _settings(task: EnvironmentFile) -> Record:
    """The method's keys, with pairs of numbers as schedules and lists as tuples."""
    steps = task.learner.steps
    hparams = task.settings.specified()
    for name, value in hparams.items():
        if isinstance(value, tuple):
            hparams[name] = Linear(first=value[0], last=value[1], num_steps=steps)
        elif isinstance(value, list):
            hparams[name] = tuple(value)
    return hparams


def _acts(learner: Any, problem: PyTree, hparams: PyTree) -> Callable[[PyTree, bool], Agent]:
    """The policy of a state of a learner: greedy, or with drawn actions."""
    return lambda state, likeliest: (learner.greedy if likeliest else learner.policy)(
        state, problem, hparams
    )


def _ppo(task: EnvironmentFile, environment: Environment, num_steps: int) -> LearnerSetup:
    spec = _settings(task)
    parts = {k: spec[k] for k in ("hidden", "activation", "initial_deviation") if k in spec}
    network = dataclasses.replace(default_network(environment.actions), **parts)
    problem = ppo.make_problem(environment, network=network)
    hparams = make_hparams(ppo.Hparams, spec)
    return LearnerSetup(
        ppo,
        problem,
        hparams,
        _acts(ppo, problem, hparams),
        ("episode_return", "episode_length", "entropy", "explained_variance"),
        ("parameters", "moments"),
        hparams.num_envs * hparams.num_steps,
        f"two networks with hidden layers {list(network.hidden)}",
    )


def _cce(task: EnvironmentFile, environment: Environment, num_steps: int) -> LearnerSetup:
    table, actions = task.settings, environment.actions
    assert isinstance(table, CceTable)
    outputs = actions.num if isinstance(actions, Finite) else math.prod(actions.shape)
    seen = jax.tree.leaves(environment.observations, is_leaf=lambda x: isinstance(x, Box))
    inputs = sum(math.prod(x.shape) for x in seen)
    network = make_network((inputs, *table.hidden, outputs), hidden=table.activation)
    make = network_agent(network, environment)
    score = episode_evaluator(
        environment,
        make,
        objective=table.objective,
        costs=table.cost or (),
        num_episodes=table.episodes,
        num_steps=num_steps,
    )
    first = diagonal_gaussian(jnp.zeros(network.num_parameters, jnp.float32), table.deviation)
    problem = cce.make_problem(score, first, limit=table.limit)
    hparams = make_hparams(cce.Hparams, _settings(task))
    return LearnerSetup(
        cce,
        problem,
        hparams,
        lambda state, likeliest: make(cce.policy(state, problem, hparams)),
        ("objective", "cost", "best_objective", "num_feasible", "max_deviation"),
        ("family",),
        hparams.population * table.episodes * num_steps,
        f"a network {'-'.join(map(str, network.sizes))} of {network.num_parameters} parameters",
    )


def _cpo(task: EnvironmentFile, environment: Environment, num_steps: int) -> LearnerSetup:
    table = task.settings
    assert isinstance(table, CpoTable) and table.limit is not None
    if not isinstance(environment.actions, Box):
        raise ValueError(
            "the environment has finitely many actions, and this learner needs a box: choose "
            'method = "ppo" or "cce".'
        )
    if table.cost == "violation":
        step = Partial(_costs_where_violated, environment.step)
        environment = dataclasses.replace(environment, step=step, outcomes=None)
    problem = trust_region.make_problem(environment, horizon=num_steps, limit=table.limit)
    hparams = make_hparams(trust_region.Hparams, _settings(task))
    return LearnerSetup(
        trust_region,
        problem,
        hparams,
        _acts(trust_region, problem, hparams),
        ("reward", "cost", "length", "deviation", "kl"),
        ("parameters", "moments"),
        hparams.num_trajectories * num_steps,
        f"a Gaussian whose mean is a network with hidden layers {list(hparams.hidden)}",
    )


def _costs_where_violated(
    step: Callable[..., Timestep], world: PyTree, action: PyTree, key: chex.PRNGKey
) -> Timestep:
    """Cost 1 where the formula is violated; its expected sum is the violation probability."""
    timestep = Timestep(*step(world, action, key))
    # An episode ends with the first such step.
    return timestep._replace(cost=jnp.where(timestep.world.verdict == Verdict.VIOLATED, 1.0, 0.0))
