"""Thresholds of small models are decided where they are the value, by an oracle in fractions."""

import dataclasses
import math
import re
import warnings
from fractions import Fraction

import jax
import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.language.resolve import read_program
from jaxltl.core.logic import parse_property, program_definitions
from jaxltl.core.programs.build import build_model
from jaxltl.core.sparse.exact.bounded import until_at_cost, until_within
from jaxltl.core.sparse.exact.model import ExactMDP, TooLarge, Work
from jaxltl.core.values.properties.solve_property import solve_property
from tests import reference_thresholds as reference
from tests.support import seeds

TEXTS = {  # ways to write probabilities of one row
    "thirds": ("1/3", "2/3"),
    "tenths": ("0.1", "0.3", "0.6"),
    "constants": ("p", "q", "1-p-q"),
    "sevenths": ("1/7", "2/7", "4/7"),
    "equal": ("1/3", "1/3", "1/3"),
    "sure": ("1",),
    "dyadic": ("0.25", "1/2", "2.5e-1"),
    "products": ("1/3*0.1", "0.3*3", "1-1/30-0.9"),
}
CONSTANTS = {"p": Fraction(2, 9), "q": Fraction(1, 6)}


def value_of(text):
    number = "".join(f"Fraction('{x}')" if x[:1].isdigit() else x for x in _tokens(text))
    return eval(number, {"Fraction": Fraction, **CONSTANTS})


def _tokens(text):
    return re.findall(r"[0-9.]+(?:e[+-]?[0-9]+)?|[a-z]+|[-+*/]", text)


def random_program(seed, kind):
    """A program, the rows of its states, and rewards of these, as fractions."""
    rng = np.random.default_rng(seed)
    size = int(rng.integers(3, 6))
    lines, rows, number = [], [], 0
    for s in range(size):
        rows.append([])
        for _ in range(1 if kind == "dtmc" else int(rng.integers(1, 3))):
            texts = list(TEXTS.values())[rng.integers(len(TEXTS))]
            texts = texts if len(texts) <= size else ("1",)
            after = rng.choice(size, len(texts), replace=False).tolist()
            if s == size - 1 and rng.random() < 0.7:
                texts, after = ("1",), [s]
            row = {t: value_of(x) for t, x in zip(after, texts, strict=True)}
            if row in rows[-1]:
                continue
            updates = " + ".join(f"{x}:(s'={t})" for t, x in zip(after, texts, strict=True))
            lines.append(f"  [a{number}] s={s} -> {updates};")
            number += 1
            rows[-1].append(row)
    reward = ["1/3", "0.1", "0", "2", "0"]
    rewards = "\n".join(f"  s={s} : {reward[s]};" for s in range(size))
    text = (
        f"{kind}\nconst double p;\nconst double q = 1/6;\nmodule m\n  s : [0..{size - 1}];\n"
        + "\n".join(lines)
        + f'\nendmodule\nlabel "a" = s={size - 1};\nlabel "b" = s>0 & s<3;\nlabel "c" = s!=1;\n'
        + f'rewards "r"\n{rewards}\nendrewards\n'
    )
    return text, rows, [Fraction(x) for x in reward[:size]]


def reordered(model, rows, reward):
    """The rows and rewards of the reachable states in a model's order."""
    order = model.valuation["s"].tolist()
    place = {s: i for i, s in enumerate(order)}
    kept = [[{place[t]: p for t, p in row.items()} for row in rows[s]] for s in order]
    return kept, [reward[s] for s in order]


def labelled(model, name):
    return set(np.flatnonzero(np.asarray(model.states_with_label(name))).tolist())


