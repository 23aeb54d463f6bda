"""Certificates of bounds of all policies of POMDPs by stored beliefs: written, accepted, never false."""

import json
import random
import re
from fractions import Fraction
from types import SimpleNamespace

import jax
import numpy as np
import pytest

import jaxltl as jl
from jaxltl import checker
from jaxltl.io import write_certificate
from tests.certificate_files import certificate, model, write
from tests.core.values.partial_observability.reference import controller_values
from tests.core.values.partial_observability.test_bounds import question

QUESTIONS = {
    "Pmax": 'Pmax=? [ F "goal" ]',
    "Pmin": 'Pmin=? [ F "goal" ]',
    "Rmax": 'R{"cost"}max=? [ F "goal" ]',
    "Rmin": 'R{"cost"}min=? [ F "goal" ]',
    "P of a formula, max": 'Pmax=? [ (F "goal") | (X (F "goal")) ]',
}


@pytest.fixture(autouse=True)
def in_double_precision():
    with jax.enable_x64(True):
        yield


def written(path, kind, seed, max_beliefs=30):
    """Writes the certificate of a random POMDP; its members, the answer, and the bound of all policies."""
    pomdp, _, cost = question(seed, kind[0] + kind[-3:])
    reward = None
    if cost is not None:
        world = pomdp.fully_observable.replace(
            rewards={"cost": jl.models.Rewards(choice=cost.ravel())}
        )
        pomdp, reward = jl.models.make_pomdp(world, pomdp.observation), "cost"
    objective = kind[-3:]
    options = {"tolerance": 1e-4, "max_beliefs": max_beliefs, "objective": objective}
    answer = jl.values.belief_bounds(pomdp, "goal", reward=reward, **options)
    write_certificate(path, pomdp, answer, QUESTIONS[kind], max_beliefs=max_beliefs)
    members = checker.read_archive(str(path), 2**20)
    index = json.loads(members["certificate/index.json"])
    claim = index["claims"][1]
    assert claim["side"] == ("upper" if objective == "max" else "lower")
    return members, answer, claim


@pytest.mark.parametrize("kind", QUESTIONS)
@pytest.mark.parametrize("seed", [2, 4])
def test_bounds_are_those_of_the_exploration(kind, seed, tmp_path):
    path = tmp_path / "file.umb"
    _, answer, claim = written(path, kind, seed)
    status, lines = checker.verdict(str(path))
    assert status == 0, lines
    bound = float(Fraction(claim["bound"]))
    slack = 1e-6 * max(1.0, abs(bound))
    assert float(answer.lower) - slack <= bound <= float(answer.upper) + slack


def array(members, name, dtype="<u8"):
    return np.frombuffer(members[f"{name}.bin"], dtype)


def truth(members, kind):
    """The best value of controllers with two memory states of the model of a file."""
    above, below = array(members, "branch-to-probability", "<i8").reshape(-1, 2).T
    row_start, entry_start = (
        array(members, f"{x}") for x in ("state-to-choices", "choice-to-branches")
    )
    size, successor = row_start.size - 1, array(members, "branch-to-target")
    count = int(np.diff(row_start.astype(int)).max())
    table = np.zeros((size, count, size))
    for s, a in np.ndindex(size, count):
        begin, end = entry_start[int(row_start[s]) + a :][:2]
        np.add.at(table[s, a], successor[begin:end], above[begin:end] / below[begin:end])
    table /= table.sum(-1, keepdims=True)
    initial = np.array(
        [word >> s & 1 for word in array(members, "state-is-initial").tolist() for s in range(size)]
    )
    if "certificate/initial.bin" in members:
        initial = array(members, "certificate/initial", "<f8")
    _, seen = np.unique(array(members, "observations/states/values"), return_inverse=True)
    pomdp = SimpleNamespace(
        observation=seen,
        num_observations=seen.max() + 1,
        num_actions=count,
        initial=initial / initial.sum(),
    )
    cost = None
    if kind[0] == "R":
        (name,) = (x for x in members if x.startswith("annotations/rewards") and "choices" in x)
        cost = np.frombuffer(members[name]).reshape(size, count)
    values, reach = controller_values(pomdp, table, size - 2, cost)
    if cost is not None:
        values = np.where(reach > 1 - 1e-6, values, np.inf)
    return values.max() if kind.endswith("max") else values.min()


CHANGES = ["value", "scale", "row", "rows", "weight", "node", "cover", "less", "more", "bound"]
CHANGES += ["observation", "successor", "probability", "initial", "claim", "values"]


