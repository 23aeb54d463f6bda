"""Controllers of certified value, which continue from the beliefs where an exploration ends."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from jaxltl.core.array_types import Floats, Integers
from jaxltl.core.policies.finite_memory import FiniteMemoryPolicy
from jaxltl.core.sparse.rows import concatenated_ranges, offsets_from_counts
from jaxltl.core.sparse.solvers import reachability as solver
from jaxltl.core.values.partial_observability.beliefs import Measures
from jaxltl.core.values.partial_observability.chains import (
    JointChain,
    Machine,
    chain_with_ends,
    joint_chain,
    machine_of,
)
from jaxltl.core.values.partial_observability.problem import BeliefProblem

_TOLERANCE = 1e-7  # width of the bounds of a controller's value
_ALTERNATIVES = 200  # frozen memory states that are tried at beliefs of one observation
_LARGEST_TABLE = 50_000_000  # entries of the tables of a policy


@dataclass(frozen=True)
class MemorySteps:
    """Memory states that know their observation: an action, and the memory state after each observation."""

    observation: Integers  # int[E]
    action: Integers  # int[E]
    key: Integers  # int[K], ascending: number * O + next observation
    to: Integers  # int[K], memory states

    @property
    def size(self) -> int:
        """E."""
        return self.observation.size


@dataclass(frozen=True)
class Evaluated:
    """A controller's value on the pairs of a state and a memory state that it reaches."""

    initial: float  # the certified bound from the initial measure
    chain: JointChain
    bound: Floats  # float64[P], the certified bound of each pair


