"""Rewards of temporal-logic tasks, as tables on the transitions of their automata.

All have one form: a transition from an undecided state earns a reward and discounts later rewards;
a decided verdict earns a separate reward and ends the episode.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxltl.core import validation
from jaxltl.core.automata.automaton import CONDITIONS, Automaton
from jaxltl.core.environments.monitor import Verdict
from jaxltl.core.pretty_print import brief

REWARDS = ("auto", "reach", "keep", "eventual", "two-discount", "parity")
_DEFAULT = 0.99


@brief
class TaskReward(NamedTuple):
    """The named reward of a task, as arrays over states and letters of its automaton.

    `accepting` transitions are of even priority, or for a co-safe or safety task into a final state;
    `decided` is the reward at each :class:`~jaxltl.core.environments.monitor.Verdict`.
    """

    name: str
    accepting: np.ndarray
    reward: np.ndarray
    discount: np.ndarray
    decided: np.ndarray
    potential: np.ndarray


def make_task_reward(
    automaton: Automaton,
    decisions: np.ndarray,
    *,
    reward: str = "auto",
    discount: float | None = None,
    ratio: float | None = None,
    shaping: str | ArrayLike | None = None,
    learner_discount: float = 1.0,
) -> TaskReward:
    """The reward of a task, by name.

    The learner maximises ``E[sum_t (d_0 ... d_{t-1}) r_t]`` of the rewards r and discounts d below; its
    own discount is 1. Let g be `discount` and P the satisfaction probability. Limits hold for finite
    environments: from some g below 1 on, optimal policies are optimal for P.

    - ``"reach"``, for co-safe tasks: r = 1 where the verdict becomes satisfied, d = g. The value is P
      for g = 1, and ``E[g^(T - 1)]`` with T steps until satisfaction for g < 1.
    - ``"keep"``, for safety tasks: r = -1 where the verdict becomes violated, d = g. The value is P - 1
      for g = 1, which is the limit for g < 1.
    - ``"eventual"``, for two priorities (Voloshin, Verma & Yue 2023, "Eventual discounting temporal
      logic counterfactual experience replay"): r = 1 - g, d = g on accepting transitions, else r = 0,
      d = 1. With K accepting transitions the return is ``1 - g^K``, hence
      ``P <= value <= P + (1 - g) E[K; K finite]``, and the optimal policy loses at most
      ``(1 - g) max E[K; K finite]``.
    - ``"two-discount"``, for two priorities (Bozkurt, Wang, Zavlanos & Pajic 2020, "Control synthesis
      from linear temporal logic specifications using model-free reinforcement learning"): r = 1 - g and
      d = g on accepting transitions, r = 0 and d = h on others. The value tends to P as g tends to 1
      with `ratio` = ``(1 - h) / (1 - g)`` to 0. All steps discount, so that values are bounded and
      shaping is sound.
    - ``"parity"``, for any automaton: priority p stops with probability
      ``e_p = (1 - g) ratio^(p - p_0)``, p_0 the least, and wins if p is even (Hahn, Perez, Schewe,
      Somenzi, Trivedi & Wojtczak 2020, "Model-free reinforcement learning for stochastic parity
      games"). In expectation r = e_p at even and 0 at odd priorities, d = 1 - e_p; with two priorities
      this is ``"two-discount"``. The value tends to P as g tends to 1 and `ratio` to 0, since the least
      recurring priority then stops first. Adjacent priorities of one parity are merged.

    The last three earn 1 and end where the verdict becomes satisfied, and 0 where violated, as P does.

    A potential f of the automaton states adds ``d f(q') - f(q)``, with the learner's own discount as a
    factor of d and f = 0 after the end (Ng, Harada & Russell 1999, "Policy invariance under reward
    transformations"). The sum telescopes to ``-f(q_0)`` for every policy if all discounts are below 1;
    otherwise an infinite run keeps the potential of its last state, and shaping is refused.
    ``"distance"`` is the potential ``1 - n(q) / max n``, with n the length of a shortest path to a
    satisfied verdict (``"reach"``) or an accepting transition, and ``n(q) / max n`` to a violated
    verdict for ``"keep"``. A transition is as long as the number of propositions that hold in its
    letter, at least 1.

    Args:
      automaton: of the task.
      decisions: ``int32[Q]``, the verdicts of the automaton states.
      reward: its name; ``"auto"`` takes ``"reach"`` for co-safe tasks, ``"keep"`` for safety,
        ``"eventual"`` for Buchi and ``"parity"`` for other tasks.
      discount: g; default: 1 for ``"reach"`` and ``"keep"`` (.99 with shaping), else .99.
      ratio: of ``"two-discount"`` and ``"parity"``; default: 1 - g.
      shaping: None, ``"distance"``, or a potential ``float[Q]``.
      learner_discount: the learner's own discount, which shaping takes into account.

    Returns:
      :class:`TaskReward`.

    Raises:
      ValueError: a reward that does not fit the task, or a number out of its range.
    """
    reward = validation.choice("reward", reward, REWARDS)
    name = CONDITIONS[automaton.acceptance].reward if reward == "auto" else reward
    _require_fit(automaton, name)
    shaped = shaping is not None
    final = name in ("reach", "keep")
    if discount is None:
        discount = 1.0 if final and not shaped else _DEFAULT
    discount = validation.finite_number("discount", discount)
    if not 0 < discount <= 1 or (discount == 1 and not final):
        raise ValueError(
            f"discount={discount}; the reward {name!r} needs one above 0 and "
            f"{'at most' if final else 'below'} 1."
        )
    learner_discount = validation.fraction("learner_discount", learner_discount, ends=(False, True))
    rank = _ranks(automaton)
    accepting = rank % 2 == 0
    if final:
        payment = np.zeros(rank.shape)
        factor = np.full(rank.shape, float(discount))
    else:
        payment, factor = _stopping(rank, name, discount, ratio)
    if ratio is not None and name not in ("two-discount", "parity"):
        raise ValueError(f"ratio={ratio} is of 'two-discount' and 'parity', not of {name!r}.")
    decided = np.array([0.0, 0, -1] if name == "keep" else [0.0, 1, 0])
    potential = np.zeros(len(rank))
    if shaping is not None:
        potential = _potential(automaton, decisions, accepting, name, shaping)
        _require_discounted(factor, decisions, learner_discount, name)
    return TaskReward(name, accepting, payment, factor, decided, potential)


def _require_fit(automaton: Automaton, name: str) -> None:
    kind = automaton.acceptance
    finite = {c.reward: other for other, c in CONDITIONS.items() if c.table == "final"}
    needed = finite.get(name, kind)
    if kind != needed:
        raise ValueError(
            f"reward={name!r} is for {needed} tasks, and this one has {kind} acceptance; "
            f"its own is {CONDITIONS[kind].reward!r}, and 'auto' takes it."
        )
    if name in ("eventual", "two-discount") and np.max(_ranks(automaton)) > 1:
        raise ValueError(
            f"reward={name!r} knows accepting readings and others, and the automaton has more than "
            "two priorities; take 'parity'."
        )


def _ranks(automaton: Automaton) -> np.ndarray:
    """``int[Q, L]``: the priorities, with adjacent ones of one parity merged."""
    if automaton.has_final_states:  # known as soon as the state is entered
        return (~automaton.final[np.asarray(automaton.delta)]).astype(int)
    values, place = np.unique(automaton.priority, return_inverse=True)
    return np.cumsum(np.diff(values % 2, prepend=0) != 0)[place].reshape(automaton.priority.shape)


def _stopping(
    rank: np.ndarray, name: str, discount: float, ratio: float | None
) -> tuple[np.ndarray, np.ndarray]:
    """Rewards and discounts of transitions that stop with the probability of their rank."""
    ratio = 1 - discount if ratio is None else ratio
    ratio = validation.fraction("ratio", ratio, ends=(False, False))
    stops = (1 - discount) * ratio ** (rank - rank.min())
    if name == "eventual":
        stops = np.where(rank == 0, stops, 0)
    number = jnp.dtype(jnp.result_type(float))
    lost = (rank % 2 == 0) & ((1 - stops).astype(number) == 1)
    if lost.any():
        raise ValueError(
            f"discount={discount} and ratio={ratio}: reading rank {rank[lost].min()} would stop "
            f"with probability {stops[lost].max():.0e}, which {number.name} does not tell from "
            "none; give a greater ratio, a smaller discount, or compute in float64."
        )
    return np.where(rank % 2 == 0, stops, 0), 1 - stops


def _potential(
    automaton: Automaton,
    decisions: np.ndarray,
    accepting: np.ndarray,
    name: str,
    shaping: str | ArrayLike,
) -> np.ndarray:
    if isinstance(shaping, str):
        if shaping != "distance":
            raise ValueError(f"shaping={shaping!r}; give None, 'distance' or an array.")
        delta = np.asarray(automaton.delta)
        # Else a letter in which all holds would be the nearest way through all stages.
        cost = np.maximum(np.asarray(automaton.letters).sum(axis=1), 1)
        if name in ("reach", "keep"):
            goal = Verdict.SATISFIED if name == "reach" else Verdict.VIOLATED
            steps = _distance(delta, cost, np.where(decisions == goal, 0, np.inf), np.inf)
        else:
            never = np.full(len(delta), np.inf)
            steps = _distance(delta, cost, never, np.where(accepting, cost, np.inf))
        known = np.isfinite(steps)
        longest = max(steps[known].max(initial=0), 1)
        share: np.ndarray = np.where(known, steps, longest) / longest
        return share if name == "keep" else 1 - share
    table = np.asarray(shaping)
    if (
        table.shape != decisions.shape
        or table.dtype.kind not in "biuf"
        or not (np.isfinite(table).all())
    ):
        raise ValueError(
            f"shaping has shape {list(table.shape)} and type {table.dtype}; give finite numbers "
            f"[{len(decisions)}], a potential of each state of the automaton."
        )
    return table.astype(float)


def _distance(
    delta: np.ndarray, cost: np.ndarray, start: np.ndarray, by_reading: np.ndarray | float
) -> np.ndarray:
    """Shortest distances ``n = min(start, min over letters of by_reading and cost + n')``."""
    steps = start
    while True:
        nearer = np.minimum(steps, np.minimum(by_reading, cost + steps[delta]).min(axis=1))
        if (nearer == steps).all():
            return steps
        steps = nearer


def is_discounted(factor: np.ndarray, decisions: np.ndarray, learner_discount: float) -> bool:
    """True if all undecided steps are discounted, so that shaping changes no optimal policy."""
    number = jnp.dtype(jnp.result_type(float))
    open_ = factor[decisions == Verdict.UNDECIDED].astype(number)
    return bool((open_ * number.type(learner_discount)).max(initial=0) < 1)


def _require_discounted(
    factor: np.ndarray, decisions: np.ndarray, learner_discount: float, name: str
) -> None:
    if not is_discounted(factor, decisions, learner_discount):
        raise ValueError(
            f"shaping with the reward {name!r}: some step is not discounted, and a run that never "
            "ends would keep the potential of where it stays, which may change what is best. Give "
            + ("discount below 1" if name in ("reach", "keep") else "the reward 'two-discount'")
            + ", or the learner_discount below 1 that the learner has."
        )