def altered(rng, members, kind, exact):
    """Members with one change."""
    members, change = dict(members), rng.choice(CHANGES)
    index = json.loads(members["certificate/index.json"])
    claim = index["claims"][1]
    sign = 1 if claim["side"] == "upper" else -1

    def numbers(name, dtype, alter):
        table = np.frombuffer(members[f"{name}.bin"], dtype).copy()
        if table.size:
            table = np.asarray(alter(table))
        members[f"{name}.bin"] = table.astype(dtype).tobytes()
        short = name.removeprefix("certificate/")
        if short in index["members"] and index["members"][short]["dtype"][:4] == "uint":
            index["members"][short]["shape"] = [table.size]

    def poke(amount):
        def alter(table):
            table[rng.randrange(table.size)] = amount(table[rng.randrange(table.size)])
            return table

        return alter

    names = claim.get("beliefs", {"vectors": "", "covers": "", "values": ""})
    dtype = {x: e["dtype"] for x, e in index["members"].items()}
    vectors, covers = (f"certificate/{names[x]}" for x in ("vectors", "covers"))
    if change == "bound":
        step = Fraction(rng.choice([1, 10**4]), 10**7)
        claim["bound"] = str(Fraction(float(exact)) - sign * step)
    elif change == "claim":
        claim["side"] = {"upper": "lower", "lower": "upper"}[claim["side"]]
    elif "beliefs" not in claim:
        return None
    elif change in ("value", "row"):
        name = names["values"] if change == "value" else claim["values"]
        if dtype[name] != "double":
            return None
        factor = 1 - sign * rng.choice([1e-9, 1e-3, 0.1, 1])
        numbers(f"certificate/{name}", "<f8", poke(lambda x: x * factor))
    elif change in ("scale", "rows", "values"):
        factor = 1 - sign * rng.choice([1e-6, 1e-3, 0.03])
        for name in {"scale": [names["values"], claim["values"]], "rows": [claim["values"]]}.get(
            change, [names["values"]]
        ):
            if dtype[name] != "double":
                return None
            numbers(f"certificate/{name}", "<f8", lambda x: x * factor)
        claim["bound"] = str(Fraction(claim["bound"]) * Fraction(factor))
    elif change in ("weight", "node"):
        stored = checker.CertificateFile(members).stream(names["vectors"])
        places, i = [], 0
        while i < len(stored):
            places += range(i + 1 + (change == "weight"), i + 1 + 2 * stored[i], 2)
            i += 1 + 2 * stored[i]
        if not places:
            return None
        place, size = rng.choice(places), array(members, "observations/states/values").size

        def alter(table):
            table[place] = rng.randrange(size) if change == "node" else rng.choice([1, 7, 2**40])
            return table

        numbers(vectors, "<u8", alter)
    elif change == "cover":
        count = index["members"][names["values"]]["shape"][0]
        numbers(covers, "<u4", poke(lambda x: rng.randrange(count + 1)))
    elif change == "less":
        numbers(covers, "<u4", lambda x: np.delete(x, rng.randrange(x.size)))
    elif change == "more":
        numbers(covers, "<u4", lambda x: np.insert(x, rng.randrange(x.size), rng.randrange(3)))
    elif change == "observation":
        size = array(members, "observations/states/values").size
        state, seen = rng.randrange(size), rng.randrange(3)
        for name, kind_of in (
            ("observations/states/values", "<u8"),
            ("certificate/observations", "<u4"),
        ):

            def look(table):
                table[state] = seen
                return table

            numbers(name, kind_of, look)
    elif change == "successor":
        size = array(members, "observations/states/values").size
        numbers("branch-to-target", "<u8", poke(lambda x: rng.randrange(size)))
    elif change == "probability":
        numbers("branch-to-probability", "<i8", poke(lambda x: rng.choice([1, 2, 3, 8])))
    elif change == "initial":
        if "initial" not in index["members"]:
            return None
        numbers(
            "certificate/initial",
            "<f8",
            lambda x: (
                x[::-1]
                if rng.random() < 0.2
                else np.where(x > 0, rng.random(), 0) * (1 + np.arange(x.size))
            ),
        )
    members["certificate/index.json"] = json.dumps(index).encode()
    return members


def run(kind, seeds, alterations, path):
    """Numbers of certificates with beliefs, and of altered files that are accepted and refused."""
    with_beliefs = accepted = refused = 0
    for seed in seeds:
        rng = random.Random(f"{kind} {seed}")
        members, _, claim = written(path, kind, seed)
        exact = truth(members, kind)
        with_beliefs += "beliefs" in claim
        for _ in range(alterations):
            other = altered(rng, members, kind, exact)
            if other is None:
                continue
            write(path, other, compress=False)
            status, lines = checker.verdict(str(path))
            if status:
                refused += 1
                continue
            accepted += 1
            index = json.loads(other["certificate/index.json"])
            one = index["claims"][1]
            bound = float(Fraction(one["bound"]))
            value = truth(other, kind)
            slack = 1e-9 * max(1.0, abs(value))
            if one["side"] == "upper" and kind.endswith("max"):
                assert bound >= value - slack, (seed, lines)
            elif one["side"] == "lower" and kind.endswith("min"):
                assert bound <= value + slack, (seed, lines)
            else:  # the other side is attained by a policy
                assert "beliefs" not in one, (seed, lines)
    return with_beliefs, accepted, refused


