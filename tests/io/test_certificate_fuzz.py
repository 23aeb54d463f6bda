"""Random models: certificates contain exact values, and altered ones are accepted if they are true."""

import functools
import json
import math
import random
import re
import struct
from fractions import Fraction

import jax
import numpy as np
import pytest

import jaxltl as jl
from jaxltl import checker
from jaxltl.checker import formula_text, verdict
from jaxltl.io import write_certificate
from tests.certificate_files import write
from tests.reference_certificates import chain_values, optimum
from tests.test_checker import DELTA, nested, parity_values

FORMULAS = ["G F a", "F G a", "(G F a) & (F G !b)"]  # of one automaton state each, and below
CHANGES = ["value", "bound", "successor", "probability", "policy", "set", "formula", "objective"]
CHANGES += ["priority", "value", "bound"]
KINDS = ["chain", "mdp", "intervals", "game"]
DIRECTION = {
    "adversarial": {"max": "min", "min": "max"},
    "cooperative": {"max": "max", "min": "min"},
}


@pytest.fixture(autouse=True)
def in_double_precision():
    with jax.enable_x64(True):
        yield


def random_case(rng, kind, size=4):
    """A model with labels a and b and a reward, a question and keyword arguments of the writer."""
    rows, entries, successor, probability = [0], [0], [], []
    for _ in range(size):
        for _ in range(1 if kind == "chain" else rng.randint(1, 2)):
            targets = sorted(rng.sample(range(size), rng.randint(1, 2 + (kind != "intervals"))))
            weights = [rng.choice([1, 2, 3, 10]) for _ in targets]
            successor += targets
            probability += [w / sum(weights) for w in weights]
            entries.append(len(successor))
        rows.append(len(entries) - 1)
    labels = {x: [s for s in range(size) if rng.random() < 0.4] for x in "ab"}
    cost = [rng.choice([0.0, 0.5, 1.0, 3.0]) for _ in range(size)]
    model = jl.make_sparse(
        None if kind == "chain" else rows,
        entries,
        successor,
        probability,
        initial=np.eye(size)[0],
        label=labels,
        rewards={"cost": jl.models.Rewards(state=cost)},
    )
    objective, nature = rng.choice(["max", "min"]), ""
    if kind == "intervals":
        p, nature = np.array(model.probability), rng.choice(["max", "min"])
        spread = rng.choice([0.05, 0.1, 0.25])
        model = jl.make_interval(model, np.maximum(p - spread, 0), np.minimum(p + spread, 1))
    elif kind == "game":
        model = jl.make_game(model, [rng.random() < 0.5 for _ in range(size)])
    head, options = objective + nature, {}
    path = rng.choice(["until", "reach", "reward", "discounted", *FORMULAS])
    question = {
        "until": f'P{head}=? [ "a" U "b" ]',
        "reach": f'P{head}=? [ F "b" ]',
        "reward": f'R{{"cost"}}{head}=? [ F "b" ]',
        "discounted": f'R{{"cost"}}{head}=? [ C ]',
    }.get(path) or f"P{head}=? [ {formula_text(nested(path))} ]"
    return model, question, {"discount": 0.75} if path == "discounted" else options


