"""Multi-objective queries by enumeration of the deterministic policies of an unfolded model.

Memory: which sets of states were visited. A mixture of policies that are positional on the unfolded
model attains all that any policy attains, but for maximised rewards that are infinite: these are
infinite if a policy of the mixture visits an end component without cost in which reward is earned,
or misses the target of the reward.
"""

import itertools
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from scipy.optimize import linprog

INFINITE = None
MAX_POLICIES = 300


@dataclass(frozen=True)
class Question:
    """An objective: the probability of reaching a set, or a reward, until a set if there is one."""

    maximize: bool
    target: tuple[int, ...] | None = None
    reward: tuple[Fraction, ...] | None = None  # of each row


class Unfolded:
    """A model with rows ``[(state, {successor: Fraction})]`` and the sets visited so far."""

    def __init__(self, size, rows, questions, start=0):
        self.questions = questions
        targets = [q.target for q in questions]

        def seen(memory, s):
            return tuple(
                m or (t is not None and s in t) for m, t in zip(memory, targets, strict=True)
            )

        first = (start, seen((False,) * len(targets), start))
        self.states, todo, self.choices = [], [first], {}
        while todo:
            state = todo.pop()
            if state in self.choices:
                continue
            self.states.append(state)
            s, memory = state
            self.choices[state] = [
                (r, {(t, seen(memory, t)): p for t, p in ahead.items()})
                for r, (owner, ahead) in enumerate(rows)
                if owner == s
            ]
            todo += [t for _, ahead in self.choices[state] for t in ahead]

    def policies(self):
        """Deterministic positional policies; those that agree on what they reach appear once."""
        stack = [({}, [self.states[0]])]
        while stack:
            policy, todo = stack.pop()
            todo = [s for s in todo if s not in policy]
            if not todo:
                yield policy
                continue
            for choice in self.choices[todo[0]]:
                stack.append(({**policy, todo[0]: choice}, [*todo[1:], *choice[1]]))

    def outcomes(self, needed):
        """The distinct outcomes in which the costs in `needed` are finite; None if a case is left out."""
        if next(itertools.islice(self.policies(), MAX_POLICIES, None), None) is not None:
            return None
        endless, mixed = self._endless(needed)
        if mixed:
            return None
        outcomes = set()
        for policy in self.policies():
            values = self._values(policy)
            if all(values[i] is not INFINITE for i in needed):
                visits = tuple(
                    x is INFINITE or not states.isdisjoint(policy)
                    for x, states in zip(values, endless, strict=True)
                )
                outcomes.add((values, visits))
        return sorted(outcomes, key=str)

    def _values(self, policy):
        """The values of a policy, by elimination in fractions."""
        recurrent = {s for group in self._recurrent(policy) for s in group}
        values = []
        for i, q in enumerate(self.questions):
            earned = {s: self._earned(i, s, choice[0]) for s, choice in policy.items()}
            if q.reward is None:
                final = {s: Fraction(int(s[1][i])) for s in recurrent}
                values.append(self._expected(policy, final, {}))
            elif any(earned[s] or self._pending(i, s) for s in recurrent):
                values.append(INFINITE)
            else:
                values.append(self._expected(policy, dict.fromkeys(recurrent, Fraction(0)), earned))
        return tuple(values)

    def _earned(self, i, state, row):
        q = self.questions[i]
        if q.reward is None or (q.target is not None and state[1][i]):
            return Fraction(0)
        return q.reward[row]

    def _pending(self, i, state):
        q = self.questions[i]
        return q.reward is not None and q.target is not None and not state[1][i]

    def _recurrent(self, policy):
        """The bottom components of the chain of a policy."""
        states = list(policy)
        number = {s: i for i, s in enumerate(states)}
        matrix = np.eye(len(states), dtype=bool)
        for s in states:
            matrix[number[s], [number[t] for t in policy[s][1]]] = True
        for _ in range(len(states).bit_length() + 1):
            matrix = matrix.astype(int) @ matrix.astype(int) > 0
        groups = {
            tuple(np.flatnonzero(row))
            for row, column in zip(matrix, matrix.T, strict=True)
            if (row <= column).all()
        }
        return [[states[i] for i in group] for group in sorted(groups)]

    def _expected(self, policy, final, earned):
        """The value of the first state, from those of the final states."""
        equation = {
            s: (final[s], {}) if s in final else (earned.get(s, Fraction(0)), dict(choice[1]))
            for s, choice in policy.items()
        }
        for s in reversed(list(policy)):
            constant, weights = equation[s]
            leaves = 1 - weights.pop(s, Fraction(0))
            weights = {t: w / leaves for t, w in weights.items()}
            equation[s] = constant / leaves, weights
            for u, (c, w) in equation.items():
                if u != s and s in w:
                    share = w.pop(s)
                    for t, p in weights.items():
                        w[t] = w.get(t, 0) + share * p
                    equation[u] = c + share * equation[s][0], w
        return equation[self.states[0]][0]

    def _endless(self, needed):
        """For each maximised reward the states in which it can be made infinite without cost.

        Also whether some reward can be earned again and again at a cost only.
        """
        states, mixed = [set() for _ in self.questions], False
        for policy in self.policies():
            for group in self._recurrent(policy):
                cost = any(
                    self._earned(j, t, policy[t][0]) or self._pending(j, t)
                    for j in needed
                    for t in group
                )
                for i, q in enumerate(self.questions):
                    if q.reward is not None and q.maximize:
                        earns = any(self._earned(i, t, policy[t][0]) for t in group)
                        mixed |= earns and cost
                        if earns and not cost:
                            states[i] |= set(group)
        return states, mixed