@pytest.mark.parametrize("kind", QUESTIONS)
def test_changed_files_are_refused_or_true(kind, tmp_path):
    with_beliefs, accepted, refused = run(kind, [2], 30, tmp_path / "file.umb")
    assert with_beliefs and accepted and refused > 10


@pytest.mark.exhaustive
@pytest.mark.parametrize("kind", QUESTIONS)
def test_many_changed_files_are_refused_or_true(kind, tmp_path):
    with_beliefs, accepted, refused = run(kind, range(100, 160), 60, tmp_path / "file.umb")
    assert with_beliefs > 10 and accepted > 200 and refused > 1000


# 0 and 1 look alike: guess there, or wait once. The fast informed bound is 1, that of beliefs 1/2.
COIN = [
    [[(4, 1.0)], [(5, 1.0)], [(2, 1.0)]],
    [[(5, 1.0)], [(4, 1.0)], [(3, 1.0)]],
    [[(4, 1.0)], [(5, 1.0)]],
    [[(5, 1.0)], [(4, 1.0)]],
    [[(4, 1.0)]],
    [[(5, 1.0)]],
]
LOOPS = [[*rows[:2], [(s, 1.0)]] if s < 2 else rows for s, rows in enumerate(COIN)]
SURE = [[[(t % 4 + 4 if t > 3 else t, p) for t, p in r] for r in rows] for rows in LOOPS]
FEWER = [*COIN[:1], COIN[1][:2], *COIN[2:]]
ROWS = [1.0, 0.0, 1.0, 0.0, 1.0, 1.0, 1.0, 0.0, 0.0, 1.0, 1.0, 0.0]
PATH = {"kind": "until", "target": "goal", "stay": ["!", "trap"]}


def coin(
    *,
    states=COIN,
    rows=ROWS,
    vectors=(2, 0, 1, 1, 1),
    covers=(1, 0, 0),
    values=(0.5,),
    side="upper",
    objective="max",
    bound="0.5",
    path=PATH,
    cost=None,
    **more,
):
    """The upper bound 1/2 of the coin by one stored belief, written by hand."""
    arrays = {
        "seen": ("uint32", [6], more.pop("seen", [0, 0, 1, 1, 2, 3])),
        "begin": ("double", [6], [0.5, 0.5, 0, 0, 0, 0]),
        "rows": ("double", [len(rows)], rows),
        "vectors": ("uint64", [len(vectors)], vectors),
        "covers": ("uint32", [len(covers)], covers),
        "x": ("double", [len(values)], values),
        "policy": ("uint32", [6], [0] * 6),
    }
    asked = {"objective": objective, "path": path, "observations": "seen", "initial": "begin"}
    asked |= more.pop("question", {})
    asked = {key: x for key, x in asked.items() if x is not None}
    asked = {"text": checker.question_text(asked), **asked}
    claim = {"side": side, "bound": bound, "values": "rows"} | more.pop("claim", {})
    claim["beliefs"] = {"vectors": "vectors", "covers": "covers", "values": "x"}
    rewards = {} if cost is None else {"cost": {"states": cost}}
    labels = {"goal": [4], "trap": [5]}
    members = model(states, labels=labels, rewards=rewards, initial=(0, 1), **more)
    return certificate(members, asked, [claim], arrays)