class Library:
    """Memory states with the certified values that they attain from each state.

    The first ones are those of given finite-memory policies, for every observation; frozen steps follow.
    """

    def __init__(self, problem: BeliefProblem, policies: list[FiniteMemoryPolicy]) -> None:
        self.problem = problem
        for policy in policies:
            if policy.label_on != "entry":
                raise ValueError(
                    "controllers: a policy reads observations on exit; give policies with label_on='entry'."
                )
        machines = [machine_of(problem.pomdp, policy) for policy in policies]
        sizes = [int(policy.next_memory.shape[1]) for policy in policies]
        self.offset = offsets_from_counts(np.array(sizes))
        count, num = problem.pomdp.num_observations, problem.pomdp.num_actions
        self.num_blocks = int(self.offset[-1])
        self.weight = np.zeros((self.num_blocks, count, num))
        self.update = np.zeros((self.num_blocks, count), np.int64)
        self.start = np.zeros((len(machines), count), np.int64)
        every = np.arange(count)
        for i, machine in enumerate(machines):
            self.start[i] = self.offset[i] + machine.start
            for q in range(sizes[i]):
                block = self.offset[i] + q
                self.weight[block] = machine.act(np.full(count, q), every)
                self.update[block] = self.offset[i] + machine.next(np.full(count, q), every, every)
        self.steps = MemorySteps(*(np.zeros(0, np.int64) for _ in range(4)))
        self.fallback = 0
        self._value = np.zeros((self.num_blocks, problem.num_states))
        for block in range(self.num_blocks):
            self._value[block] = self._block_value(block)
        self._frozen: list[tuple[Integers, Integers, Floats]] = []  # memory, state, value

    # --- machines -----------------------------------------------------------------------------------

    def machine(self, start: Integers, steps: MemorySteps | None = None) -> Machine:
        """The controller of memory states `start` ``int[O]``; its new steps follow those that are frozen."""
        count = self.problem.pomdp.num_observations
        frozen, blocks = self.steps, self.num_blocks
        action, key, to = frozen.action, frozen.key, frozen.to
        if steps is not None:
            action = np.concatenate([action, steps.action])
            key = np.concatenate([key, steps.key + frozen.size * count])
            to = np.concatenate([to, steps.to])
        one = np.eye(self.problem.pomdp.num_actions)

        def act(memory: Integers, seen: Integers) -> Floats:
            weight = np.empty((memory.size, one.shape[0]))
            general = memory < blocks
            weight[general] = self.weight[memory[general], seen[general]]
            weight[~general] = one[action[memory[~general] - blocks]]
            return weight

        def after(memory: Integers, before: Integers, seen: Integers) -> Integers:
            kept = np.full(memory.size, self.fallback, np.int64)
            general = memory < blocks
            kept[general] = self.update[memory[general], seen[general]]
            if key.size:
                wanted = (memory[~general] - blocks) * count + seen[~general]
                place = np.minimum(np.searchsorted(key, wanted), key.size - 1)
                kept[~general] = np.where(key[place] == wanted, to[place], self.fallback)
            return kept

        return Machine(start, act, after)

    def evaluate(self, machine: Machine, initial: Integers) -> Evaluated:
        """The certified value of a controller from some states ``int[I]``."""
        problem = self.problem
        chain = joint_chain(machine, problem.transition, problem.observation, initial)
        gain = chain.mean(problem.gain)
        if problem.is_reward:
            mdp, goal = chain_with_ends(chain.matrix, np.zeros(gain.size))
            cost = np.append(gain, [0.0, 0.0])
            sink = np.roll(goal, 1)
            bounds = solver.total_reward(
                mdp, cost, sink | goal, maximize=False, tolerance=_TOLERANCE, depth=chain.num_terms
            )
        else:
            mdp, goal = chain_with_ends(chain.matrix, np.minimum(gain, 1))
            bounds = solver.reachability(
                mdp, goal, maximize=True, tolerance=_TOLERANCE, depth=chain.num_terms
            )
        bound = (bounds.lower if problem.maximize else bounds.upper)[: gain.size]
        number = problem.initial > 0
        first = np.zeros(problem.num_states)
        first[chain.state[: initial.size]] = bound[: initial.size]
        mean = float(problem.initial[number] @ first[number]) if number.any() else 0.0
        sign = -1 if problem.maximize else 1
        total = (mean + problem.initial_gain) * (1 + sign * 1e-13)
        return Evaluated(total, chain, bound)

    def _block_value(self, block: int) -> Floats:
        problem = self.problem
        count = problem.pomdp.num_observations
        everywhere = np.arange(problem.num_states)
        if not everywhere.size:
            return np.zeros(0)
        done = self.evaluate(self.machine(np.full(count, block)), everywhere)
        value = np.zeros(problem.num_states)
        value[done.chain.state[: everywhere.size]] = done.bound[: everywhere.size]
        return value

    # --- values at beliefs --------------------------------------------------------------------------

    def best_at(self, measures: Measures) -> tuple[Floats, Integers]:
        """The best certified value at each measure, and its memory state."""
        problem, size = self.problem, self.problem.num_states
        values = np.asarray(measures.matrix(size) @ self._value.T)
        if not problem.maximize:
            values = np.where(np.isnan(values), np.inf, values)
        pick = values.argmax(1) if problem.maximize else values.argmin(1)
        best, memory = values[np.arange(measures.size), pick], pick.astype(np.int64)
        if not self._frozen or not measures.size:
            return best, memory
        seen = problem.observation[measures.state[measures.start[:-1]]]
        for o in np.unique(seen).tolist():
            if o not in self._alpha:
                continue
            number, alpha = self._alpha[o]
            some = np.flatnonzero(seen == o)
            value = (measures.take(some).matrix(size) @ alpha).toarray()
            pick = value.argmax(1)
            value = value[np.arange(some.size), pick]
            better = value > best[some] + 1e-9
            best[some[better]] = value[better]
            memory[some[better]] = number[pick[better]]
        return best, memory

    def joined(self, steps: MemorySteps) -> MemorySteps:
        """The frozen steps and new ones, which follow them."""
        count, before = self.problem.pomdp.num_observations, self.steps
        return MemorySteps(
            np.concatenate([before.observation, steps.observation]),
            np.concatenate([before.action, steps.action]),
            np.concatenate([before.key, steps.key + before.size * count]),
            np.concatenate([before.to, steps.to]),
        )

    def freeze(self, steps: MemorySteps, evaluated: Evaluated, start: Integers) -> Integers:
        """Keeps the steps that a controller reaches, with their values, and no others; its new start."""
        count, blocks = self.problem.pomdp.num_observations, self.num_blocks
        chain, whole = evaluated.chain, self.joined(steps)
        kept = np.unique(np.append(chain.memory, start))
        kept = kept[kept >= blocks] - blocks
        number = np.full(whole.size, -1)
        number[kept] = np.arange(kept.size)
        source = number[whole.key // count]
        memory = whole.to.copy()
        inner = memory >= blocks
        memory[inner] = number[memory[inner] - blocks] + blocks
        used = (source >= 0) & (memory >= np.where(inner, blocks, 0))
        key = source[used] * count + whole.key[used] % count
        self.steps = MemorySteps(whole.observation[kept], whole.action[kept], key, memory[used])
        new = chain.memory >= blocks
        pairs = number[chain.memory[new] - blocks] + blocks, chain.state[new], evaluated.bound[new]
        # Of minima, steps are unsafe away from their belief: unseen pairs have no value.
        self._frozen = [pairs] if self.problem.maximize else []
        self.__dict__.pop("_alpha", None)
        start, moved = start.copy(), start >= blocks
        start[moved] = number[start[moved] - blocks] + blocks
        return start

    def alternatives(
        self, measures: Measures, evaluated: Evaluated, num_frozen: int
    ) -> tuple[Floats, Integers]:
        """The best values at measures of the new steps of a controller, and their memory states."""
        kept = self._frozen
        new = evaluated.chain.memory >= self.num_blocks + num_frozen
        self._frozen = [
            (evaluated.chain.memory[new], evaluated.chain.state[new], evaluated.bound[new])
        ]
        self.__dict__.pop("_alpha", None)
        best = self.best_at(measures)
        self._frozen = kept
        self.__dict__.pop("_alpha", None)
        return best

    @cached_property
    def _alpha(self) -> dict[int, tuple[Integers, np.ndarray]]:
        """For each observation frozen memory states, the newest ones, and their values ``[N, number]``."""
        from scipy.sparse import csr_array

        memory, state, value = (np.concatenate(x) for x in zip(*self._frozen, strict=True))
        seen = self.problem.observation[state]
        order = np.lexsort((memory, seen))
        memory, state, value, seen = memory[order], state[order], value[order], seen[order]
        _, starts = np.unique(seen, return_index=True)
        table = {}
        for first, last in pairwise([*starts, seen.size]):
            numbers = np.unique(memory[first:last])[-_ALTERNATIVES:]
            part = slice(first + np.searchsorted(memory[first:last], numbers[0]), last)
            column = np.searchsorted(numbers, memory[part])
            shape = (self.problem.num_states, numbers.size)
            table[int(seen[first])] = (
                numbers,
                csr_array((value[part], (state[part], column)), shape=shape),
            )
        return table

    # --- policies -----------------------------------------------------------------------------------

    def policy(self, start: Integers, reached: Integers) -> FiniteMemoryPolicy:
        """The finite-memory policy of memory states `reached`, which are closed under updates."""
        pomdp = self.problem.pomdp
        count, num = pomdp.num_observations, pomdp.num_actions
        used = np.unique(np.append(reached, [self.fallback, *start]))
        machine = self.machine(start)
        every = np.arange(count)
        while True:  # updates by observations that do not occur
            size = used.size
            memory, seen = np.repeat(used, count), np.tile(every, size)
            after = machine.next(memory, seen, seen)
            used = np.union1d(used, after)
            if used.size == size:
                break
        if used.size * count > _LARGEST_TABLE:
            raise ValueError(
                f"the controller has {used.size} memory states for {count} observations, too many for "
                "the tables of a policy."
            )
        weight = np.zeros((count, used.size, num))
        update = np.zeros((count, used.size), np.int64)
        legal = pomdp.available
        first = legal.argmax(1)
        for i in range(count):
            seen = np.full(used.size, i)
            weight[i] = machine.act(used, seen)
            wrong = ((weight[i] > 0) & ~legal[i]).any(1)
            weight[i, wrong] = np.eye(num)[first[i]]
            update[i] = np.searchsorted(used, machine.next(used, seen, seen))
        begins = np.searchsorted(used, start)
        if ((weight == 0) | (weight == 1)).all():
            return FiniteMemoryPolicy(weight.argmax(-1).astype(np.int32), begins, update)
        return FiniteMemoryPolicy(weight, begins, update)


def steps_of_rows(
    observation: Integers,
    action: Integers,
    edges: tuple[Integers, Integers, Integers],
    num_observations: int,
) -> MemorySteps:
    """MemorySteps with edges (number, next observation, memory state)."""
    source, seen, to = edges
    key = source * num_observations + seen
    order = np.argsort(key, kind="stable")
    return MemorySteps(observation, action, key[order], to[order])


def row_edges(start: Integers, rows: Integers) -> tuple[Integers, Integers]:
    """The entries of some rows, and the place of the row of each."""
    count = start[rows + 1] - start[rows]
    return concatenated_ranges(start[rows], count), np.arange(rows.size).repeat(count)