def questions(model, rows, cost):
    """Properties without operator and direction, and their values from all states by direction."""
    a, b, c = (labelled(model, x) for x in "abc")
    every = set(range(len(rows)))
    zero = [Fraction(0)] * len(rows)

    def chains(solve_chain):
        return {d: reference.optimum(rows, f, solve_chain) for d, f in BEST.items()}

    def opposite(values):
        return {"max": [1 - x for x in values["min"]], "min": [1 - x for x in values["max"]]}

    def within(goal, stay, count):
        first = [Fraction(int(s in goal)) for s in every]
        fixed = frozenset(goal | (every - stay))
        return {d: reference.steps(rows, f, first, count, fixed=fixed) for d, f in BEST.items()}

    def at_cost(limit):
        scale = math.lcm(*(x.denominator for x in cost))
        units = [int(scale * x) for x in cost]
        width = scale * limit + 2
        grid = reference.with_budget(rows, units, scale * limit)
        goal = {s * width + x for s in a for x in range(width - 1)}
        inner = {s * width + x for s in every for x in range(width - 1)} - goal
        # By value iteration over what is spent: only steps without cost are solved together.
        return {d: spent_value(grid, goal, inner, f, width) for d, f in BEST.items()}

    def sums(goal, earned, must_end):
        return chains(lambda x: reference.total(x, goal, earned, must_end=must_end))

    ones = [Fraction(1)] * len(rows)
    entered = [Fraction(int(s in a)) for s in every]
    yield "P", 'X "a"', {d: reference.steps(rows, f, entered, 1) for d, f in BEST.items()}
    yield "P", 'F "a"', chains(lambda x: reference.until(x, a, every))
    yield "P", '"c" U "a"', chains(lambda x: reference.until(x, a, c))
    yield "P", 'G !"a"', opposite(chains(lambda x: reference.until(x, a, every)))
    yield "P", '"c" W "b"', opposite(chains(lambda x: reference.until(x, every - b - c, every - b)))
    yield "P", '"b" R "c"', opposite(chains(lambda x: reference.until(x, every - c, every - b)))
    yield "P", 'F<=3 "a"', within(a, every, 3)
    yield "P", '"c" U<=2 "a"', within(a, c, 2)
    yield "P", 'G<=2 "c"', opposite(within(every - c, every, 2))
    yield "P", 'F=2 "a"', {d: reference.steps(rows, f, entered, 2) for d, f in BEST.items()}
    yield "P", 'F{"r"}<=1 "a"', at_cost(1)
    yield "P", '(G F "b")', chains(lambda x: reference.infinitely(x, [b], always=False))
    yield "P", '(F G "c")', chains(lambda x: reference.infinitely(x, [c], always=True))
    yield "R", 'F "a"', sums(a, cost, True)
    yield "R", "C", sums(set(), cost, False)
    yield "R", "C<=3", {d: reference.steps(rows, f, zero, 3, cost) for d, f in BEST.items()}
    yield "R", "I=3", {d: reference.steps(rows, f, cost, 3) for d, f in BEST.items()}
    yield "R", "S", chains(lambda x: reference.mean(x, cost))
    yield "T", 'F "a"', sums(a, ones, True)
    inside = [Fraction(int(s in b)) for s in every]
    yield "S", '"b"', chains(lambda x: reference.mean(x, inside))


BEST = {"max": max, "min": min}