def _program(points, limits, questions, goal):
    """Mixtures of points that meet thresholds with a margin t, the last unknown, and a goal."""
    constrained = [i for i, limit in enumerate(limits) if limit is not None]
    sign = [1 if q.maximize else -1 for q in questions]
    above, least = [], []
    for i in constrained:
        above.append([-sign[i] * float(x[i] or 0) for x in points] + [1.0])
        least.append(-sign[i] * float(limits[i]))
    return linprog(
        goal,
        A_ub=above or None,
        b_ub=least or None,
        A_eq=[[1.0] * len(points) + [0.0]],
        b_eq=[1.0],
        bounds=[(0, None)] * len(points) + [(None, 1.0) if goal[-1] else (0.0, 0.0)],
        options={"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10},
    )


def answer(model, limits, index=None):
    """Achievability of thresholds, as a margin, and the best value of one objective.

    The margin is positive if they can be met strictly, about zero on the boundary, negative if they
    cannot. None if a case is left out.
    """
    questions = model.questions
    costs = [i for i, q in enumerate(questions) if q.reward is not None and not q.maximize]
    outcomes = model.outcomes(costs)
    if outcomes is None:
        return None
    margin, best = _answer(outcomes, questions, limits, index)
    if margin < -1e-9 and index in costs:
        outcomes = model.outcomes([i for i in costs if i != index])
        return outcomes if outcomes is None else _answer(outcomes, questions, limits, index, np.inf)
    return margin, best


def _answer(outcomes, questions, limits, index, value=None):
    gains = [i for i, q in enumerate(questions) if q.maximize and q.reward is not None]
    margin, best = -np.inf, None
    for size in range(len(gains) + 1):
        for endless in itertools.combinations(gains, size):
            finite = [
                i
                for i in range(len(questions))
                if i not in endless and (i != index or value is None)
            ]
            fit = [(v, e) for v, e in outcomes if all(v[i] is not INFINITE for i in finite)]
            points = [v for v, _ in fit]
            rest = [None if i in endless else x for i, x in enumerate(limits)]
            if not fit or not all(
                _largest(points, [e[i] for _, e in fit], rest, questions) > 1e-7 for i in endless
            ):
                continue
            goal = [0.0] * len(points)
            margin = max(margin, -_program(points, rest, questions, [*goal, -1.0]).fun)
            if index is None or margin < -1e-9:
                continue
            sign = 1 if questions[index].maximize else -1
            if value is not None or index in endless:
                found = np.inf
            else:
                found = sign * _largest(points, [sign * v[index] for v in points], rest, questions)
            best = found if best is None else sign * max(sign * best, sign * found)
    return margin, best


def _largest(points, goal, limits, questions):
    """The largest mean of a goal of mixtures that meet thresholds; minus infinity without any."""
    found = _program(points, limits, questions, [*(-float(x) for x in goal), 0.0])
    return -found.fun if found.status == 0 else -np.inf