REWARD = {"kind": "reward", "reward": "cost", "target": "goal"}
FORGED = {
    "a value below a guess": (
        {"values": (0.49,), "bound": "0.49"},
        "belief 0, choice 0: the value",
    ),
    "a bound below the value": ({"bound": "0.49"}, "is beyond 0.49"),
    "a row below its successors": ({"rows": [0.9, *ROWS[1:]]}, "state 0, choice 0: the value"),
    "no cover": ({"covers": (0, 0)}, "is beyond 0.5"),
    "a cover that is missing": ({"covers": (1, 0)}, "not a certificate"),
    "a cover too many": ({"covers": (1, 0, 0, 0)}, "more covers than successors"),
    "a cover by a belief that is none": ({"covers": (1, 1, 0)}, "not a certificate"),
    "a cover of 65 beliefs": ({"covers": (65, *[0] * 65, 0)}, "a cover has over 64 beliefs"),
    "a belief of two observations": ({"vectors": (2, 0, 1, 2, 1)}, "belief 0 has not one"),
    "a belief with the target": ({"vectors": (2, 0, 1, 4, 1)}, "belief 0 has not one"),
    "an empty belief": ({"vectors": (0,)}, "belief 0 has not one"),
    "a weight of 0": ({"vectors": (2, 0, 1, 1, 0)}, "belief 0 has not one"),
    "another belief": ({"vectors": (2, 0, 1, 1, 2)}, "belief 0, choice 1: the value"),
    "a lower bound of a maximum": ({"side": "lower"}, "beliefs are for optima of all policies"),
    "no observations": ({"question": {"observations": None}}, "beliefs are for optima"),
    "a given policy": ({"question": {"policy": "policy"}}, "beliefs are for optima"),
    "a policy": ({"claim": {"policy": "policy"}}, "beliefs are for optima"),
    "states that look different": ({"seen": [0, 4, 1, 1, 2, 3]}, "belief 0 has not one"),
    "other actions": (
        {"states": FEWER, "rows": [*ROWS[:5], *ROWS[6:]]},
        "state 1: a state of equal observation has other actions",
    ),
    "other names of actions": (
        {"actions": [0, 1, 2, 1, 0, 2, 0, 1, 0, 1, 0, 0]},
        "state 1: a state of equal observation has other actions",
    ),
    "a loop under a minimum": (
        {
            "objective": "min",
            "side": "lower",
            "states": LOOPS,
            "rows": [0.0] * 12,
            "covers": (1, 0, 1, 0),
            "values": (0.5,),
        },
        "belief 0: .*paths may stay|belief 0, choice 0: the value",
    ),
    "a reward of both signs": (
        {"path": REWARD, "cost": [-1.0, 1, 1, 1, 1, 1]},
        "finite and of one sign",
    ),
}


@pytest.mark.parametrize("name", FORGED)
def test_forgeries_are_refused(name, tmp_path):
    changes, reason = FORGED[name]
    status, lines = checker.verdict(str(write(tmp_path / "file.umb", coin(**changes))))
    assert status in (1, 2) and re.search(reason, lines[-1]), lines


def test_the_coin_is_accepted(tmp_path):
    path = tmp_path / "file.umb"
    assert checker.verdict(str(write(path, coin())))[0] == 0
    # The rows alone are a bound too, and so is a sum of beliefs that covers more.
    assert (
        checker.verdict(str(write(path, coin(vectors=(), covers=(0,), values=(), bound="1"))))[0]
        == 0
    )


@pytest.mark.parametrize(
    ("text", "sides"),
    [
        ('Pmax=? [ (! "trap") U "goal" ]', ("lower", "upper")),
        ('Pmin=? [ F "trap" ]', ("upper", "lower")),
        ('Pmax=? [ G (! "trap") ]', ("lower", "upper")),
        ('Pmax=? [ F (G "goal") ]', ("lower", "upper")),
        ('Pmin=? [ (X (X (F "trap"))) | (F "trap") ]', ("upper", "lower")),
    ],
)
def test_both_sides_of_formulas_are_those_of_the_coin(text, sides, tmp_path):
    """Policies that see the states satisfy each of them with probability 1, or the minima with 0."""
    path, rows = tmp_path / "file.umb", [row for state in COIN for row in state]
    entries = [entry for row in rows for entry in row]
    starts = [np.cumsum([0, *map(len, parts)]) for parts in (COIN, rows)]
    begin, labels = [0.5, 0.5, 0, 0, 0, 0], {"goal": [4], "trap": [5]}
    targets, chances = zip(*entries, strict=True)
    world = jl.make_sparse(*starts, targets, chances, initial=begin, label=labels)
    pomdp = jl.models.make_pomdp(world, [0, 0, 1, 1, 2, 3])
    guess = jl.FiniteMemoryPolicy(np.zeros((4, 1), int), np.zeros(4, int), np.zeros((4, 1), int))
    write_certificate(path, pomdp, guess, text)
    assert checker.verdict(str(path))[0] == 0
    index = json.loads(checker.read_archive(str(path), 2**20)["certificate/index.json"])
    assert [claim["side"] for claim in index["claims"]] == [*sides]
    assert "beliefs" in index["claims"][1]
    for claim in index["claims"]:
        assert float(Fraction(claim["bound"])) == pytest.approx(0.5, abs=1e-9)
    write_certificate(path, pomdp, guess, text, max_beliefs=0)
    index = json.loads(checker.read_archive(str(path), 2**20)["certificate/index.json"])
    assert index["claims"][1]["bound"] in ("0", "1") and "beliefs" not in index["claims"][1]
