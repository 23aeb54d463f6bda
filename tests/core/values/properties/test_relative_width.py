"""``relative=True``: bounds of tiny probabilities against fractions, in every kind of container."""

import itertools
import re
from fractions import Fraction

import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.models.sparse import make_sparse
from jaxltl.core.types import Status
from jaxltl.core.values.properties.solve_property import solve_property
from tests.sparse_models import exact_solve
from tests.support import seeds

TOLERANCE = 1e-6
OBJECTIVES = "max", "min"


def tiny_model(seed, num_states=6, chain=False, halvings=50):
    """Rows ``{t: 2^-k, u: 1 - 2^-k}``, and absorbing states; labels a and b are random."""
    rng = np.random.default_rng(seed)
    count = 1 if chain else rng.integers(1, 3, num_states)
    count = np.broadcast_to(count, num_states).copy()
    count[-2:] = 1
    rows = []
    for s, c in enumerate(count):
        for _ in range(c):
            if s >= num_states - 2:
                rows.append({s: 1.0})
                continue
            t, u = rng.choice(num_states, 2, replace=False)
            small = 2.0 ** -int(rng.integers(1, halvings))
            rows.append({int(t): small, int(u): 1 - small} if rng.random() < 0.8 else {int(t): 1.0})
            rows[-1] = {t: p for t, p in sorted(rows[-1].items()) if p}
    label = rng.random((num_states, 2)) < 0.4
    label[-2:] = [[True, False], [False, True]]
    return make_sparse(
        None if chain else np.concatenate([[0], count.cumsum()]),
        np.concatenate([[0], np.cumsum([len(row) for row in rows])]),
        [t for row in rows for t in row],
        [p for row in rows for p in row.values()],
        initial=np.eye(num_states)[0],
        label=label,
        propositions=["a", "b"],
    )


def ladder(num_steps, halvings):
    """Each step goes on with probability ``2^-k`` and falls otherwise; or it tries it twice."""
    small, size = 2.0**-halvings, num_steps + 2
    rows, count = [], []
    for s in range(num_steps):
        rows += [
            {s + 1: small, size - 1: 1 - small},
            {s: 0.25, s + 1: small / 2, size - 1: 0.75 - small / 2},
        ]
        count.append(2)
    rows += [{size - 2: 1.0}, {size - 1: 1.0}]
    label = np.zeros((size, 2), bool)
    label[-2, 0] = label[-1, 1] = True
    return make_sparse(
        np.concatenate([[0], np.cumsum([*count, 1, 1])]),
        np.concatenate([[0], np.cumsum([len(row) for row in rows])]),
        [t for row in rows for t in row],
        [p for row in rows for p in row.values()],
        initial=np.eye(size)[0],
        label=label,
        propositions=["a", "b"],
    )


def exact_rows(model):
    """Of each state its rows ``{t: p}``, normalised, in fractions."""
    found = []
    for s in range(model.num_states):
        found.append([])
        for r in range(*np.asarray(model.row_start)[s : s + 2]):
            some = range(*np.asarray(model.entry_start)[r : r + 2])
            row = {int(model.successor[e]): Fraction(float(model.probability[e])) for e in some}
            total = sum(row.values())
            found[-1].append({t: p / total for t, p in row.items()})
    return found


def reached(chain, goal, stay):
    """Probabilities of ``stay U goal`` in a chain of rows ``{t: p}``."""
    size, able = len(chain), set(goal)
    while True:
        more = {s for s in stay if set(chain[s]) & able} - able
        if not more:
            break
        able |= more
    inner = [s for s in able if s not in goal]
    value = [Fraction(int(s in goal)) for s in range(size)]
    matrix = [[Fraction(int(s == t)) - chain[s].get(t, 0) for t in inner] for s in inner]
    right = [sum((p for t, p in chain[s].items() if t in goal), Fraction(0)) for s in inner]
    for s, x in zip(inner, exact_solve(matrix, right) if inner else [], strict=True):
        value[s] = x
    return value


def recurrent(chain, accepts):
    """The states of bottom components with a property of the set of their states."""
    size, found = len(chain), set()
    ahead = []
    for s in range(size):
        seen = {s}
        while more := {t for u in seen for t in chain[u]} - seen:
            seen |= more
        ahead.append(seen)
    for s in range(size):
        if all(s in ahead[t] for t in ahead[s]) and accepts(ahead[s]):
            found |= ahead[s]
    return found


def values_in_chain(chain, a, b):
    """The probability of each formula from each state, as fractions."""
    every = set(range(len(chain)))
    out = [s for s in every if s not in a]

    def complement(x):
        return [1 - p for p in x]

    return {
        "F a": reached(chain, a, every),
        "!b U a": reached(chain, a, every - b),
        "G !b": complement(reached(chain, b, every)),
        "!(F b)": complement(reached(chain, b, every)),
        "!b W a": complement(reached(chain, b - a, set(out))),
        "a R !b": complement(reached(chain, b, set(out))),
        "!(a R !b)": reached(chain, b, set(out)),
        "F G a": reached(chain, recurrent(chain, lambda x: x <= a), every),
        "G F a": reached(chain, recurrent(chain, lambda x: bool(x & a)), every),
        "!(G F a)": reached(chain, recurrent(chain, lambda x: not x & a), every),
    }


