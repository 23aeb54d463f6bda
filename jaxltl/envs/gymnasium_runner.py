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
      env: the environment, with a limit of steps: of its specification, or of the wrapper TimeLimit;
        or a ``gymnasium.vector.VectorEnv`` of such, each lane of which has its share of the episodes.
      policy: a finite-memory policy, a network of ``load_policy``, or a function of the observation. A
        network learned with masks of actions reads ``info["action_mask"]`` or ``info["allowed"]``.
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
    limit, table = _limit(env), isinstance(policy, FiniteMemoryPolicy)
    observe = observe or (lambda seen, info: (int(seen) if table else seen, None))
    play = _one if getattr(env, "num_envs", None) is None else _several
    rows = play(env, policy, observe, count, seed)
    sums, lengths, dones, cuts, codes = (np.array(x) for x in zip(*rows, strict=True))
    known = None if codes[0] is None else codes
    totals = EpisodeTotals(sums, sums, 0 * sums, lengths, dones, cuts, known, None, None)
    return evaluation_of(totals, limit, confidence)


def _one(env: PyTree, policy: PyTree, observe: Observe, count: int, seed: int) -> list[PyTree]:
    lane = _Lane(policy, observe, seed)
    rows: list[PyTree] = []
    for episode in range(count):
        lane.start(*env.reset(seed=seed if episode == 0 else None))
        while lane.row is None:
            lane.read(*env.step(lane.act()))
        rows.append(lane.row)
    return rows


def _several(env: PyTree, policy: PyTree, observe: Observe, count: int, seed: int) -> list[PyTree]:
    """Episodes of a vector environment; each lane has its share, so that short ones do not count more."""
    size, mode = env.num_envs, getattr(env.metadata.get("autoreset_mode"), "name", None)
    if mode not in ("NEXT_STEP", "SAME_STEP"):
        raise ValueError(
            f"env resets by autoreset_mode {mode}; make it with AutoresetMode.NEXT_STEP or SAME_STEP."
        )
    lanes = [_Lane(policy, observe, seed + i) for i in range(size)]
    shares = [count // size + (i < count % size) for i in range(size)]
    rows: list[list[PyTree]] = [[] for _ in lanes]
    seen, info = env.reset(seed=seed)
    for i, lane in enumerate(lanes):
        lane.start(_of_lane(seen, i), _details(info, i))
    over = np.zeros(size, bool)
    while any(len(mine) < share for mine, share in zip(rows, shares, strict=True)):
        actions = np.stack([np.asarray(lane.act()) for lane in lanes])
        seen, reward, ended, cut, info = env.step(actions)
        done = ended | cut
        for i, lane in enumerate(lanes):
            now, details = _of_lane(seen, i), _details(info, i)
            if mode == "NEXT_STEP" and over[i]:
                lane.start(now, details)
                continue
            last, final = now, details
            if mode == "SAME_STEP" and done[i]:
                last = _of_lane(info["final_obs"], i)
                final = _details(info.get("final_info", info), i)
            was_open = lane.row is None
            lane.read(last, reward[i], bool(ended[i]), bool(cut[i]), final)
            if was_open and lane.row is not None and len(rows[i]) < shares[i]:
                rows[i].append(lane.row)
            if mode == "SAME_STEP" and done[i]:
                lane.start(now, details)
        over = done
    return [row for mine in rows for row in mine]


def _of_lane(seen: PyTree, i: int) -> PyTree:
    """One lane of a batch of observations, in its structure."""
    if isinstance(seen, dict):
        return {name: _of_lane(part, i) for name, part in seen.items()}
    return type(seen)(_of_lane(part, i) for part in seen) if isinstance(seen, tuple) else seen[i]


def _details(info: PyTree, i: int) -> PyTree:
    """The information of one lane: gymnasium marks in ``_name`` which lanes have an entry."""
    return {
        name: _of_lane(part, i)
        for name, part in info.items()
        if not name.startswith("_") and (f"_{name}" not in info or info[f"_{name}"][i])
    }


class _Lane:
    """A policy in one environment: its memory, the verdict, and the row of the episode when it is over."""

    def __init__(self, policy: PyTree, observe: Observe, seed: int) -> None:
        self._judge, self._observe = _Judge(policy), observe
        self._player: Controller | _Function = (
            Controller(policy, seed) if isinstance(policy, Policy) else _Function(policy)
        )

    def start(self, seen: PyTree, info: PyTree) -> None:
        state, label = self._observe(seen, info)
        self._player.start(state, label)
        self._read_mask(info)
        self._total, self._length = 0.0, 0
        self.row: PyTree = None
        self._verdict = self._judge(self._player, label, info, False)

    def act(self) -> PyTree:
        return self._player.act(**self._mask)

    def _read_mask(self, info: PyTree) -> None:
        reads = getattr(getattr(self._player, "policy", None), "reads_mask", False)
        names = [x for x in ("action_mask", "allowed") if reads and x in info]
        self._mask = {"allowed": info[names[0]]} if names else {}

    def read(self, seen: PyTree, reward: PyTree, ended: bool, cut: bool, info: PyTree) -> None:
        if self.row is not None:  # decided before the environment's own end
            return
        state, label = self._observe(seen, info)
        label = self._judge.terminal(state, label) if ended else label
        self._player.update(state, label)
        self._read_mask(info)
        verdict = self._judge(self._player, label, info, ended)
        self._total, self._length = self._total + float(reward), self._length + 1
        decided = verdict not in (None, Verdict.UNDECIDED)
        if ended or cut or decided:
            done = bool(ended) or decided
            self.row = self._total, self._length, done, bool(cut) and not done, verdict


def _limit(env: PyTree) -> int:
    limit = getattr(getattr(env, "spec", None), "max_episode_steps", None)
    if limit is None and hasattr(env, "envs"):  # of a SyncVectorEnv
        return _limit(env.envs[0])
    if limit is None and hasattr(env, "environment"):  # of gymnasium_vector
        limit = env.environment.horizon
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

    def act(self, *, allowed: PyTree = None) -> PyTree:
        assert allowed is None  # a function reads the observation alone
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
