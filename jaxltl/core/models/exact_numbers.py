"""Rational probabilities and rewards of sparse models, as the source of a model writes them."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction

import numpy as np

from jaxltl.core.models.number_source import NumberSource, Part, RationalNumbers
from jaxltl.core.models.sparse import Rewards, SparseMDP
from jaxltl.core.sparse.exact.model import ZERO, ExactMDP, pairs

_DENOMINATOR = 10**6  # of fractions as which doubles are read; chance agreement is below 1e-3
_CLOSE = 1e-12  # relative difference of a number and its double, after products


def exact_numbers(model: SparseMDP) -> RationalNumbers:
    """The rational numbers of a model: those of its source, where they round to its doubles.

    Otherwise they are the doubles, as rows that are divided by their sums.
    """
    source: NumberSource = model.numbers
    if source.read is None:
        return _doubles_of(model)
    for successor, probability, numbers in source.known:
        if successor is model.successor and probability is model.probability:
            return numbers
    written = source.read(model)
    if written is None or not _agrees(written.mdp, model):
        written = _doubles_of(model)
    source.known[:] = [(model.successor, model.probability, written)]
    return written


def _doubles_of(model: SparseMDP) -> RationalNumbers:
    return RationalNumbers(
        _normalised(model, [Fraction(x) for x in model.host.probability.tolist()]), {}
    )


def decimal_numbers(model: SparseMDP) -> RationalNumbers:
    """Rows and rewards of a text file, read as fractions and decimals: see `written_probabilities`."""
    rewards = {
        name: (_written(reward.state), _written(reward.choice), _written(reward.transition))
        for name, reward in model.rewards.items()
    }
    return RationalNumbers(_normalised(model, written_probabilities(model)), rewards)


def written_probabilities(model: SparseMDP) -> list[Fraction]:
    """The number of each entry: a fraction or a decimal that rounds to it.

    A double stands for the fraction with a denominator of at most 10^6 that rounds to it, else for
    its shortest decimal; in rows of which these numbers do not sum to one, for itself.
    """
    probability = [Fraction(x) for x in model.host.probability.tolist()]
    number = {x: written_number(float(x)) for x in set(probability)}
    for entries in pairs(model.host.entry_start.tolist()):
        written = [number[probability[e]] for e in entries]
        if sum(written) == 1:
            probability[entries.start : entries.stop] = written
    return probability


def written_number(x: float) -> Fraction:
    """The fraction or the decimal that a double stands for in a text."""
    simple = Fraction(x).limit_denominator(_DENOMINATOR)
    return simple if float(simple) == x else Fraction(repr(x))


def exact_reward(
    model: SparseMDP, numbers: RationalNumbers, reward: Rewards, name: str | None
) -> list[Fraction]:
    """Expected rewards of choices; ValueError if some are not finite."""
    state, choice, transition = numbers.rewards.get(name or "", (None, None, None))
    state = _agreeing(state, reward.state)
    choice = _agreeing(choice, reward.choice)
    transition = _agreeing(transition, reward.transition)
    total = [ZERO] * model.num_rows if choice is None else list(choice)
    if state is not None:
        total = [x + state[s] for x, s in zip(total, model.host.state.tolist(), strict=True)]
    if transition is not None:
        successor = model.host.successor.tolist()
        for r, entries in enumerate(pairs(model.host.entry_start.tolist())):
            row = numbers.mdp.rows[r]
            total[r] += sum((row[successor[e]] * transition[e] for e in entries), ZERO)
    return total


def exact_state_reward(
    numbers: RationalNumbers, reward: Rewards, name: str | None
) -> list[Fraction]:
    """Rewards of states."""
    state = _agreeing(numbers.rewards.get(name or "", (None,))[0], reward.state)
    return [ZERO] * numbers.mdp.num_states if state is None else list(state)


def _agreeing(written: Part, values: object) -> Part:
    """The numbers of a source if they round to those of the model, which may have changed since."""
    if values is None:
        return None
    doubles = np.asarray(values, float).tolist()
    if written is not None and len(written) == len(doubles):
        pairs_of = zip(written, doubles, strict=True)
        if all(abs(float(x) - y) <= _CLOSE * abs(y) for x, y in pairs_of):
            return written
    return [Fraction(x) for x in doubles]


def _written(values: object) -> Part:
    if values is None:
        return None
    return [written_number(x) for x in np.asarray(values, float).tolist()]


def _normalised(model: SparseMDP, probability: Sequence[Fraction]) -> ExactMDP:
    """Rows that sum to one, of the probabilities of a model's entries."""
    successor, rows = model.host.successor.tolist(), []
    for entries in pairs(model.host.entry_start.tolist()):
        total = sum((probability[e] for e in entries), ZERO)
        rows.append({successor[e]: probability[e] / total for e in entries})
    return ExactMDP(model.host.row_start.tolist(), rows)


def _agrees(mdp: ExactMDP, model: SparseMDP) -> bool:
    """True if the rows are distributions with the support of a model and round to its numbers."""
    host = model.host
    starts = host.row_start.tolist(), host.entry_start.tolist()
    if list(mdp.row_start) != starts[0] or len(mdp.rows) != host.num_rows:
        return False
    successor, probability = host.successor.tolist(), host.probability.tolist()
    for row, entries in zip(mdp.rows, pairs(starts[1]), strict=True):
        if row.keys() != set(successor[entries.start : entries.stop]) or sum(row.values()) != 1:
            return False
        for e in entries:
            p = row[successor[e]]
            if not p > 0 or abs(float(p) - probability[e]) > _CLOSE * probability[e]:
                return False
    return True