def spent_value(grid, goal, inner, best, width):
    """Optimal probabilities from nothing spent; states that cost nothing are few and solved together."""
    value = {s: Fraction(int(s in goal)) for s in range(len(grid)) if s not in inner}
    for spent in reversed(range(width - 1)):
        level = [s for s in inner if s % width == spent]
        place = {s: i for i, s in enumerate(level)}
        end = len(level)
        rows = []
        for s in level:
            rows.append([])
            for row in grid[s]:
                # State `end` is worth 1, the next one 0.
                image, gained = {}, Fraction(0)
                for t, p in row.items():
                    if t in place:
                        image[place[t]] = p
                    else:
                        gained += p * value[t]
                image[end], image[end + 1] = gained, 1 - gained - sum(image.values())
                rows[-1].append({t: p for t, p in image.items() if p})
        rows += [[{end: Fraction(1)}], [{end + 1: Fraction(1)}]]
        found = reference.optimum(
            rows, best, lambda x: reference.until(x, {len(x) - 2}, set(range(len(x))))
        )
        value |= {s: found[place[s]] for s in level}
    return [value[s * width] for s in range(len(grid) // width)]


HOLDS = {
    ">=": lambda x, t: x >= t,
    ">": lambda x, t: x > t,
    "<=": lambda x, t: x <= t,
    "<": lambda x, t: x < t,
}


def thresholds(operator, value):
    if value == math.inf:
        return [Fraction(0), Fraction(10**9)]
    near = [value + e for d in (Fraction(1, 10**7), Fraction(1, 10**30)) for e in (-d, d)]
    some = [value, *near]
    low = operator in ("R", "T")
    return [t for t in some if t >= 0 and (low or t <= 1)]


RELATIONS = (">=", "<"), ("<=", ">")


def require_verdicts(model, rows, cost, parse, relations):
    """All comparisons at, below and above the value are right, in the initial state."""
    start = int(np.flatnonzero(np.asarray(model.initial))[0])
    for operator, path, values in questions(model, rows, cost):
        for direction, value in values.items():
            exact = value[start]
            for threshold in thresholds(operator, exact):
                for relation in relations:
                    text = f"{operator}{direction}{relation}{threshold} [ {path} ]"
                    answer = solve_property(model, parse(text))
                    assert answer.holds == [HOLDS[relation](exact, threshold)], (text, exact)
                    assert answer.status == jl.Status.CONVERGED
                    assert 0 <= answer.lower[0] <= answer.value[0] <= answer.upper[0]


SEEDS = seeds(1, 3, 40)


@pytest.mark.few(1, 3)
@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("kind", ["dtmc", "mdp"])
def test_thresholds_of_programs_are_those_of_their_rationals(kind, seed):
    text, rows, cost = random_program(seed, kind)
    program = read_program(text, {"p": "2/9"})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = build_model(program)
    names = program_definitions(program)
    some = RELATIONS[seed % 2]
    require_verdicts(model, *reordered(model, rows, cost), lambda x: parse_property(x, names), some)


def random_rows(rng, dyadic):
    size = int(rng.integers(3, 6))
    rows = []
    for s in range(size):
        rows.append([])
        for _ in range(int(rng.integers(1, 3))):
            parts = rng.integers(1, 8, int(rng.integers(1, 4))).tolist()
            if dyadic:
                parts[0] += 32 - sum(parts)
            row = {
                int(t): Fraction(x, sum(parts))
                for t, x in zip(rng.choice(size, len(parts), replace=False), parts, strict=True)
            }
            rows[-1].append({s: Fraction(1)} if s == size - 1 else row)
    return rows


def sparse(rows, cost):
    entries = [row for choices in rows for row in choices]
    return jl.make_sparse(
        np.cumsum([0, *map(len, rows)]),
        np.cumsum([0, *map(len, entries)]),
        np.concatenate([list(row) for row in entries]),
        np.array([float(p) for row in entries for p in row.values()]),
        initial=[1] + [0] * (len(rows) - 1),
        label={"a": [len(rows) - 1], "b": [1, 2], "c": [0, *range(2, len(rows))]},
        rewards={"r": jl.models.Rewards(state=np.array([float(x) for x in cost]))},
    )


def drn(rows, cost):
    lines = ["@type: MDP", "@parameters", "", "@reward_models", "r", f"@nr_states\n{len(rows)}"]
    lines += [f"@nr_choices\n{sum(map(len, rows))}", "@model"]
    for s, choices in enumerate(rows):
        labels = [
            x
            for x, holds in zip("abc", (s == len(rows) - 1, 0 < s < 3, s != 1), strict=True)
            if holds
        ]
        lines.append(f"state {s} [{cost[s]}] {'init ' * (s == 0)}{' '.join(labels)}")
        for i, row in enumerate(choices):
            lines.append(f"\taction {i} [0]")
            lines += [f"\t\t{t} : {p}" for t, p in row.items()]
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize("seed", SEEDS)
def test_thresholds_of_models_are_those_of_their_doubles(seed):
    rows = random_rows(np.random.default_rng(seed), True)
    cost = [Fraction(x) for x in ("1/2", "1/10", "0", "2", "0")[: len(rows)]]
    cost[1] = Fraction(1, 4)
    require_verdicts(sparse(rows, cost), rows, cost, parse_property, RELATIONS[seed % 2])


@pytest.mark.parametrize("seed", SEEDS)
def test_thresholds_of_text_files_are_those_of_their_fractions(seed, tmp_path):
    rows = random_rows(np.random.default_rng(seed), False)
    cost = [Fraction(x) for x in ("1/3", "1/10", "0", "2", "0")[: len(rows)]]
    (tmp_path / "model.drn").write_text(drn(rows, cost))
    model = jl.read_model(tmp_path / "model.drn")
    require_verdicts(model, rows, cost, parse_property, RELATIONS[seed % 2])


PROGRAM = """dtmc module m x : [0..2]; [] x=0 -> 1/2 : (x'=1) + 1/2 : (x'=2); [] x>0 -> true; endmodule
rewards "r" x=0 : 1; endrewards rewards "t" [] x=0 : 1; endrewards"""


@pytest.mark.parametrize("factor", [1000.0, 1.0000005, 0.0])
@pytest.mark.parametrize("name", ["r", "t"])
def test_rewards_that_changed_since_are_those_of_the_model(tmp_path, factor, name):
    """Of `replace`, after a threshold was decided, and of a program with another model's source."""
    path = tmp_path / "x.prism"
    path.write_text(PROGRAM)
    model = jl.read_model(path)
    ask = f'R{{"{name}"}}'
    assert jl.solve_property(model, f"{ask}<=1 [ F x>0 ]").holds == [True]
    part = jax.tree.map(lambda x: np.asarray(x) * factor, model.rewards[name])
    changed = dataclasses.replace(model, rewards=model.rewards | {name: part})
    returned = jax.jit(lambda x: x)
    returned(model)
    for other in (changed, returned(changed)):
        value = Fraction(factor)
        for relation, holds in (("<=", True), (">=", True), ("<", False), (">", False)):
            found = jl.solve_property(other, f"{ask}{relation}{value} [ F x>0 ]")
            assert found.holds == [holds], relation
        found = jl.solve_property(other, f"{ask}=? [ F x>0 ]", tolerance=1e-11)
        assert found.lower[0] <= value <= found.upper[0]


def test_the_work_of_levels_without_values_is_bounded():
    mdp = ExactMDP([0, 1, 2], [{0: Fraction(1)}, {1: Fraction(1)}])
    target = np.array([False, True])
    budget = [{0: 1}, {1: 1}], 50_000
    with pytest.raises(TooLarge):
        until_at_cost(mdp, target, ~target, budget, True, Work())
    with pytest.raises(TooLarge):
        until_within(mdp, target, None, 10**6, True, Work())


def test_rewards_that_are_not_numbers_are_refused():
    model = jl.make_sparse(
        None,
        [0, 1, 2],
        [1, 1],
        [1, 1],
        label={"a": [1]},
        rewards={"r": jl.models.Rewards(state=[1, 0])},
    )
    for bad in (np.nan, np.inf):
        part = jl.models.Rewards(state=np.array([bad, 0]))
        other = dataclasses.replace(model, rewards={"r": part})
        for text in (
            ("R=? [ C<=2 ]", "R=? [ S ]", 'R>=1 [ F "a" ]') if bad != bad else ("R=? [ C<=2 ]",)
        ):
            with pytest.raises(ValueError, match="reward"):
                jl.solve_property(other, text)