def exact_value(members):
    """The exact value in state 0 of the question of a file with one kind of reward and no alias."""
    system = json.loads(members["index.json"])["transition-system"]
    question = json.loads(members["certificate/index.json"])["question"]

    def read(name, code, default=None):
        data = members.get(f"{name}.bin")
        size = {"Q": 8, "d": 8, "I": 4}[code]
        return default if data is None else struct.unpack(f"<{len(data) // size}{code}", data)

    count, num_rows = system["#states"], system["#choices"]
    row_start = read("state-to-choices", "Q", range(count + 1))
    starts = read("choice-to-branches", "Q", range(num_rows + 1))
    target, number = read("branch-to-target", "Q"), read("branch-to-probability", "d")
    is_interval = "nature" in question
    pairs = [*zip(number[::2], number[1::2], strict=True)] if is_interval else number
    states = [
        [
            [*zip(target[starts[r] : starts[r + 1]], pairs[starts[r] : starts[r + 1]], strict=True)]
            for r in range(row_start[s], row_start[s + 1])
        ]
        for s in range(count)
    ]
    owner = [*read("state-to-player", "I", [0] * count)]
    labels = {}
    for name in json.loads(members["index.json"])["annotations"]["aps"]:
        table = json.loads(members["index.json"])["annotations"]["aps"][name]
        word = read(f"annotations/aps/{name}/states/values", "Q")[0]
        labels[table.get("alias", name)] = {s for s in range(count) if word >> s & 1}
    objective, path = question["objective"], question["path"]
    directions = [objective]
    for player in ("environment", "nature"):
        word = question.get(player)
        directions.append(DIRECTION[word][objective] if word else objective)
    everything = set(range(count))
    if path["kind"] == "formula":
        formula = next(f for f in FORMULAS if nested(f) == path["formula"])
        moves = [DELTA[formula](0, s in labels["a"], s in labels["b"]) for s in range(count)]
        values = functools.partial(parity_values, [move[1] for move in moves])
    elif path["kind"] == "until":
        stay = labels[path["stay"]] if "stay" in path else everything
        values = functools.partial(_until, labels[path["target"]], stay)
    else:
        name = next(iter(json.loads(members["index.json"])["annotations"]["rewards"]))
        numbers = read(f"annotations/rewards/{name}/states/values", "d")
        reward = [Fraction(x) for x in numbers[:: len(numbers) // count]]  # or equal ends
        discount = Fraction(path["discount"]) if "discount" in path else None
        final = set() if discount else labels[path["target"]]
        values = functools.partial(_rewards, final, everything, reward, discount)
    return optimum(states, owner, directions, values)[0][0]


def _until(target, stay, chain, _):
    return chain_values(chain, target, stay)


def _rewards(target, everything, reward, discount, chain, _):
    return chain_values(chain, target, everything, reward, discount)


def claims_hold(members):
    """True if all claims of a file are true by its exact value."""
    value = exact_value(members)
    for claim in json.loads(members["certificate/index.json"])["claims"]:
        bound = math.inf if claim["bound"] == "inf" else Fraction(claim["bound"])
        if not (bound <= value if claim["side"] == "lower" else bound >= value):
            return False
    return True


def altered(rng, members):
    """Members with one change, of which some keep all claims true."""
    members, index = dict(members), json.loads(members["certificate/index.json"])
    change = rng.choice(CHANGES)
    claim = rng.choice(index["claims"])

    def poke(name, code, alter):
        size = {"Q": 8, "d": 8, "I": 4}[code]
        data = bytearray(members[name])
        place = rng.randrange(len(data) // size) * size
        (old,) = struct.unpack_from(f"<{code}", data, place)
        struct.pack_into(f"<{code}", data, place, alter(old))
        members[name] = bytes(data)

    if change == "bound" and claim["bound"] != "inf":
        exact, step = exact_value(members), Fraction(rng.choice([1, 10**6]), 10**13)
        if exact != math.inf:  # past the exact value, or short of it
            claim["bound"] = str(exact + rng.choice([-1, 1]) * step)
    elif change == "value":
        name = f"certificate/{claim['values']}.bin"
        if index["members"][claim["values"]]["dtype"] == "double":
            far = rng.choice([-math.inf, math.inf, None])
            poke(name, "d", lambda x: rng.random() if far is None else math.nextafter(x, far))
        else:
            poke(name, "Q", lambda x: max(0, x + rng.choice([-1, 1, 1000])))
    elif change == "successor":
        size = json.loads(members["index.json"])["transition-system"]["#states"]
        poke("branch-to-target.bin", "Q", lambda _: rng.randrange(size))
    elif change == "probability":
        poke(
            "branch-to-probability.bin",
            "d",
            lambda p: rng.choice([p / 2, math.nextafter(p, 2), 1 - p]),
        )
    elif change == "policy" and "policy" in claim:
        poke(f"certificate/{claim['policy']}.bin", "I", lambda k: 1 - min(k, 1))
    elif change == "set":
        name = rng.choice([x for x in members if x.startswith("annotations/aps/")])
        poke(name, "Q", lambda word: word ^ 1 << rng.randrange(4))
    elif change == "formula" and index["question"]["path"]["kind"] == "formula":
        index["question"]["path"]["formula"] = nested(rng.choice(FORMULAS))
    elif change == "objective":
        index["question"]["objective"] = DIRECTION["adversarial"][index["question"]["objective"]]
    elif change == "priority" and "certificate/automaton.hoa" in members:
        text = members["certificate/automaton.hoa"].decode()
        marks = [*re.finditer(r"\{\d+\}", text)]
        if marks:
            spot = rng.choice(marks)
            text = text[: spot.start()] + text[spot.end() :]
        members["certificate/automaton.hoa"] = text.encode()
    index["question"]["text"] = checker.question_text(index["question"])
    members["certificate/index.json"] = json.dumps(index).encode()
    return members


def run(kind, seed, count, alterations, tmp_path):
    """Numbers of written certificates, and of altered ones that are accepted and refused."""
    rng, path = random.Random(f"{kind} {seed}"), tmp_path / "file.umb"
    written = accepted = refused = 0
    reasons = []
    for _ in range(count):
        model, question, options = random_case(rng, kind)
        try:
            write_certificate(path, model, None, question, **options)
        except ValueError as error:
            reasons.append(f"{question}: {error}")
            continue
        written += 1
        members = checker.read_archive(str(path), 2**20)
        assert verdict(str(path))[0] == 0 and claims_hold(members), question
        for _ in range(alterations):
            other = altered(rng, members)
            write(path, other, compress=False)
            status, lines = verdict(str(path))
            if status == 0:
                accepted += 1
                assert claims_hold(other), (question, lines)
            else:
                refused += 1
    return written, accepted, refused, reasons


@pytest.mark.parametrize("kind", KINDS)
def test_certificates_of_random_models(kind, tmp_path):
    written, _, refused, reasons = run(kind, 0, 8, 4, tmp_path)
    assert written >= 7 and refused > 5, reasons


@pytest.mark.few(0, len(KINDS))
@pytest.mark.parametrize("count", [50, 500])
@pytest.mark.parametrize("kind", KINDS)
def test_certificates_of_many_random_models(kind, count, tmp_path):
    written, accepted, refused, reasons = run(kind, 1, count, 1, tmp_path)
    print(kind, written, accepted, refused, reasons[:9])
    assert written >= 0.95 * count and refused > 0.1 * count, reasons
