"""Gradient ascent on finite-state controllers, on the host: where explorations begin.

The value of a softmax controller is that of a chain, ``v = g_pi + P_pi v``; its gradient needs one more
solution, of the expected visits ``d = initial + P_pi^T d`` (Sutton et al. 2000; Meuleau et al. 1999). Both
are sparse, and factorised together. Nothing here is certified: the library evaluates the result.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from jaxltl.core.array_types import Floats
from jaxltl.core.policies.finite_memory import FiniteMemoryPolicy
from jaxltl.core.values.partial_observability.problem import BeliefProblem

_DECAY, _SQUARES = 0.9, 0.99  # of Adam (Kingma and Ba 2015)
# memory states, scale of the random logits and rate of each start
_STARTS = ((1, 0.0, 0.3), (1, 0.0, 0.05), (2, 0.5, 0.2), (2, 1.0, 0.1), (3, 0.5, 0.2))
_STEPS = 80  # of a start
_DENSE = 150  # pairs of states and memory states of full matrices
_LARGE = 1200  # pairs of states and memory states of more than one start
_SHARE = 0.1  # of the seconds of an exploration
_SLOW = 1e5  # expected steps beyond which a chain counts as singular
_FALL = 0.1  # share of the best value that a step may lose before a smaller one is tried
_NEVER = 1e-7  # probability below which an action is left out of the result


@dataclass
class SoftmaxAscent:
    """A controller of M memory states that improves by steps."""

    problem: BeliefProblem
    action: Floats  # float64[M, O, A], logits
    update: Floats  # float64[M, O, M], logits of the next memory state by the observation entered
    rate: float = 0.1
    moments: tuple[Floats, ...] | None = None
    best: tuple[float, Floats, Floats] | None = None  # the largest value so far, and its logits
    num_steps: int = 0

    @classmethod
    def random(
        cls, problem: BeliefProblem, num_memory: int, scale: float, seed: int
    ) -> SoftmaxAscent:
        """A random controller; uniform for scale 0."""
        rng, pomdp = np.random.default_rng(seed), problem.pomdp
        shape = num_memory, pomdp.num_observations
        action = scale * rng.normal(size=(*shape, pomdp.num_actions))
        return cls(problem, action, scale * rng.normal(size=(*shape, num_memory)))

    @property
    def weights(self) -> tuple[Floats, Floats]:
        """Distributions of actions and of memory states."""
        legal = self.problem.available
        legal = legal | ~legal.any(1, keepdims=True)  # observations that do not occur
        return _softmax(np.where(legal, self.action, -np.inf)), _softmax(self.update)

    def step(self) -> float:
        """One step of Adam; returns the value before it, NaN where the chain is singular."""
        value, gradient = self.gradient()
        sign = 1 if self.problem.maximize else -1
        possible = value >= -1e-6 and (self.problem.is_reward or value <= 1 + 1e-6)
        known = -np.inf if self.best is None else sign * self.best[0]
        if not possible or sign * value < known - _FALL * abs(known):
            if self.best is None:
                return np.nan
            # A step that went too far, or a chain that is nearly singular.
            _, self.action, self.update = self.best
            self.rate, self.moments, self.num_steps = self.rate / 3, None, 0
            return self.best[0]
        if sign * value > known:
            self.best = value, self.action, self.update
        self.num_steps += 1
        before = self.moments or tuple(np.zeros_like(g) for g in (*gradient, *gradient))
        first = [_DECAY * m + (1 - _DECAY) * g for m, g in zip(before, gradient, strict=False)]
        second = [
            _SQUARES * m + (1 - _SQUARES) * g**2 for m, g in zip(before[2:], gradient, strict=True)
        ]
        self.moments = (*first, *second)
        change = [
            m / (1 - _DECAY**self.num_steps) / (np.sqrt(s / (1 - _SQUARES**self.num_steps)) + 1e-12)
            for m, s in zip(first, second, strict=True)
        ]
        self.action = np.clip(self.action + sign * self.rate * change[0], -30, 30)
        self.update = np.clip(self.update + sign * self.rate * change[1], -30, 30)
        return value

    def gradient(self) -> tuple[float, tuple[Floats, Floats]]:
        """The value from the initial belief, and its gradient in the logits."""
        from scipy.sparse import bmat, csr_array, diags_array, eye_array
        from scipy.sparse.linalg import splu

        problem, seen = self.problem, self.problem.observation
        act, keep = self.weights
        num_memory, num = len(act), problem.num_states
        if num_memory * num <= _DENSE:
            return self._dense_gradient(act, keep)
        gain = np.zeros((num_memory, num))
        steps = []
        for m in range(num_memory):
            matrix = csr_array((num, num))
            for a, transition in enumerate(problem.transition):
                matrix = matrix + diags_array(act[m, seen, a]) @ transition
                gain[m] += act[m, seen, a] * problem.gain[a]
            steps.append(csr_array(matrix))
        blocks = [
            [steps[m] @ diags_array(keep[m, seen, k]) for k in range(num_memory)]
            for m in range(num_memory)
        ]
        system = (eye_array(num_memory * num) - bmat(blocks)).tocsc()
        try:
            factors = splu(system)
        except RuntimeError:  # singular
            return np.nan, (np.zeros_like(act), np.zeros_like(keep))
        value = factors.solve(gain.ravel()).reshape(num_memory, num)
        start = np.zeros((num_memory, num))
        start[0] = problem.initial
        visits = factors.solve(start.ravel(), "T").reshape(num_memory, num)
        if not np.abs(visits).sum() < _SLOW:
            return np.nan, (np.zeros_like(act), np.zeros_like(keep))
        by_action, by_memory = np.zeros_like(act), np.zeros_like(keep)
        for m in range(num_memory):
            after = (keep[m, seen].T * value).sum(0)
            for a, transition in enumerate(problem.transition):
                worth = visits[m] * (problem.gain[a] + transition @ after)
                by_action[m, :, a] = np.bincount(seen, worth, minlength=act.shape[1])
            entered = steps[m].T @ visits[m]
            for k in range(num_memory):
                by_memory[m, :, k] = np.bincount(seen, entered * value[k], minlength=act.shape[1])
        return float(problem.initial @ value[0]) + problem.initial_gain, (
            _softmax_gradient(act, by_action),
            _softmax_gradient(keep, by_memory),
        )

    def _dense_gradient(self, act: Floats, keep: Floats) -> tuple[float, tuple[Floats, Floats]]:
        """The same by full matrices, for small chains."""
        problem, seen = self.problem, self.problem.observation
        table, group = self._dense
        act_at, keep_at = act[:, seen], keep[:, seen]
        mixed = np.einsum("mna,ant->mnt", act_at, table)
        gain = np.einsum("mna,an->mn", act_at, problem.gain)
        system = np.eye(gain.size) - np.einsum("mnt,mtk->mnkt", mixed, keep_at).reshape(
            gain.size, gain.size
        )
        start = np.zeros_like(gain)
        start[0] = problem.initial
        try:
            value = np.linalg.solve(system, gain.ravel()).reshape(gain.shape)
            visits = np.linalg.solve(system.T, start.ravel()).reshape(gain.shape)
        except np.linalg.LinAlgError:
            return np.nan, (np.zeros_like(act), np.zeros_like(keep))
        if not np.abs(visits).sum() < _SLOW:
            return np.nan, (np.zeros_like(act), np.zeros_like(keep))
        after = np.einsum("mtk,kt->mt", keep_at, value)
        worth = visits[:, None] * (problem.gain + np.einsum("ant,mt->man", table, after))
        entered = np.einsum("mn,mnt->mt", visits, mixed)
        by_action = np.einsum("man,no->moa", worth, group)
        by_memory = np.einsum("mt,kt,to->mok", entered, value, group)
        return float(problem.initial @ value[0]) + problem.initial_gain, (
            _softmax_gradient(act, by_action),
            _softmax_gradient(keep, by_memory),
        )

    @cached_property
    def _dense(self) -> tuple[Floats, Floats]:
        """Transitions ``float64[A, N, N]``, and the observation of each state ``float64[N, O]``."""
        problem = self.problem
        table = np.stack([matrix.toarray() for matrix in problem.transition])
        return table, np.eye(problem.pomdp.num_observations)[problem.observation]

    def policies(self) -> list[FiniteMemoryPolicy]:
        """The controller with its likeliest memory updates, with random actions and with the likeliest ones."""
        if self.best is not None:
            _, self.action, self.update = self.best
        act, keep = self.weights
        count = self.problem.pomdp.num_observations
        act = np.where(act < _NEVER, 0, act)
        act = (act / act.sum(-1, keepdims=True)).transpose(1, 0, 2)
        update = keep.argmax(-1).T.astype(np.int64)
        begins = np.zeros(count, np.int64)
        both = [FiniteMemoryPolicy(act, begins, update)]
        if (act.max(-1) < 1).any():
            both.append(FiniteMemoryPolicy(act.argmax(-1), begins, update))
        return both


def _softmax(logits: Floats) -> Floats:
    weight = np.exp(logits - logits.max(-1, keepdims=True))
    result: Floats = weight / weight.sum(-1, keepdims=True)
    return result


def _softmax_gradient(weight: Floats, slope: Floats) -> Floats:
    result: Floats = weight * (slope - (weight * slope).sum(-1, keepdims=True))
    return result


def first_controllers(problem: BeliefProblem, seconds: float) -> list[FiniteMemoryPolicy]:
    """Controllers of one to three memory states by gradient ascent; of large models fewer ones."""
    policies = SoftmaxAscent.random(problem, 1, 0.0, 0).policies()
    if not problem.num_states or (problem.is_reward and problem.has_infinite):
        return policies
    end = time.monotonic() + _SHARE * seconds
    steps = _STEPS if problem.num_states <= _LARGE else _STEPS // 2
    for number, (num_memory, scale, rate) in enumerate(_STARTS):
        if number and num_memory * problem.num_states > _LARGE:
            continue
        ascent = SoftmaxAscent.random(problem, num_memory, scale, number)
        ascent.rate = rate
        for _ in range(steps):
            if not np.isfinite(ascent.step()) or time.monotonic() > end:
                break
        policies += ascent.policies()
        if time.monotonic() > end:
            break
    return policies
