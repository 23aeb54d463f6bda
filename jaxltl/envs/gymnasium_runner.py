"""Policies in environments of the package gymnasium; this module does not import JAX."""

from __future__ import annotations

from collections.abc import Callable, Collection

import numpy as np

from jaxltl.core import validation
from jaxltl.core.array_types import PyTree
from jaxltl.core.automata.automaton import letter_index
from jaxltl.core.automata.runs import Verdict, lasso_verdicts, verdicts
from jaxltl.core.policies.episode_statistics import EpisodeTotals, Evaluation, evaluation_of
from jaxltl.core.policies.finite_memory import Controller, FiniteMemoryPolicy, Policy

TERMINATED = "terminated"

Observe = Callable[[PyTree, PyTree], tuple[PyTree, Collection[str] | None]]


def run_policy(
    env: PyTree,
    policy: Policy | Callable[[PyTree], PyTree],
    *,
    num_episodes: int = 1000,
    seed: int = 0,
    confidence: float = 0.95,
    observe: Observe | None = None,
) -> Evaluation:
    """Evaluates a policy in a gymnasium environment, with confidence intervals.

    Verdicts are those of the policy's automaton, or of :func:`gymnasium_task`. As in
    :func:`~jaxltl.task_environment`, an episode ends at a decided verdict too, the label of a terminal
    state (with ``"terminated"``, as in `from_gymnasium`) repeats for ever, and a truncated episode is
    undecided. Intervals are those of :func:`~jaxltl.evaluate`.

    Args:
      env: the environment, with a limit of steps: of its specification, or of the wrapper TimeLimit.
      policy: a finite-memory policy, a network of ``load_policy``, or a function of the observation.
      num_episodes, seed, confidence: number of episodes, seed of all draws, and of each interval.
      observe: ``(observation, info) -> (state, label)``, the state or observation that the policy
        reads, and the propositions that hold, or None for those of the policy's map. Default: the
        observation, as a number for a finite-memory policy, and None.

    Returns:
      :class:`~jaxltl.core.policies.episode_statistics.Evaluation`; `reward` is the environment's.

    Raises:
      ValueError: an environment without a limit of steps, or a state that the policy does not have.

    >>> import gymnasium
    >>> lake = gymnasium.make("FrozenLake-v1", is_slippery=False)
    >>> found = run_policy(lake, lambda observation: 2, num_episodes=9)  # to the right
    >>> found.reward.mean, found.truncated, found.success
    (0.0, 9, None)
    """
    count = validation.integer("num_episodes", num_episodes, least=1)
    confidence = validation.fraction("confidence", confidence, ends=(False, False))
    limit, judge = _limit(env), _Judge(policy)
    if isinstance(policy, Policy):
        player: Controller | _Function = Controller(policy, seed)
    else:
        player = _Function(policy)
    table = isinstance(policy, FiniteMemoryPolicy)
    observe = observe or (lambda seen, info: (int(seen) if table else seen, None))
    rows: list[PyTree] = []
    for episode in range(count):
        seen, info = env.reset(seed=seed if episode == 0 else None)
        state, label = observe(seen, info)
        player.start(state, label)
        verdict, total, length, ended, cut = judge(player, label, info, False), 0.0, 0, False, False
        while not (ended or cut) and (length == 0 or verdict in (None, Verdict.UNDECIDED)):
            seen, reward, ended, cut, info = env.step(player.act())
            state, label = observe(seen, info)
            label = judge.terminal(state, label) if ended else label
            player.update(state, label)
            verdict = judge(player, label, info, ended)
            total, length = total + float(reward), length + 1
        done = bool(ended) or verdict not in (None, Verdict.UNDECIDED)
        rows.append((total, length, done, bool(cut) and not done, verdict))
    sums, lengths, dones, cuts, codes = (np.array(x) for x in zip(*rows, strict=True))
    known = None if codes[0] is None else codes
    totals = EpisodeTotals(sums, sums, 0 * sums, lengths, dones, cuts, known, None, None)
    return evaluation_of(totals, limit, confidence)


def _limit(env: PyTree) -> int:
    limit = getattr(getattr(env, "spec", None), "max_episode_steps", None)
    while limit is None and env is not None:
        limit = vars(env).get("_max_episode_steps", getattr(type(env), "_max_episode_steps", None))
        env = vars(env).get("env")
    if limit is None:
        raise ValueError(
            "env has no limit of steps, so an episode may never end; wrap it in "
            "gymnasium.wrappers.TimeLimit(env, max_episode_steps)."
        )
    return validation.integer("max_episode_steps", limit, least=1)


class _Function:
    def __init__(self, function: Callable[[PyTree], PyTree]) -> None:
        self.function = function

    def start(self, state: PyTree, label: PyTree) -> None:
        self.seen = state

    update = start

    def act(self) -> PyTree:
        return self.function(self.seen)


class _Judge:
    def __init__(self, policy: PyTree) -> None:
        self.policy = policy
        self.automaton: PyTree = getattr(policy, "automaton", None)
        if self.automaton is not None:
            self.table, self.ends = verdicts(self.automaton), lasso_verdicts(self.automaton)

    def __call__(self, player: PyTree, label: PyTree, info: PyTree, ended: bool) -> int | None:
        if "verdict" in info:
            return int(info["verdict"])
        if self.automaton is None:
            return None
        at = player.at
        verdict = int(self.table[at.memory])
        if not ended or verdict != Verdict.UNDECIDED:
            return verdict
        return int(self.ends[at.memory, letter_index(self.automaton, self._label(at.state, label))])

    def terminal(self, state: PyTree, label: PyTree) -> PyTree:
        """The label of a terminal state, with "terminated" if the formula has it."""
        if self.automaton is None or TERMINATED not in self.automaton.propositions:
            return label
        return {*self._label(state, label), TERMINATED}

    def _label(self, state: PyTree, label: PyTree) -> Collection[str]:
        if label is not None:
            return set(label)
        row = self.automaton.letters[self.policy.letter[state]]
        return {p for p, holds in zip(self.automaton.propositions, row, strict=True) if holds}
