"""Expected SARSA: on-policy temporal-difference control of a discounted reward, with a mask.

One trajectory of an epsilon-greedy policy ``pi`` over allowed actions updates a table of values
(van Seijen et al. 2009)::

    Q(s, a) <- Q(s, a) + alpha (r + discount sum_a' pi(a' | s') Q(s', a') - Q(s, a)).

It is the smallest learner of the library, and a template for others. Of a task pass the explicit
product, ``restrict(product).model``, and as `allowed` the actions that keep the task's probability.

Example: to stay in the second state pays, and one action leads there.
  >>> import jax, jax.numpy as jnp
  >>> import jaxltl as jl
  >>> from jaxltl.algos import expected_sarsa
  >>> mdp = jl.models.from_dense(
  ...     [[[1.0, 0], [0, 1.0]], [[0, 1.0], [1.0, 0]]], initial=[1, 0])
  >>> problem = expected_sarsa.make_problem(mdp, [[0.0, 0.0], [1.0, 0.0]])
  >>> hparams = expected_sarsa.Hparams(discount=0.9, step_size=0.5)
  >>> state, metrics = expected_sarsa.train(jax.random.key(0), problem, hparams, num_steps=50)
  >>> jnp.argmax(expected_sarsa.policy(state, problem, hparams), axis=-1).tolist()
  [1, 0]
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax

from jaxltl.algos.common import learner
from jaxltl.algos.common.explicit_games import check_reward, explicit_game
from jaxltl.algos.common.settings import COUNT, Number, RunState, static, traced
from jaxltl.core import struct
from jaxltl.core.models import MDP, sample_successor, with_allowed
from jaxltl.core.models.protocols import Array, Key, PyTree
from jaxltl.core.validation import Range


@struct.dataclass
class Problem:
    """A `model` with the allowed actions alone, and a `reward` ``float[S, A]``."""

    model: MDP
    reward: jax.Array


@struct.dataclass
class Hparams:
    """Settings; numbers are traced.

    Attributes:
      discount: in [0, 1).
      step_size: alpha in (0, 1]. Default 0.1.
      epsilon: probability of a uniformly drawn action. Default 0.1.
      restart: probability of a restart before a transition. Default 0.01.
      num_transitions: in a step; static. Default 100.
    """

    discount: Number = traced("discount")
    step_size: Number = traced(Range(0, 1, open_below=True), default=0.1)
    epsilon: Number = traced(Range(0, 1), default=0.1)
    restart: Number = traced(Range(0, 1), default=0.01)
    num_transitions: int = static(COUNT, default=100)


@struct.dataclass
class State(RunState):
    """The table `q` ``float[S, A]``, and the model's state `position`."""

    q: jax.Array
    position: jax.Array


@struct.dataclass
class Metrics:
    """Of a step: the `value` at the initial states by the table, the largest absolute
    temporal-difference error `residual`, and a `status`, NONFINITE or COMPLETED."""

    value: jax.Array
    residual: jax.Array
    status: jax.Array


def make_problem(model: MDP, reward: Array, *, allowed: Array | None = None) -> Problem:
    """A checked :class:`Problem` of an explicit `model`; `allowed`, ``bool[S, A]``: default all actions.

    Raises:
      ValueError: a wrong shape, a reward that is not finite, or a state without an allowed action.
    """
    model = model if allowed is None else with_allowed(model, allowed)
    game = explicit_game(model)
    return Problem(game.mdp, check_reward(game, reward))


def _init(key: Key, problem: Problem, hparams: Hparams) -> State:
    first = jax.random.categorical(learner.init_key(key), jnp.log(problem.model.initial))
    return State(key, jnp.int32(0), jnp.zeros_like(problem.reward), first.astype(jnp.int32))


def _epsilon_greedy(q: jax.Array, allowed: jax.Array, epsilon: Number) -> jax.Array:
    """Action probabilities ``float[..., A]``."""
    greedy = jnp.argmax(jnp.where(allowed, q, -jnp.inf), axis=-1, keepdims=True)
    is_greedy = jnp.arange(q.shape[-1]) == greedy
    uniform = allowed / jnp.maximum(allowed.sum(-1, keepdims=True), 1)
    return (epsilon * uniform + (1 - epsilon) * is_greedy).astype(q.dtype)


def _step(state: State, problem: Problem, hparams: Hparams) -> tuple[State, Metrics]:
    model = problem.model

    def transition(carry: PyTree, key: Key) -> PyTree:
        q, s = carry
        restart_key, start_key, action_key, successor_key = jax.random.split(key, 4)
        first = jax.random.categorical(start_key, jnp.log(model.initial)).astype(s.dtype)
        s = jnp.where(jax.random.bernoulli(restart_key, hparams.restart), first, s)
        row = _epsilon_greedy(q[s], model.available[s], hparams.epsilon)
        a = jax.random.categorical(action_key, jnp.log(row))
        successor = sample_successor(model, successor_key, s, a)
        following = _epsilon_greedy(q[successor], model.available[successor], hparams.epsilon)
        target = problem.reward[s, a] + hparams.discount * jnp.sum(following * q[successor])
        error = target - q[s, a]
        return (q.at[s, a].add(hparams.step_size * error), successor.astype(s.dtype)), error

    keys = jax.random.split(learner.step_key(state), hparams.num_transitions)
    (q, position), errors = lax.scan(transition, (state.q, state.position), keys)
    value = jnp.sum(_epsilon_greedy(q, model.available, hparams.epsilon) * q, axis=-1)
    finite = jnp.all(jnp.isfinite(q))
    status = learner.completion_status(finite, finite)
    metrics = Metrics(jnp.sum(model.initial * value), jnp.max(jnp.abs(errors)), status)
    return State(state.key, state.step + 1, q, position), metrics


init, step, run, train, run_until, train_until = learner.bind(_init, _step)


def policy(state: State, problem: Problem, hparams: Hparams) -> jax.Array:
    """The epsilon-greedy policy of the table, ``float[S, A]``, zero at actions not allowed."""
    return _epsilon_greedy(state.q, problem.model.available, hparams.epsilon)
