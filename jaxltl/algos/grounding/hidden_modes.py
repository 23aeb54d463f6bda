"""Demonstrators that switch between a given number of hidden modes.

In mode z a demonstrator draws actions from ``pi_z(a | h_t) ~ exp(Q_z(s_t, a) + w_z . e_t(a))``: the soft
action values of a reward that is linear in features, and evidence of the history ``h_t``, such as the
logarithms of count tables, :func:`fit_history` (a log-linear pool). After a step in s the mode moves
with probability ``M_s(z, z')`` (as in Ke et al. 2025). The likelihood sums over all mode paths by the
forward recursion of :mod:`jaxltl.algos.grounding.problem`: the product of the probabilities of each
action given the past. It is differentiated implicitly through
:func:`~jaxltl.core.values.discounted.soft.soft_value`; many random starts are a ``vmap``.

The count tables have two chains of contexts, each extended by one older symbol a level: the states
``s_t, s_{t-1}, ...``, and the actions ``a_{t-1}, a_{t-2}, ...`` after the kind of ``s_t``, the set of
its actions without effect.
With counts n, a context c has the Dirichlet-smoothed probabilities (MacKay and Peto 1995)
``p(a | c) = (n(c, a) + strength p(a | c')) / (n(c) + strength)``, where c' is the context without its
oldest symbol; the first level backs off to the uniform distribution. The strength of each level
maximises the likelihood of each demonstration under the counts of all others.

Example: first the action 0 nine times, then the action 1.
  >>> import jax
  >>> import jaxltl as jl
  >>> from jaxltl.algos.grounding import hidden_modes
  >>> world = jl.from_dense([[[1.0], [1.0]]])
  >>> shown = jl.make_trajectories(world, [[(0, t // 9) for t in range(18)]])
  >>> problem = hidden_modes.make_problem(world, shown, 2, features=[[[0.0], [1.0]]])
  >>> hparams = hidden_modes.Hparams(l2=0.01)
  >>> learned = jl.check(hidden_modes.fit(jax.random.key(0), problem, hparams, num_starts=3))
  >>> state = learned.state
  >>> mode = hidden_modes.mode_probabilities(state, problem, hparams)[0].argmax(-1)  # [T]
  >>> bool((mode[:9] == mode[0]).all() & (mode[9:] == 1 - mode[0]).all())
  True
  >>> shown = jl.make_trajectories(world, [[(0, n % 2)] * 5 for n in range(20)])
  >>> tables = hidden_modes.fit_history(world, shown, past_states=0, past_actions=1)
  >>> tables.evidence(jl.make_trajectories(world, [[(0, 1), (0, 1)]])).shape  # [N, T, A, E]
  (1, 2, 2, 3)
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxltl.algos.common import learner, optimizers, trees
from jaxltl.algos.common.loops import Learned
from jaxltl.algos.common.settings import Number, finite_features, static, traced
from jaxltl.algos.grounding.learner import State as State
from jaxltl.algos.grounding.problem import NEVER, forward, joined_demonstrations
from jaxltl.core import struct
from jaxltl.core.array_types import Key, PyTree
from jaxltl.core.models.mdp import MDP
from jaxltl.core.models.trajectories import Trajectories, require_states
from jaxltl.core.types import Status, worst
from jaxltl.core.validation import Range, require_in_range
from jaxltl.core.values.discounted.soft import policy_logits, soft_value


_STAY = 3.0  # prior mean of the logit that a mode stays


@struct.dataclass
class Problem:
    """A world, demonstrations, and the inputs of the modes' policies.

    Attributes:
      world: with S states and A actions.
      state, action: ``int32[N, T]``, padded with zeros.
      length: ``int32[N]``, numbers of steps.
      features: ``float[S, A, F]``, of the rewards; F may be 0.
      evidence: ``float[N, T, A, E]``, of the history; E may be 0.
      num_modes: Z; static.
    """

    world: MDP
    state: jax.Array
    action: jax.Array
    length: jax.Array
    features: jax.Array
    evidence: jax.Array
    num_modes: int = struct.field(pytree_node=False)


@struct.dataclass
class Hparams:
    """Settings; numbers are traced.

    Attributes:
      discount: in [0, 1), of the demonstrator; default 0.9.
      l2: at least 0; precision of the Gaussian prior on all parameters; default 1.
      learning_rate: default 0.05.
      optimizer: the name of one of optax; static; default ``"adam"``.
    """

    discount: Number = traced("discount", default=0.9)
    l2: Number = traced(Range(0, open_above=True), default=1.0)
    learning_rate: Number = traced(Range(0, open_above=True), default=0.05)
    optimizer: str = static(optimizers.NAMES, default="adam")


@struct.dataclass
class Metrics:
    """Figures of the parameters before a step; scalars, of a run ``[T]``.

    Attributes:
      loss: the objective.
      gradient_norm: Euclidean.
      status: of the solver, the worst over the modes.
    """

    loss: jax.Array
    gradient_norm: jax.Array
    status: jax.Array


def make_problem(
    world: MDP,
    demonstrations: Trajectories,
    num_modes: int,
    *,
    features: ArrayLike | None = None,
    evidence: ArrayLike | None = None,
) -> Problem:
    """A checked :class:`Problem`.

    Args:
      world: with the demonstrations.
      demonstrations: N, none empty.
      num_modes: Z, at least 1.
      features: ``float[S, A, F]``, of the rewards; default none.
      evidence: ``float[N, T, A, E]``, of the history, such as ``HistoryTables.left_out`` of the
        demonstrations that were fitted and ``HistoryTables.evidence`` of others; default none.

    Raises:
      ValueError: neither features nor evidence, another shape, a number that is not finite, or
        demonstrations that do not fit.
    """
    require_in_range("num_modes", num_modes, Range(1, integer=True))
    _, state, action, length = joined_demonstrations([world], [demonstrations])
    if features is None and evidence is None:
        raise ValueError("there are neither features nor evidence; give one or both.")
    rows = {"features": world.available.shape, "evidence": (*state.shape, world.num_actions)}
    tables = {"features": features, "evidence": evidence}
    arrays = {
        name: finite_features(
            name, np.zeros((*rows[name], 0)) if table is None else table, rows[name], world.dtype
        )
        for name, table in tables.items()
    }
    return Problem(world, state, action, length, **arrays, num_modes=int(num_modes))


def objective(
    parameters: PyTree, problem: Problem, hparams: Hparams
) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
    """``-sum_n log p(a_0, a_1, ... | s_0, s_1, ...) + l2 / 2 |parameters|^2``.

    Returns the loss, and as auxiliary outputs the log-likelihoods ``float[N]`` and the solver's status.
    Differentiable in the `parameters` of a `problem` with `hparams`.
    """
    start, emit, move, status = _chains(parameters, problem, hparams)
    log_likelihoods = jax.vmap(forward, (None, 0, 0, 0))(start, emit, move, problem.length)
    squares = sum(jnp.sum(x * x) for x in jax.tree.leaves(parameters))
    return hparams.l2 / 2 * squares - jnp.sum(log_likelihoods), (log_likelihoods, status)


def _chains(parameters: PyTree, problem: Problem, hparams: Hparams) -> tuple[jax.Array, ...]:
    """Arguments of ``forward``: first modes, steps ``[N, T, Z]``, moves ``[N, T - 1, Z, Z]``; status."""
    log_policy, status = _log_policy(parameters, problem, hparams)
    steps = log_policy[:, problem.state].transpose(1, 2, 3, 0)  # [N, T, A, Z]
    steps = jax.nn.log_softmax(steps + problem.evidence @ parameters["evidence"].T, axis=2)
    emit = jnp.take_along_axis(steps, problem.action[..., None, None], axis=2)[:, :, 0]
    moves = _log_moves(parameters)[problem.state[:, :-1]]
    return jax.nn.log_softmax(parameters["start"]), emit, moves, status


def _log_moves(parameters: PyTree) -> jax.Array:
    """``log M_s(z, z')``, ``float[S, Z, Z]``."""
    stay = _STAY * jnp.eye(len(parameters["move"]))
    return jax.nn.log_softmax(stay + parameters["move"] + parameters["move_in"], axis=-1)


def _log_policy(
    parameters: PyTree, problem: Problem, hparams: Hparams
) -> tuple[jax.Array, jax.Array]:
    """Log probabilities ``float[Z, S, A]`` of the soft policies of rewards, and the worst status."""

    def one(weights: jax.Array) -> tuple[jax.Array, jax.Array]:
        reward = problem.features @ weights
        solution = soft_value(problem.world, reward, hparams.discount)
        logits = policy_logits(problem.world, reward, hparams.discount, solution.value)
        return jax.nn.log_softmax(jnp.maximum(logits, NEVER), axis=-1), solution.status

    if problem.features.shape[-1]:
        logits, status = jax.vmap(one)(parameters["reward"])
        return logits, jnp.max(status)
    uniform = jax.nn.log_softmax(jnp.where(problem.world.available, 0.0, NEVER), axis=-1)
    logits = jnp.broadcast_to(uniform, (problem.num_modes, *uniform.shape))
    return logits.astype(problem.evidence.dtype), jnp.int32(Status.COMPLETED)


def _init(key: Key, problem: Problem, hparams: Hparams) -> State:
    """Random rewards, and equal weights of the evidence with noise; the key is kept."""
    modes, dtype = problem.num_modes, problem.evidence.dtype
    reward, evidence = jax.random.split(learner.init_key(key))
    width = problem.evidence.shape[-1]
    parameters = {
        "reward": 0.1 * jax.random.normal(reward, (modes, problem.features.shape[-1]), dtype),
        "evidence": 1 / max(width, 1) + 0.1 * jax.random.normal(evidence, (modes, width), dtype),
        "start": jnp.zeros(modes, dtype),
        "move": jnp.zeros((modes, modes), dtype),
        "move_in": jnp.zeros((problem.world.num_states, modes, modes), dtype),
    }
    parameters = trees.strong(parameters)
    return State(key, jnp.int32(0), parameters, optimizers.start(hparams, parameters))


def _step(state: State, problem: Problem, hparams: Hparams) -> tuple[State, Metrics]:
    """One step of the optimiser on :func:`objective`; deterministic given the state."""
    loss_of = partial(objective, problem=problem, hparams=hparams)
    loss, (_, status), norm, *new = optimizers.descend(loss_of, state, hparams)
    return State(state.key, state.step + 1, *new), Metrics(loss, norm, status)


# Metrics describe the state before a step.
init, step, run, train, run_until, train_until = learner.bind(_init, _step)


def fit(
    key: Key, problem: Problem, hparams: Hparams, *, num_starts: int = 4, num_steps: int = 300
) -> Learned:
    """The run of least loss of `num_starts` random starts from `key`, trained as a batch.

    The `problem`, `hparams` and `num_steps` are those of ``train``. Returns
    :class:`~jaxltl.algos.common.loops.Learned` with the status COMPLETED, NONFINITE if no start has a
    finite loss, or a worse status of the solver. The state scores other demonstrations: give
    :func:`log_likelihood` a problem with them. Raises ValueError if a number is out of range.
    """
    require_in_range("num_starts", num_starts, Range(1, integer=True))
    states, metrics = jax.vmap(partial(train, num_steps=num_steps, max_rows=1), (0, None, None))(
        jax.random.split(key, num_starts), problem, hparams
    )
    loss = jnp.where(jnp.isnan(metrics.loss[:, -1]), jnp.inf, metrics.loss[:, -1])
    best = jnp.argmin(loss)
    state, last = jax.tree.map(
        lambda x: x[best], (states, jax.tree.map(lambda x: x[:, -1], metrics))
    )
    status = learner.completion_status(jnp.bool_(True), jnp.isfinite(loss[best]))
    return Learned(state, last, jnp.int32(num_steps), worst(status, last.status))


@jax.jit
def log_likelihood(state: State, problem: Problem, hparams: Hparams) -> jax.Array:
    """``sum_t log p(a_t | s_0, a_0, ..., s_t)`` of each demonstration, ``float[N]``, in nats.

    Of a `state` learned from any `problem` with as many features, evidence and modes; `hparams` as there.
    """
    return objective(state.parameters, problem, hparams)[1][0]


@jax.jit
def mode_probabilities(state: State, problem: Problem, hparams: Hparams) -> jax.Array:
    """Posterior probability of each mode at each step given its demonstration, ``float[N, T, Z]``.

    The derivative of the likelihood in the steps' log-likelihoods; 0 in padding. The order of the modes
    has no meaning. Arguments as of :func:`log_likelihood`.
    """
    *chains, _ = _chains(state.parameters, problem, hparams)
    return jax.vmap(jax.grad(forward, 1), (None, 0, 0, 0))(*chains, problem.length)


def mode_moves(state: State) -> jax.Array:
    """Probabilities ``M_s(z, z')`` of a `state`: the next mode after a step in s, ``float[S, Z, Z]``."""
    return jnp.exp(_log_moves(state.parameters))


def policy(state: State, problem: Problem, hparams: Hparams) -> jax.Array:
    """Soft policies of the modes' rewards, without evidence: ``float[Z, S, A]``.

    Zero at unavailable actions.
    """
    return jnp.exp(_log_policy(state.parameters, problem, hparams)[0])


_STRENGTHS = tuple(2.0**k for k in range(-1, 9))
_LEAST = 1e-6  # probability: bounds the evidence of one table


class _ContextLevel(NamedTuple):
    """Sorted codes of the contexts, their counts ``float[K + 1, A]``, the last row 0, and strengths."""

    keys: np.ndarray
    counts: np.ndarray
    strengths: tuple[float, ...]


class HistoryTables(NamedTuple):
    """Count tables of :func:`fit_history`.

    Attributes:
      world: with S states and A actions.
      chains: the levels of the chain of states and of the chain of actions.
      left_out: ``float[N, T, A, E]``, the evidence of the fitted demonstrations, each without its own
        counts.
    """

    world: MDP
    chains: tuple[tuple[_ContextLevel, ...], ...]
    left_out: np.ndarray

    def evidence(self, demonstrations: Trajectories) -> np.ndarray:
        """``log p(a | c)`` at each step of new demonstrations, ``float[N, T, A, E]``, a table a level.

        It depends on the states up to the step and the actions before it alone. The demonstrations
        that were fitted have the evidence ``left_out``.
        """
        orders = [len(chain) - 1 for chain in self.chains]
        return _evaluated(self.world, demonstrations, orders, self.chains)[1]


def fit_history(
    world: MDP, demonstrations: Trajectories, *, past_states: int = 5, past_actions: int = 8
) -> HistoryTables:
    """The :class:`HistoryTables` of demonstrations, ``past_states + past_actions + 2`` levels in all.

    Of at least two `demonstrations` in a `world`; `past_states` and `past_actions`, at least 0, are the
    lengths of the two chains.

    Raises:
      ValueError: fewer than two demonstrations, another model's, or a negative length.
    """
    for name, value in (("past_states", past_states), ("past_actions", past_actions)):
        require_in_range(name, value, Range(0, integer=True))
    if (count := len(demonstrations.state)) < 2:
        raise ValueError(
            f"there are {count} demonstrations; give at least 2: each is scored by the others."
        )
    return HistoryTables(world, *_evaluated(world, demonstrations, [past_states, past_actions]))


def _evaluated(
    world: MDP,
    demonstrations: Trajectories,
    orders: list[int],
    chains: tuple[tuple[_ContextLevel, ...], ...] = (),
) -> tuple[tuple[tuple[_ContextLevel, ...], ...], np.ndarray]:
    """Levels and evidence; without levels they are fitted and each demonstration is left out."""
    require_states(demonstrations, world)
    mask, action = np.asarray(demonstrations.mask), np.asarray(demonstrations.action)
    available = np.asarray(world.available, float)[np.asarray(demonstrations.state)]
    width, base = world.num_actions, max(world.num_states, world.num_actions) + 1
    evidence, fitted = [], []
    for c, symbols in enumerate(_symbols(world, demonstrations, orders)):
        levels: list[_ContextLevel] = []
        probability = available / available.sum(-1, keepdims=True)
        code = np.zeros_like(symbols[0])
        for k, symbol in enumerate(symbols):
            code = code * base + symbol
            keys = chains[c][k].keys if chains else np.unique(code[mask])
            row = np.minimum(np.searchsorted(keys, code), len(keys) - 1)
            code = np.where(keys[row] == code, row, len(keys))
            if chains:
                level, own = chains[c][k], np.zeros((1, 1), np.int64)
            else:
                counts = _counts(code[mask], action[mask], len(keys) + 1, width)
                level, own = (
                    _ContextLevel(keys, counts, _STRENGTHS),
                    _own(code, action, mask, width),
                )
            others, trials = (level.counts[code] - own), []
            for strength in level.strengths:
                total = others.sum(-1, keepdims=True) + strength
                trials.append((others + strength * probability) / total)
            scores = [np.take_along_axis(p, action[..., None], -1)[mask] for p in trials]
            best = int(np.argmax([np.log(p).sum() for p in scores]))
            probability = trials[best]
            levels.append(level._replace(strengths=level.strengths[best : best + 1]))
            evidence.append(np.log(np.maximum(probability, _LEAST)))
        fitted.append(tuple(levels))
    return tuple(fitted), np.stack(evidence, -1)


def _symbols(
    world: MDP, demonstrations: Trajectories, orders: list[int]
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """The symbols ``int64[N, T]`` of both chains, the newest first; 0 before the first step."""
    state = np.asarray(demonstrations.state, np.int64)
    action = np.asarray(demonstrations.action, np.int64)
    own = np.asarray(world.successor) == np.arange(world.num_states)[:, None, None]
    loops = np.where(own, np.asarray(world.successor_probability), 0).sum(-1) > 1 - 1e-6
    _, kind = np.unique(loops, axis=0, return_inverse=True)

    def past(symbol: np.ndarray, lag: int) -> np.ndarray:
        return np.pad(symbol + 1, ((0, 0), (lag, 0)))[:, : symbol.shape[1]]

    states = [past(state, k) for k in range(orders[0] + 1)]
    return states, [kind.reshape(-1)[state], *(past(action, k + 1) for k in range(orders[1]))]


def _counts(row: np.ndarray, action: np.ndarray, num_rows: int, width: int) -> np.ndarray:
    counts = np.bincount(row * width + action, minlength=num_rows * width)
    return counts.reshape(num_rows, width).astype(float)


def _own(code: np.ndarray, action: np.ndarray, mask: np.ndarray, width: int) -> np.ndarray:
    """Counts ``float[N, T, A]`` of the step's context in its own demonstration."""
    pairs = np.arange(len(code))[:, None] * (code.max() + 1) + code
    keys, row = np.unique(pairs, return_inverse=True)
    row = row.reshape(code.shape)
    return _counts(row[mask], action[mask], len(keys), width)[row]
