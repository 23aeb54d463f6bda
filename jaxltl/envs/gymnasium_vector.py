"""Environments of jaxltl as vector environments of the package gymnasium, one compiled program for all lanes."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np

from jaxltl.core import validation
from jaxltl.core.environments.environment import Box, Environment, Finite, require_environment
from jaxltl.core.models.protocols import Key, PyTree

RESETS = ("next_step", "same_step")


def gymnasium_vector(
    environment: Environment, num_envs: int, *, resets: str = "next_step"
) -> PyTree:
    """An environment as a ``gymnasium.vector.VectorEnv`` of N lanes, for learners of other packages.

    All lanes are one compiled program. `info` has ``labels`` ``bool[N, P]``, ``discount`` ``float[N]``, and
    ``allowed`` ``bool[N, A]`` where actions are masked; of a :func:`~jaxltl.task_environment` also
    ``verdict`` and ``memory`` ``int[N]``. Give ``reset`` a seed once: equal seeds give equal steps, and each
    lane has its own draws.

    Args:
      environment: the environment, also one of :func:`~jaxltl.task_environment` or with a shield.
      num_envs: the number N of lanes.
      resets: ``"next_step"``: an episode's last observation is returned, and the next step resets, with
        reward 0 and without using the action (gymnasium's default); ``"same_step"``: the first observation
        of the next episode is returned, and ``info["final_obs"]`` has the last one.

    Returns:
      The ``gymnasium.vector.VectorEnv``.

    Raises:
      ValueError: gymnasium is not installed, or an argument is out of range.

    >>> from gymnasium.vector import VectorEnv
    >>> import jaxltl as jl
    >>> coin = jl.make_sparse(None, [0, 2, 3, 4], [1, 2, 1, 2], [.5, .5, 1, 1], label={"heads": [1]})
    >>> task = jl.task_environment(jl.environments.model_environment(coin), "X heads")
    >>> lanes = gymnasium_vector(task, 3)
    >>> seen, info = lanes.reset(seed=0)
    >>> isinstance(lanes, VectorEnv), lanes.step(np.zeros(3, int))[2].shape, info["verdict"].tolist()
    (True, (3,), [0, 0, 0])
    """
    environment = require_environment(environment)
    count = validation.integer("num_envs", num_envs, least=1)
    return _kind()(environment, count, validation.choice("resets", resets, RESETS))


@functools.cache  # one class, made when gymnasium is first needed
def _kind() -> type:
    try:
        from gymnasium.vector import VectorEnv
    except ImportError as problem:
        raise ValueError(
            'gymnasium_vector needs the package gymnasium; pip install "jaxltl[gymnasium]".'
        ) from problem
    return type("JaxVectorEnv", (_Lanes, VectorEnv), {})


@functools.partial(jax.jit, static_argnames="num_envs")
def _reset(environment: Environment, key: Key, num_envs: int) -> PyTree:
    worlds = jax.vmap(environment.reset)(jax.random.split(key, num_envs))
    return worlds, _seen(environment, worlds)


@functools.partial(jax.jit, static_argnames="in_same_step")
def _step(
    environment: Environment, key: Key, lanes: PyTree, actions: jax.Array, in_same_step: bool
) -> PyTree:
    """The next worlds with reward, ends and discount, and the observations; lanes that ended begin again."""

    def one(key: Key, world: PyTree, ended: jax.Array, action: jax.Array) -> PyTree:
        first, draw = jax.random.split(key)
        begun, step = environment.reset(first), environment.step(world, action, draw)
        done = step.terminated | step.truncated
        fresh = done if in_same_step else ended
        after = jax.tree.map(lambda a, b: jnp.where(fresh, a, b), begun, step.world)
        if in_same_step:
            return after, (step.reward, step.terminated, step.truncated, step.discount), step.world
        parts = step.reward, step.terminated, step.truncated, step.discount
        still = (0.0, False, False, 1.0)
        result = tuple(jnp.where(fresh, a, b) for a, b in zip(still, parts, strict=True))
        return after, result, step.world

    worlds, ended = lanes
    keys = jax.random.split(key, ended.shape[0])
    worlds, result, last = jax.vmap(one)(keys, worlds, ended, actions)
    final = jax.vmap(environment.observe)(last) if in_same_step else None
    return worlds, result, _seen(environment, worlds), final


def _seen(environment: Environment, worlds: PyTree) -> PyTree:
    info = {"labels": jax.vmap(environment.labels)(worlds)}
    if environment.allowed is not None:
        info["allowed"] = jax.vmap(environment.allowed)(worlds)
    for name in ("verdict", "memory"):
        if hasattr(worlds, name):
            info[name] = getattr(worlds, name)
    return jax.vmap(environment.observe)(worlds), info


class _Lanes:
    def __init__(self, environment: Environment, num_envs: int, resets: str) -> None:
        from gymnasium.vector import AutoresetMode
        from gymnasium.vector.utils import batch_space

        self.environment, self.num_envs = environment, num_envs
        self._in_same_step = resets == "same_step"
        mode = AutoresetMode.SAME_STEP if self._in_same_step else AutoresetMode.NEXT_STEP
        self.metadata = {"autoreset_mode": mode, "render_modes": []}
        self.render_mode: PyTree = None
        self.spec: PyTree = None
        self.single_observation_space = _space(environment.observations)
        self.single_action_space = _space(environment.actions)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._lanes: PyTree = None
        self._key: PyTree = None

    def reset(self, *, seed: int | None = None, options: PyTree = None) -> PyTree:
        del options
        if seed is not None or self._key is None:
            drawn = np.random.default_rng().integers(2**31) if seed is None else seed
            self._key = jax.random.key(validation.integer("seed", int(drawn)))
        worlds, (seen, info) = _reset(self.environment, self._next_key(), self.num_envs)
        self._lanes = worlds, jnp.zeros(self.num_envs, bool)
        return _observed(self.single_observation_space, seen), _host(info)

    def step(self, actions: PyTree) -> PyTree:
        if self._lanes is None:
            raise ValueError("the episodes have not begun; call reset(seed=...) first.")
        space = self.single_action_space
        actions = np.asarray(actions)
        if actions.shape != (self.num_envs, *space.shape):
            raise ValueError(
                f"actions have shape {list(actions.shape)}; give one for each lane, "
                f"{[self.num_envs, *space.shape]}."
            )
        worlds, result, (seen, info), final = _step(
            self.environment, self._next_key(), self._lanes, actions, self._in_same_step
        )
        reward, ended, cut, discount = (np.array(x) for x in result)
        done, info = ended | cut, {**_host(info), "discount": discount}
        self._lanes = worlds, jnp.asarray(done)
        if self._in_same_step and done.any():
            info["final_obs"] = _observed(self.single_observation_space, final)
            info["_final_obs"] = done
        observed = _observed(self.single_observation_space, seen)
        return observed, reward.astype(float), ended.astype(bool), cut.astype(bool), info

    def _next_key(self) -> Key:
        self._key, key = jax.random.split(self._key)
        return key


def _host(tree: PyTree) -> PyTree:
    return jax.tree.map(np.asarray, tree)


def _space(kind: PyTree) -> PyTree:
    """A space of gymnasium, of boxes or of a tree of them with names or numbers."""
    from gymnasium import spaces

    if isinstance(kind, Finite):
        return spaces.Discrete(kind.num)
    if isinstance(kind, Box):
        ends = (
            np.broadcast_to(np.asarray(x, kind.dtype), kind.shape) for x in (kind.low, kind.high)
        )
        if kind.dtype == "bool":
            return spaces.MultiBinary(kind.shape)
        box: PyTree = spaces.Box
        return box(*ends, kind.shape, np.dtype(kind.dtype).type)
    return spaces.Dict({name: _space(part) for name, part in _named(kind).items()})


def _named(tree: PyTree) -> dict[str, PyTree]:
    """The parts of a tree: of a mapping, of a named tuple or dataclass by fields, else by numbers."""
    if isinstance(tree, dict):
        return {str(name): part for name, part in tree.items()}
    fields = getattr(tree, "_fields", None) or getattr(tree, "__dataclass_fields__", None)
    if fields:
        return {name: getattr(tree, name) for name in fields}
    return {str(i): part for i, part in enumerate(tree)}


def _observed(space: PyTree, seen: PyTree) -> PyTree:
    """Observations of all lanes, in the structure of a space."""
    parts = getattr(space, "spaces", None)
    if parts is None:
        return np.array(seen)
    named = _named(seen)
    return {name: _observed(part, named[name]) for name, part in parts.items()}