def exact_values(model, objective):
    """The optimum over deterministic memoryless policies, of each formula from each state."""
    rows = exact_rows(model)
    a, b = (set(np.flatnonzero(np.asarray(model.label)[:, i]).tolist()) for i in range(2))
    best = None
    for policy in itertools.product(*rows):
        found = values_in_chain(policy, a, b)
        pick = max if objective == "max" else min
        best = (
            found
            if best is None
            else {f: [pick(x, y) for x, y in zip(best[f], found[f], strict=True)] for f in found}
        )
    return best


def as_property(formula, objective):
    path = re.sub(r"\b([ab])\b", r'"\1"', formula)
    return f"P{objective}=? [ {path} ]"


def require_relative(solution, exact, where):
    """Bounds hold the exact value, and are as narrow as their status says."""
    status = np.max(np.asarray(solution.status))
    for low, high, x in zip(solution.lower, solution.upper, exact, strict=True):
        low, high = Fraction(float(low)), Fraction(float(high))
        assert low <= x <= high, where
        if status == Status.CONVERGED:
            assert high - low <= Fraction(TOLERANCE) * x, (
                *where,
                float(x),
                float(low),
                float(high),
            )
    return status == Status.CONVERGED


def answers(model, formula, objective):
    """The same probability by each solver, at each state of the model."""
    states = np.arange(model.num_states)
    options = {"objective": objective, "tolerance": TOLERANCE, "relative": True}
    yield jl.optimal_satisfaction(model, formula, states=states, **options)
    product = jl.product(model, formula)
    found = jl.optimal_satisfaction(product, **options)
    at = states, np.asarray(product.initial_memory)
    yield found.replace(**{x: np.asarray(getattr(found, x))[at] for x in ("lower", "upper")})
    text = as_property(formula, objective)
    yield solve_property(model, text, states=states, tolerance=TOLERANCE, relative=True)


def require_relative_widths(model):
    """The number of solutions, and of the converged ones."""
    many = good = 0
    for objective in OBJECTIVES:
        for formula, exact in exact_values(model, objective).items():
            for i, solution in enumerate(answers(model, formula, objective)):
                many += 1
                good += require_relative(solution, exact, (formula, objective, i))
    return many, good


@pytest.mark.few(1, 3)
@pytest.mark.parametrize("seed", range(2))
def test_converged_bounds_are_as_narrow_as_a_share_of_the_value(seed):
    for chain in (False, True):
        many, good = require_relative_widths(tiny_model(seed, chain=chain))
        assert good == many


@pytest.mark.parametrize("seed", seeds(2, 12, 60)[2:])
def test_converged_bounds_are_as_narrow_in_more_models(seed):
    many, good = require_relative_widths(tiny_model(seed, 5 + seed % 3, chain=seed % 4 == 0))
    assert good == many


def test_probabilities_down_to_the_250th_power_of_one_half():
    many, good = require_relative_widths(ladder(5, 50))
    assert good == many
    for num_steps, halvings in ((5, 50), (25, 10)):
        for text in ('Pmax=? [ G !"b" ]', 'Pmin=? [ G F "a" ]', 'Pmax=? [ !"b" W "a" ]'):
            found = solve_property(ladder(num_steps, halvings), text, relative=True)
            assert found.status == Status.CONVERGED
            assert found.lower[0] > 2.0**-270 and found.upper[0] <= 2.0**-249


@pytest.mark.parametrize("tolerance", [1e-6, 1e-11])
def test_bounded_complements_are_as_narrow_as_a_share_of_the_value(tolerance):
    for seed, objective in itertools.product(range(4), OBJECTIVES):
        model = tiny_model(seed)
        rows, pick = exact_rows(model), max if objective == "max" else min
        a, b = (np.asarray(model.label)[:, i] for i in range(2))
        for num_steps in (0, 1, 7, 40):
            safe = [Fraction(int(not x)) for x in b]
            free = list(safe)
            for _ in range(num_steps):
                image, other = (
                    [pick(sum(p * v[t] for t, p in row.items()) for row in some) for some in rows]
                    for v in (safe, free)
                )
                safe = [x * (not out) for x, out in zip(image, b, strict=True)]
                free = [
                    Fraction(0) if out else Fraction(1) if end else x
                    for x, out, end in zip(other, b, a, strict=True)
                ]
            for path, exact in (
                (f'G<={num_steps} !"b"', safe),
                (f'"a" R<={num_steps} !"b"', free),
            ):
                found = solve_property(
                    model,
                    f"P{objective}=? [ {path} ]",
                    states=np.arange(model.num_states),
                    tolerance=tolerance,
                    relative=True,
                )
                assert require_relative(found, exact, (seed, path, objective))


def test_widths_of_rewards_and_of_filters_are_shares_of_the_value_too():
    model = ladder(4, 30)
    for kind in ("max", "min", "sum", "avg", "range"):
        among = '"a" | !("a" | "b")' if kind != "min" else '!("a" | "b")'
        found = solve_property(model, f'filter({kind}, Pmax=? [ G !"b" ], {among})', relative=True)
        assert found.status == Status.CONVERGED
        assert found.upper[0] - found.lower[0] <= 1e-6 * found.lower[0]
