"""The certificate checker accepts true claims alone: forgeries, damaged files, random models."""

import ast
import functools
import itertools
import json
import math
import random
import subprocess
import sys
from fractions import Fraction
from pathlib import Path

import pytest

import jaxltl
from jaxltl.checker import excludes, formula_text, main, question_text
from jaxltl.core.logic.ltl import as_formula
from tests.certificate_files import certificate, doubles, model, words, write
from tests.reference_certificates import chain_values, optimum, total_values, vertices

CHECKER = Path(jaxltl.__file__).parent / "checker.py"
QUARTER = [(1, 0.75), (4, 0.25)]
# State 0 has a safe loop, a good bet and a bad one; 1 has a coin; 2 is the goal; 3 and 4 loop.
FIVE = [
    [[(0, 1.0)], QUARTER, [(1, 0.25), (3, 0.75)]],
    [[(2, 0.5), (0, 0.5)]],
    [[(2, 1.0)]],
    [[(3, 1.0)]],
    [[(4, 1.0)]],
]
LABELS = {"goal": [2], "trap": [3, 4], "start": [0]}
UNTIL = {"kind": "until", "target": "goal"}
MAX = {"text": 'Pmax=? [ F "goal" ]', "path": UNTIL, "objective": "max"}
# x0 = 3/4 x1, x1 = 1/2 + 1/2 x0: x0 = 3/5, x1 = 4/5.
EXACT = [Fraction(3, 5), Fraction(4, 5), 1, 0, 0]
LOW, HIGH = [0.59, 0.79, 1.0, 0.0, 0.0], [0.61, 0.81, 1.0, 0.0, 0.0]


def five(
    low=LOW, high=HIGH, policy=(1, 0, 0, 0, 0), question=MAX, bounds=("0.589", "0.611"), **more
):
    """The example: a lower and an upper bound of the probability to reach state 2 from state 0."""
    arrays = {
        "low": ("double", [5], low),
        "high": ("double", [5], high),
        "policy": ("uint32", [5], policy),
    }
    claims = [
        {"side": "lower", "bound": bounds[0], "values": "low", "policy": "policy"},
        {"side": "upper", "bound": bounds[1], "values": "high"},
    ]
    members = model(more.get("states", FIVE), labels=more.get("labels", LABELS))
    return certificate(
        members, question, more.get("claims", claims), {**arrays, **more.get("arrays", {})}
    )


def outcome(tmp_path, capsys, members, **options):
    status = main([str(write(tmp_path / "file.umb", members, **options))])
    return status, capsys.readouterr().out


def test_the_example_is_accepted(tmp_path, capsys):
    status, text = outcome(tmp_path, capsys, five())
    assert (status, text.splitlines()[-1]) == (0, "ACCEPTED")
    assert 'claimed: Pmax=? [ F "goal" ] is >= 0.589 in every initial state' in text


def test_it_runs_without_the_package(tmp_path):
    path = write(tmp_path / "file.umb", five(), compress=False)
    done = subprocess.run(
        [sys.executable, "-I", "-S", CHECKER, path], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "") and done.stdout.endswith("ACCEPTED\n")


def test_it_needs_python_3_9_and_nothing_else():
    tree = ast.parse(CHECKER.read_text(), feature_version=(3, 9))
    imported = {
        name.split(".")[0]
        for node in ast.walk(tree)
        if isinstance(node, ast.Import | ast.ImportFrom)
        for name in (
            [x.name for x in node.names] if isinstance(node, ast.Import) else [node.module]
        )
    }
    assert imported <= sys.stdlib_module_names


def changed(index, value):
    return [value if i == index else x for i, x in enumerate(LOW)]


FORGERIES = {
    "lower value above its successors": ({"low": changed(0, 0.601)}, "state 0: the value"),
    "lower value above 1 in the target": ({"low": changed(2, 1.5)}, "state 2: the value"),
    "lower value in a trap": ({"low": changed(4, 0.5)}, "state 4: paths may stay forever"),
    "lower values of a loop": (
        {"low": [1.0, 1.0, 1.0, 0.0, 0.0], "policy": (0, 0, 0, 0, 0), "bounds": ("1", "1")},
        "state 0: paths may stay forever",
    ),
    "another policy": ({"policy": (2, 0, 0, 0, 0)}, "state 0: the value"),
    "a choice that does not exist": ({"policy": (3, 0, 0, 0, 0)}, "state 0: the policy"),
    "no policy": (
        {"claims": [{"side": "lower", "bound": "0", "values": "low"}]},
        "state 0: paths may stay forever",
    ),
    "upper value below its successors": (
        {"high": [0.59, 0.81, 1, 0, 0], "bounds": ("0.5", "0.591")},
        "upper bound: state 0: the value",
    ),
    "upper value below 1 in the target": (
        {"high": [0.61, 0.81, 0.99, 0, 0]},
        "state 2: the value",
    ),
    "negative upper value": ({"high": [0.61, 0.81, 1.0, 0.0, -0.01]}, "state 4: the value"),
    "claimed lower bound above the values": ({"bounds": ("0.6", "0.611")}, "beyond 0.6"),
    "claimed upper bound below the values": ({"bounds": ("0.5", "0.6")}, "beyond 0.6"),
    "text of another question": (
        {"question": {**MAX, "text": 'Pmax=? [ F "trap" ]'}},
        "the text of the question",
    ),
    "another objective": (
        {"question": {**MAX, "objective": "min", "text": 'Pmin=? [ F "goal" ]'}},
        "state 0: ",
    ),
    "NaN": ({"low": changed(4, math.nan)}, "state 4: the value nan"),
    "infinite probability": ({"high": [math.inf] * 5}, "infinite"),
    "a kind that is not covered": (
        {"question": {**MAX, "path": {"kind": "average"}}},
        "not 'average'",
    ),
    "negative probability": (
        {"states": [*FIVE[:4], [[(4, 1.5), (3, -0.5)]]]},
        "a probability is -0.5",
    ),
    "probabilities of 0": (
        {"states": [*FIVE[:4], [[(4, 0.0)]]], "bounds": ("0.5", "0.7")},
        "are 0",
    ),
}


@pytest.mark.parametrize("name", FORGERIES)
def test_forgeries_are_refused_for_their_reason(name, tmp_path, capsys):
    arguments, why = FORGERIES[name]
    status, text = outcome(tmp_path, capsys, five(**arguments))
    assert status == 1 and text.startswith("REFUSED: ") and why in text
    assert len(text.splitlines()) == 1


LOOP, OTHER = [(0, 1.0)], [(1, 1.0)]
FREE = [(0, (0.0, 1.0)), (1, (0.0, 1.0))]  # nature may stay in state 0
HALVES = [(0, (0.25, 0.75)), (1, (0.25, 0.75))]
RECUR = {"kind": "formula", "formula": ["G", ["F", "a"]], "automaton": "automaton"}
# Of each: states, label of state 1 (for formulas of state 0), question, side, values, more, reason.
CONDITIONS = {
    "an end component under a minimum": (
        [[LOOP, OTHER], [OTHER]],
        {"path": UNTIL, "objective": "min"},
        ("lower", [1.0, 1.0], {}),
        "state 0: paths may stay forever",
    ),
    "a choice of the environment under a lower bound": (
        [[LOOP, OTHER], [OTHER]],
        {"path": UNTIL, "objective": "max", "environment": "adversarial"},
        ("lower", [1.0, 1.0], {"policy": ("uint32", [2], [1, 0])}),
        "state 0: paths may stay forever",
    ),
    "a distribution by which nature stays": (
        [[FREE], [[(1, (1.0, 1.0))]]],
        {"path": UNTIL, "objective": "max", "nature": "adversarial"},
        ("lower", [0.5, 1.0], {}),
        "state 0: paths may stay forever",
    ),
    "nature's best distribution in place of its worst": (
        [[HALVES], [[(1, (1.0, 1.0))]], [[(2, (1.0, 1.0))]]],
        {"path": {**UNTIL, "steps": 1}, "objective": "max", "nature": "adversarial"},
        ("lower", [0.0, 0.5, 1.0, 1.0, 0.0, 0.0], {"shape": [3, 2]}),
        "state 0, automaton",
    ),
    "a reward that misses the target": (
        [[LOOP, OTHER], [OTHER]],
        {"path": {"kind": "reward", "reward": "cost", "target": "goal"}, "objective": "max"},
        ("upper", [9.0, 0.0], {"cost": [0.0, 0.0]}),
        "state 0: paths may stay forever",
    ),
    "a total that never ends": (
        [[LOOP], [OTHER]],
        {"path": {"kind": "total", "reward": "cost"}, "objective": "max"},
        ("upper", [9.0, 0.0], {}),
        "state 0: the value",
    ),
    "an accepting component left out of an upper bound": (
        [[LOOP, OTHER], [OTHER]],
        {"path": RECUR, "objective": "max"},
        ("upper", [0.5, 0.0], {"shape": [2, 1]}),
        "state 0: the value",
    ),
    "a rejecting component under a lower bound": (
        [[LOOP, OTHER], [OTHER]],
        {"path": RECUR, "objective": "max"},
        ("lower", [1.0, 0.0], {"shape": [2, 1], "policy": ("uint32", [2, 1], [1, 0])}),
        "state 0: the value",
    ),
    "an automaton that differs on one lasso": (
        [[LOOP, OTHER], [OTHER]],
        {"path": {**RECUR, "formula": ["F", ["G", "a"]]}, "objective": "max"},
        ("lower", [0.0, 0.0], {"shape": [2, 1]}),
        "the automaton accepts a word that violates the formula",
    ),
    "a memory that the policy does not have": (
        [[LOOP, OTHER], [OTHER]],
        {"path": UNTIL, "objective": "max", "policy": "policy"},
        ("lower", [1.0, 1.0], {"policy": ("uint32", [2], [0, 0])}),
        "state 0: paths may stay forever",
    ),
    "weights of which the mean is worse": (
        [[OTHER, [(2, 1.0)]], [OTHER], [[(2, 1.0)]]],
        {"path": UNTIL, "objective": "max", "policy": "policy"},
        ("lower", [0.75, 1.0, 0.0], {"policy": ("double", [4], [1.0, 1.0, 1.0, 1.0])}),
        "state 0: the value",
    ),
    "a discount of 1": (
        [[LOOP], [OTHER]],
        {"path": {"kind": "total", "reward": "cost", "discount": "1"}, "objective": "max"},
        ("upper", [9.0, 0.0], {}),
        "the discount is 1",
    ),
}


@pytest.mark.parametrize("name", CONDITIONS)
def test_each_condition_is_needed(name, tmp_path, capsys):
    states, question, (side, values, more), why = CONDITIONS[name]
    question = {**question, "text": question_text(question)}
    goal, owner = [1], [1] * len(states) if "environment" in question else None
    labels = {"goal": goal, "a": [0]}
    rewards = {"cost": {"states": more.get("cost", [1.0] + [0.0] * (len(states) - 1))}}
    claim = {"side": side, "bound": str(Fraction(values[0])), "values": "values"}
    claim |= {"policy": "policy"} if "policy" in more and "policy" not in question else {}
    if "steps" in question["path"]:
        claim["bound"] = "1/2"
    arrays = {"values": ("double", more.get("shape", [len(values)]), values)}
    arrays |= {"policy": more["policy"]} if "policy" in more else {}
    made = certificate(
        model(states, labels=labels, rewards=rewards, owner=owner),
        question,
        [claim],
        arrays,
        {"automaton": hoa("G F a")},
    )
    status, text = outcome(tmp_path, capsys, made)
    assert status == 1 and why in text and len(text.splitlines()) == 1, text


# --- damaged files ----------------------------------------------------------------------------


def edited(members, /, **changes):
    """The members with another index of the certificate."""
    index = json.loads(members["certificate/index.json"])
    return {**members, "certificate/index.json": json.dumps({**index, **changes}).encode()}


def with_model_index(members, key, value):
    index = json.loads(members["index.json"])
    index["transition-system"][key] = value
    return {**members, "index.json": json.dumps(index).encode()}


GOOD = five()
INDEX = json.loads(GOOD["certificate/index.json"])
NESTED = functools.reduce(lambda f, _: ["<->", f, "trap"], range(60), "goal")
DOUBLING = {**UNTIL, "target": NESTED}  # in negation normal form
DAMAGED = {
    "sizes that lie": with_model_index(GOOD, "#states", 2**60),
    "more branches than there are": with_model_index(GOOD, "#branches", 9),
    "a number of 30 digits": with_model_index(GOOD, "#states", 10**30),
    "a negative number": with_model_index(GOOD, "#states", -5),
    "a target that is no state": {**GOOD, "branch-to-target.bin": words([9] * 10)},
    "starts that decrease": {**GOOD, "state-to-choices.bin": words([0, 3, 2, 5, 6, 7])},
    "members twice": [*GOOD.items(), ("branch-to-target.bin", GOOD["branch-to-target.bin"])],
    "no certificate": {k: x for k, x in GOOD.items() if not k.startswith("certificate")},
    "no model": {k: x for k, x in GOOD.items() if k.startswith("certificate")},
    "deep nesting": {**GOOD, "certificate/index.json": b"[" * 10**6},
    "a key twice": {
        **GOOD,
        "certificate/index.json": GOOD["certificate/index.json"][:-1] + b', "version": 1}',
    },
    "an array that is cut off": {**GOOD, "certificate/low.bin": b"\0" * 39},
    "a pickle": {**GOOD, "certificate/index.json": b"\x80\x04cos\nsystem\n(S'false'\ntR."},
    "another version": edited(GOOD, version=2),
    "other semantics of numbers": edited(GOOD, numbers="rounded"),
    "an unknown key": edited(GOOD, shortcut=True),
    "nothing claimed": edited(GOOD, claims=[]),
    "claims of another type": edited(GOOD, claims=[3]),
    "a shape that lies": edited(GOOD, members={"low": {"dtype": "double", "shape": [2**62]}}),
    "members of another type": edited(GOOD, members={"low": 3, "policy": None}),
    "a dtype of objects": edited(GOOD, members={"low": {"dtype": "object", "shape": [5]}}),
    "a bound that is none": edited(GOOD, claims=[{**INDEX["claims"][1], "bound": "1e999999999"}]),
    "a huge exponent": edited(GOOD, claims=[{**INDEX["claims"][1], "bound": "1" * 5000}]),
    "a missing label": edited(
        GOOD,
        question={
            **MAX,
            "path": {**UNTIL, "target": "nothing"},
            "text": 'Pmax=? [ F "nothing" ]',
        },
    ),
    "an operator that is none": edited(
        GOOD,
        question={
            **MAX,
            "path": {**UNTIL, "target": ["Y", "goal"]},
            "text": 'Pmax=? [ F (Y "goal") ]',
        },
    ),
    "a temporal set of states": edited(
        GOOD,
        question={
            **MAX,
            "path": {**UNTIL, "target": ["X", "goal"]},
            "text": 'Pmax=? [ F (X "goal") ]',
        },
    ),
    "a probability that is no number": {
        **GOOD,
        "branch-to-probability.bin": doubles([1.0, math.nan, *[1.0] * 8]),
    },
    "an infinite probability": {
        **GOOD,
        "branch-to-probability.bin": doubles([math.inf, *[1.0] * 9]),
    },
    "steps that lie": edited(
        GOOD,
        question={
            **MAX,
            "path": {**UNTIL, "steps": 2**60},
            "text": f'Pmax=? [ F<={2**60} "goal" ]',
        },
    ),
    "a memory that lies": edited(
        GOOD, claims=[{**INDEX["claims"][0], "memory": 2**60, "next": "low"}]
    ),
    "a number that is none": edited(GOOD, version=math.nan),
    "counts that lie": edited(
        GOOD,
        counts={"member": "low", "method": "anytime", "confidence": "0.9", "assumption": ""},
    ),
    "a formula that doubles": edited(
        GOOD,
        question={**MAX, "path": DOUBLING, "text": question_text({**MAX, "path": DOUBLING})},
    ),
}


@pytest.mark.parametrize("name", DAMAGED)
def test_damaged_files_are_no_certificates(name, tmp_path, capsys):
    status, text = outcome(tmp_path, capsys, DAMAGED[name])
    assert status == 2 and len(text.splitlines()) == 1 and len(text) < 2000


def test_archives_are_read_in_bounded_memory(tmp_path, capsys):
    bomb = {**GOOD, "more.bin": bytes(3 * 10**7)}
    path = write(tmp_path / "bomb.umb", bomb)
    assert path.stat().st_size < 10**6
    assert main([str(path), "--limit", str(10**6)]) == 2
    assert "--limit" in capsys.readouterr().out
    assert main([str(path)]) == 0  # members that the index does not name are left alone


def test_members_of_negative_size_are_refused(tmp_path, capsys):
    """In some versions of Python they lead back to earlier bytes, which are then read again."""
    path = write(tmp_path / "file.umb", {"more": b"", **GOOD}, compress=False)
    data = bytearray(path.read_bytes())
    data[124:136] = (2**96 - 512).to_bytes(12, "big")  # -512, as a binary number
    data[148:156] = b" " * 8
    data[148:156] = b"%06o\0 " % sum(data[:512])
    path.write_bytes(data)
    assert main([str(path)]) == 2
    text = capsys.readouterr().out
    assert "'more' is cut off" in text or "invalid offset" in text  # of this file, or of tarfile


def test_long_claims_are_printed_to_their_end(tmp_path, capsys):
    """The end of this number is an exponent."""
    bound = "0." + "9" * 3000 + "e2"
    status, text = outcome(tmp_path, capsys, five(bounds=("0.5", bound)))
    assert status == 0 and f"is <= {bound} in every initial state" in text


@pytest.mark.parametrize("cut", [1, 600, 3000])
@pytest.mark.parametrize("compress", [True, False])
def test_truncated_archives_are_no_certificates(cut, compress, tmp_path, capsys):
    path = write(tmp_path / "file.umb", GOOD, compress=compress)
    data = path.read_bytes()
    path.write_bytes(data[: min(cut, len(data) // 2)])
    assert main([str(path)]) == 2 and len(capsys.readouterr().out.splitlines()) == 1


def test_flipped_bytes_never_make_a_false_claim_true(tmp_path, capsys):
    """Of a false claim, as its bound is too large: whatever one byte is, it is not accepted."""
    path = write(tmp_path / "file.umb", five(bounds=("0.7", "0.611")), compress=False)
    data, rng = bytearray(path.read_bytes()), random.Random(5)
    text = bytes(data).find(b'"bound": "0.7"')
    for _ in range(150):
        place = rng.randrange(len(data))
        if text <= place < text + 20:
            continue
        other = bytearray(data)
        other[place] ^= 1 << rng.randrange(8)
        path.write_bytes(other)
        status = main([str(path)])
        assert status in (1, 2), capsys.readouterr().out
    capsys.readouterr()


# --- random models with exact values ----------------------------------------------------------

FORMS = {  # players, intervals
    "mdp": (False, False),
    "game": (True, False),
    "intervals": (False, True),
    "interval game": (True, True),
}
ADVERSARIAL = {"max": "min", "min": "max"}


def random_states(rng, num_states, intervals):
    def row():
        targets = rng.sample(
            range(num_states), rng.randint(1, 2 + (num_states > 3 and not intervals))
        )
        if not intervals:
            return [(t, rng.choice([0.5, 0.3, 1.0, 0.1])) for t in targets]
        if len(targets) == 1:
            return [(targets[0], (1.0, 1.0))]
        low = rng.choice([0.0, 0.25, 0.5])
        high = rng.choice([low, 0.75, 1.0])
        return [(targets[0], (low, high)), (targets[1], (1 - high, 1 - low))]

    return [[row() for _ in range(rng.randint(1, 2))] for _ in range(num_states)]


def random_case(rng, form, kind, num_states=3):
    """Members, question, shape and a function from directions to values and witnesses."""
    has_players, intervals = FORMS[form]
    states = random_states(rng, num_states, intervals)
    owner = [rng.randint(0, 1) if has_players else 0 for _ in states]
    num_rows = sum(map(len, states))
    num_branches = sum(len(row) for rows in states for row in rows)
    rewards = {
        "states": [rng.choice([0.0, 0.1, 2.0]) for _ in states],
        "choices": [rng.choice([0.0, 1.0]) for _ in range(num_rows)],
        "branches": [rng.choice([0.0, 0.5]) for _ in range(num_branches)],
    }
    if kind == "total":
        rewards = {"states": [rng.choice([0.0, 0.0, 1.0]) for _ in states]}
    target = {num_states - 1}
    stay = {s for s in range(num_states) if rng.random() < 0.8}
    labels = {"goal": target, "safe": stay}
    members = model(
        states, labels=labels, rewards={"cost": rewards}, owner=owner if has_players else None
    )
    first_row = [sum(map(len, states[:s])) for s in range(num_states)]
    first_branch = list(
        itertools.accumulate((len(row) for rows in states for row in rows), initial=0)
    )

    def reward_of(chain, rows):
        result = []
        for s, row in enumerate(chain):
            r = first_row[s] + rows[s]
            parts = Fraction(rewards["states"][s]) + Fraction(
                rewards.get("choices", [0] * num_rows)[r]
            )
            for i, (_, p) in enumerate(row):
                parts += p * Fraction(
                    rewards.get("branches", [0] * num_branches)[first_branch[r] + i]
                )
            result.append(parts)
        return result

    everything = set(range(num_states))
    value_of_chain = {
        "until": lambda chain, _: chain_values(chain, target, stay),
        "reward": lambda chain, rows: chain_values(
            chain, target, everything, reward_of(chain, rows)
        ),
        "total": lambda chain, rows: total_values(chain, reward_of(chain, rows)),
        "discounted": lambda chain, rows: chain_values(
            chain, set(), everything, reward_of(chain, rows), Fraction(9, 10)
        ),
    }[kind]
    path = {
        "until": {**UNTIL, "stay": "safe"},
        "reward": {"kind": "reward", "reward": "cost", "target": "goal"},
        "total": {"kind": "total", "reward": "cost"},
        "discounted": {"kind": "total", "reward": "cost", "discount": "0.9"},
    }[kind]
    inner = {
        "until": '"safe" U "goal"',
        "reward": 'F "goal"',
        "total": "C",
        "discounted": "C",
    }[kind]
    return (
        members,
        path,
        inner,
        lambda directions: optimum(states, owner, directions, value_of_chain),
    )


def random_question(rng, form, path, inner):
    """A question, and the directions of system, environment and nature."""
    has_players, intervals = FORMS[form]
    objective = rng.choice(["max", "min"])
    directions, question, head, tail = [objective], {"path": path, "objective": objective}, "", ""
    for key, exists in (("environment", has_players), ("nature", intervals)):
        word = rng.choice(["adversarial", "cooperative"])
        question |= {key: word} if exists else {}
        directions.append(ADVERSARIAL[objective] if word == "adversarial" else objective)
    if has_players:
        both = ",environment" if question["environment"] == "cooperative" else ""
        head = f"<<system{both}>> "
    head += "P" if "reward" not in path else 'R{"cost"}'
    head += objective + (directions[2] if intervals else "")
    tail = f" // discount {path['discount']}" if "discount" in path else ""
    return question | {"text": f"{head}=? [ {inner} ]{tail}"}, directions


def as_text(x):
    return "inf" if x == math.inf else str(x)


def claim_file(members, question, side, values, policy, shape, texts=()):
    """A certificate of one claim with exact values; infinite values are stored as doubles."""
    if math.inf in values:
        stored = "double", shape, [float(x) for x in values]
    else:
        stored = "rational2048", shape, values
    claim = {"side": side, "bound": as_text(values[0]), "values": "values", "policy": "policy"}
    arrays = {"values": stored, "policy": ("uint32", shape, policy)}
    return certificate(members, question, [claim], arrays, texts)


def mutated(rng, values, policy, sizes):
    """Other values and other rows."""
    values, policy = list(values), list(policy)
    for _ in range(rng.randint(0, 2)):
        i = rng.randrange(len(values))
        policy[i] = rng.randrange(sizes[i])
    for _ in range(rng.randint(1, 3)):
        i = rng.choice([0, rng.randrange(len(values))])
        if values[i] != math.inf:
            values[i] += Fraction(rng.choice([-1, 1]), rng.choice([2, 5, 64]))
        else:
            values[i] = Fraction(rng.randrange(4))
    return values, policy


@pytest.mark.parametrize("kind", ["until", "reward", "total", "discounted"])
@pytest.mark.parametrize("form", FORMS)
def test_exact_values_are_accepted_and_false_claims_are_not(form, kind, tmp_path, capsys):
    rng = random.Random(f"{form} {kind}")
    accepted = refused = 0
    for _ in range(5):
        members, path, inner, solve = random_case(rng, form, kind)
        question, directions = random_question(rng, form, path, inner)
        best, attained = solve(directions)
        starts = [*memoryview(members["state-to-choices.bin"]).cast("Q")]
        sizes = [b - a for a, b in itertools.pairwise(starts)]
        for side, ours in (("lower", "max"), ("upper", "min")):
            policy = attained.get(ours)
            if policy is None:  # only other states' optima differ
                continue
            infinite = math.inf in best
            usual = not infinite or (kind == "reward" or side == "upper")
            exact = claim_file(members, question, side, best, policy, [3])
            if infinite and side == "lower" and kind == "total":
                continue
            status, text = outcome(tmp_path, capsys, exact)
            is_float = infinite and any(x != math.inf and Fraction(float(x)) != x for x in best)
            assert status == 0 or is_float or not usual, text
            accepted += status == 0
            for _ in range(6):
                values, rows = mutated(rng, best, policy, sizes)
                status, _ = outcome(
                    tmp_path, capsys, claim_file(members, question, side, values, rows, [3])
                )
                true = values[0] <= best[0] if side == "lower" else values[0] >= best[0]
                assert status == 1 or true
                refused += status == 1
    assert accepted > 4 and refused > 10


# --- other questions --------------------------------------------------------------------------


def test_infinite_totals_are_no_lower_bounds(tmp_path, capsys):
    rewards = {"cost": {"states": [1.0, 0.0]}}
    members = model([[[(1, 1.0)]], [[(1, 1.0)]]], rewards=rewards)
    question = {
        "text": 'R{"cost"}max=? [ C ]',
        "path": {"kind": "total", "reward": "cost"},
        "objective": "max",
    }
    claim = {"side": "lower", "bound": "1", "values": "values"}
    for values, status in (([math.inf, 0.0], 1), ([1.0, math.inf], 1), ([1.0, 0.0], 0)):
        arrays = {"values": ("double", [2], values)}
        found = outcome(tmp_path, capsys, certificate(members, question, [claim], arrays))
        assert found[0] == status, found


def test_paths_that_stay_and_earn_have_an_infinite_total(tmp_path, capsys):
    """Nature may keep to state 0, but it earns there whatever nature does."""
    states = [[[(0, (0.0, 1.0)), (1, (0.0, 1.0))]], [[(1, (1.0, 1.0))]]]
    question = {
        "text": 'R{"cost"}maxmin=? [ C ]',
        "path": {"kind": "total", "reward": "cost"},
        "objective": "max",
        "nature": "adversarial",
    }
    claim = {"side": "lower", "bound": "1", "values": "values"}
    arrays = {"values": ("double", [2], [1.0, 0.0])}
    for rewards, expected in (
        ({"states": [1.0, 0.0]}, 0),
        ({"branches": [1.0, 1.0, 0.0]}, 0),
        ({"branches": [0.0, 1.0, 0.0]}, 1),
    ):
        members = model(states, rewards={"cost": rewards})
        found = outcome(tmp_path, capsys, certificate(members, question, [claim], arrays))
        assert found[0] == expected, found


def test_an_infinite_reward_is_proven_by_the_graph(tmp_path, capsys):
    """From state 0 the target, state 1, is missed with probability 1/2 (or never, in a loop)."""
    for loss, status in ((2, 0), (0, 1)):
        states = [[[(1, 0.5), (loss, 0.5)]], [[(1, 1.0)]], [[(2, 1.0)]]]
        rewards = {"cost": {"states": [1.0, 1.0, 0.0]}}
        members = model(states, labels={"goal": [1]}, rewards=rewards)
        question = {
            "text": 'R{"cost"}min=? [ F "goal" ]',
            "path": {"kind": "reward", "reward": "cost", "target": "goal"},
            "objective": "min",
        }
        claim = {"side": "lower", "bound": "inf", "values": "values"}
        arrays = {"values": ("double", [3], [math.inf, 0.0, math.inf])}
        found = outcome(tmp_path, capsys, certificate(members, question, [claim], arrays))
        assert found[0] == status and ("no infinity" in found[1]) == status


def test_rewards_of_both_signs_need_policies_that_reach_the_target(tmp_path, capsys):
    rewards = {"cost": {"states": [-2.0, 0.0]}}
    question = {
        "text": 'R{"cost"}max=? [ F "goal" ]',
        "path": {"kind": "reward", "reward": "cost", "target": "goal"},
        "objective": "max",
    }
    claim = {"side": "upper", "bound": "-4", "values": "values"}
    lower = {"side": "lower", "bound": "-4", "values": "values", "policy": "policy"}
    arrays = {"values": ("double", [2], [-4.0, 0.0]), "policy": ("uint32", [2], [0, 0])}
    coin, loop, goal = [(0, 0.5), (1, 0.5)], [(0, 1.0)], [(1, 1.0)]
    cases = (
        ([[coin], [goal]], claim, 0),
        ([[coin], [goal]], lower, 0),
        ([[coin, loop], [goal]], claim, 1),
        ([[coin, loop], [goal]], lower, 0),  # of the coin; the loop has the value infinity
        ([[loop, coin], [goal]], lower, 1),
    )
    for states, one, expected in cases:
        members = model(states, labels={"goal": [1]}, rewards=rewards)
        status, text = outcome(tmp_path, capsys, certificate(members, question, [one], arrays))
        assert status == expected and ("stay forever" in text or "follow" in text) == expected


def steps_values(states, steps, direction, reward):
    """Values and choices by backward induction: of reaching the last state, or of rewards."""
    last = len(states) - 1
    choose = max if direction == "max" else min
    layers, choices = [[Fraction(int(s == last and reward is None)) for s in range(last + 1)]], []
    for _ in range(steps):
        after, now, rows = layers[-1], [], []
        for s, options in enumerate(states):
            means = [
                sum(Fraction(p) * after[t] for t, p in row) / sum(Fraction(p) for _, p in row)
                for row in options
            ]
            if reward is None and s == last:
                means = [Fraction(1)]
            now.append(choose(means) + Fraction(0 if reward is None else reward[s]))
            rows.append(means.index(choose(means)))
        layers.append(now)
        choices.append(rows)
    return layers, [[*rows, 0] for rows in [[0] * last, *[x[:-1] for x in choices]]]


@pytest.mark.parametrize("kind", ["within", "cumulative"])
def test_bounded_steps(kind, tmp_path, capsys):
    rng = random.Random(kind)
    for trial in range(8):
        states, steps = random_states(rng, 4, False), 3
        states[-1] = [[(3, 1.0)]]
        reward = None if kind == "within" else [1.0, 0.5, -1.0, 0.0]
        objective = ("max", "min")[trial % 2]
        layers, rows = steps_values(states, steps, objective, reward)
        members = model(
            states, labels={"goal": [3]}, rewards={"cost": {"states": reward or [0.0] * 4}}
        )
        path = {"kind": "until" if kind == "within" else "total", "steps": steps}
        path |= {"target": "goal"} if kind == "within" else {"reward": "cost"}
        inner = 'F<=3 "goal"' if kind == "within" else "C<=3"
        head = "P" if kind == "within" else 'R{"cost"}'
        question = {
            "text": f"{head}{objective}=? [ {inner} ]",
            "path": path,
            "objective": objective,
        }
        by_state = [layers[m][s] for s in range(4) for m in range(steps + 1)]
        policy = [rows[m][s] for s in range(4) for m in range(steps + 1)]
        for side in ("lower", "upper"):
            shape, starts = [4, steps + 1], by_state[:]
            for change in (None, *range(6)):
                values = by_state[:]
                if change is not None:
                    values[rng.choice([3, rng.randrange(16)])] += Fraction(rng.choice([-1, 1]), 8)
                made = claim_file(members, question, side, values, policy, shape)
                index = json.loads(made["certificate/index.json"])
                index["claims"][0]["bound"] = str(values[steps])
                made["certificate/index.json"] = json.dumps(index).encode()
                status, text = outcome(tmp_path, capsys, made)
                true = values[3] <= starts[3] if side == "lower" else values[3] >= starts[3]
                assert (status == 0) if change is None else (status == 1 or true), text


def nested(formula):
    """A formula as a label or a list of an operator and its operands."""
    formula = as_formula(formula)
    if formula.operator == "ap":
        return formula.proposition
    operands = [nested(x) for x in formula.operands]
    if formula.operator == "xor":
        return ["!", ["<->", *operands]]
    if formula.operator == "M":
        return ["U", operands[1], ["&", *operands]]
    return [formula.operator, *operands]


@pytest.mark.parametrize(
    ("formula", "text"),
    [
        ("a", '"a"'),
        ("G F a", 'G (F "a")'),
        ("!b U a", '(! "b") U "a"'),
        ("a & b & X true", '"a" & "b" & (X (true))'),
        ("(a -> b) W (a <-> b)", '("a" => "b") W ("a" <=> "b")'),
    ],
)
def test_formulas_as_text(formula, text):
    assert formula_text(nested(formula)) == text


HOA = """HOA: v1
States: {states}
Start: 0
AP: {names}
Acceptance: {acceptance}
--BODY--
{body}
--END--
"""
AUTOMATA = {
    "G F a": ("1", '1 "a"', "1 Inf(0)", "State: 0\n[0] 0 {0}\n[!0] 0"),
    "F G a": ("1", '1 "a"', "1 Fin(0)", 'State: 0 "F G a"\n[!0] 0 {0}\n[0] 0'),
    "!b U a": (
        "3",
        '2 "a" "b"',
        "1 Inf(0)",
        "State: 0\n[0] 1\n[!0&!1] 0\n[!0&1] 2\nState: 1 {0}\n[t] 1\nState: 2\n[t] 2",
    ),
    "(G F a) & (F G !b)": (
        "1",
        '2 "a" "b"',
        "2 Fin(0) & Inf(1)",
        "State: 0\n[1] 0 {0}\n[0&!1] 0 {1}\n[!0&!1] 0",
    ),
}
DELTA = {  # successor and priority (least, even accepts) of a state for a letter
    "G F a": lambda q, a, b: (0, 0 if a else 1),
    "F G a": lambda q, a, b: (0, 2 if a else 1),
    "!b U a": lambda q, a, b: (1 if a else 2 if b else 0, 1) if q == 0 else (q, 0 if q == 1 else 1),
    "(G F a) & (F G !b)": lambda q, a, b: (0, 1 if b else 2 if a else 3),
}


def hoa(formula):
    states, names, acceptance, body = AUTOMATA[formula]
    return HOA.format(states=states, names=names, acceptance=acceptance, body=body)


def parity_values(priority, chain, _):
    """Probabilities that the least priority that recurs is even."""
    states = set(range(len(chain)))

    def ahead(s):
        seen = {s}
        while more := {t for x in seen for t, p in chain[x] if p} - seen:
            seen |= more
        return seen

    after = {s: ahead(s) for s in states}
    recurrent = {s for s in states if all(s in after[t] for t in after[s])}
    good = {s for s in recurrent if min(priority[t] for t in after[s]) % 2 == 0}
    return chain_values(chain, good, states)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("formula", AUTOMATA)
def test_formulas(formula, form, tmp_path, capsys):
    rng = random.Random(f"{formula} {form}")
    num_q = int(AUTOMATA[formula][0])
    has_players, intervals = FORMS[form]
    for _ in range(1 if num_q > 1 else 3):
        states = random_states(rng, 2 if num_q > 1 and has_players else 3, intervals)
        owner = [rng.randint(0, 1) if has_players else 0 for _ in states]
        letters = [(rng.random() < 0.5, rng.random() < 0.5) for _ in states]
        labels = {"ab"[i]: [s for s, x in enumerate(letters) if x[i]] for i in range(2)}
        moves = [[DELTA[formula](q, *letter) for q in range(num_q)] for letter in letters]
        product = [
            [[(t * num_q + moves[s][q][0], p) for t, p in row] for row in rows]
            for s, rows in enumerate(states)
            for q in range(num_q)
        ]
        priority = [move[1] for row in moves for move in row]
        path = {"kind": "formula", "formula": nested(formula), "automaton": "automaton"}
        question, directions = random_question(rng, form, path, formula_text(nested(formula)))
        owners = [owner[v // num_q] for v in range(len(product))]
        best, attained = optimum(
            product, owners, directions, functools.partial(parity_values, priority)
        )
        members = model(states, labels=labels, owner=owner if has_players else None)
        shape = [len(states), num_q]
        sizes = [len(rows) for rows in product]
        for side, ours in (("lower", "max"), ("upper", "min")):
            policy = attained.get(ours)
            if policy is None:
                continue
            for change in (False, True, True, True):
                values, rows = mutated(rng, best, policy, sizes) if change else (best, policy)
                texts = {"automaton": hoa(formula)}
                made = claim_file(members, question, side, values, rows, shape, texts)
                status, text = outcome(tmp_path, capsys, made)
                true = values[0] <= best[0] if side == "lower" else values[0] >= best[0]
                assert (status == 1 or true) if change else status == 0, text


def formula_file(formula, text, letters=((0, 0), (1, 0), (0, 1), (1, 1)), bound="0", **more):
    """A trivial claim of a formula on a loop through all letters."""
    count = len(letters)
    states = [[[((s + 1) % count, 1.0)]] for s in range(count)]
    labels = {"ab"[i]: [s for s, x in enumerate(letters) if x[i]] for i in range(2)}
    num_q = int(text.split("States:")[1].split()[0])
    question = {
        "text": f"Pmax=? [ {formula_text(nested(formula))} ]",
        "path": {"kind": "formula", "formula": nested(formula), "automaton": "automaton"},
        "objective": "max",
    }
    claim = {"side": "lower", "bound": bound, "values": "values"}
    arrays = {"values": ("double", [count, num_q], [0.0] * (count * num_q))}
    members = model(states, labels=labels)
    return certificate(members, question, [claim], arrays, {"automaton": text})


@pytest.mark.parametrize("other", AUTOMATA)
@pytest.mark.parametrize("formula", [*AUTOMATA, "b R (a | b)", "F (a & (X b))", "G (a -> (F b))"])
def test_an_automaton_of_another_formula_is_refused(formula, other, tmp_path, capsys):
    status, text = outcome(tmp_path, capsys, formula_file(formula, hoa(other)))
    assert status == (formula != other), text
    assert formula == other or "a word that" in text


def test_automata_of_the_library_are_right_for_their_formulas(tmp_path, capsys):
    from jaxltl import to_automaton
    from jaxltl.core.automata import is_equivalent
    from jaxltl.io import write_hoa

    formulas = [
        "a W b",
        "a M b",
        "X (a xor b)",
        "(F a) <-> (G b)",
        "(a U b) U a",
        "(G F a) => (G F b)",
    ]
    formulas += [
        "F G (a | (X b))",
        "!(a R (X !b))",
        "G (a -> (X (b U a)))",
        "true",
        "F (a & (X F b))",
    ]
    texts = {f: write_hoa(to_automaton(f)) for f in formulas}
    for formula, other in itertools.product(formulas, formulas):
        if other == formula or len(formula) + len(other) < 18:
            made = formula_file(formula, texts[other])
            status, text = outcome(tmp_path, capsys, made)
            assert status == (not is_equivalent(formula, other)), (formula, other, text)


def test_a_large_tableau_leaves_the_automaton_on_trust(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("jaxltl.checker.LARGEST_TABLEAU", 1)
    status, text = outcome(tmp_path, capsys, formula_file("!b U a", hoa("!b U a")))
    assert status == 3 and text.splitlines()[-1] == "ACCEPTED, given the automaton"


# --- policies ---------------------------------------------------------------------------------

# From state 0 the rows lead to 1 and to 2; the goal is to see both, again and again.
FORK = [[[(1, 1.0)], [(2, 1.0)]], [[(0, 1.0)]], [[(0, 1.0)]]]
BOTH = """HOA: v1
States: 2
Start: 0
AP: 2 "one" "two"
Acceptance: 1 Inf(0)
--BODY--
State: 0
[0] 1
[!0] 0
State: 1
[1] 0 {0}
[!1] 1
--END--
"""


def memory_file(policy, successors, **more):
    """A controller of two memory states, and a claim of probability 1."""
    question = {
        "text": 'Pmax=? [ (G (F "one")) & (G (F "two")) ]' + more.get("tail", ""),
        "path": {"kind": "formula", "formula": nested("(G F one) & (G F two)")}
        | {"automaton": "both"},
        "objective": "max",
        **more.get("question", {}),
    }
    shape = [3, 2, 2]
    arrays = {
        "values": ("double", shape, [1.0] * 12),
        "policy": ("uint32", shape, policy),
        "next": ("uint32", shape, successors),
        **more.get("arrays", {}),
    }
    claim = {"side": "lower", "bound": "1", "values": "values"}
    claim |= {"policy": "policy", "memory": 2, "next": "next"}
    labels = {"one": [1], "two": [2]}
    members = model(FORK, labels=labels, actions=[0, 1, 0, 0])
    return certificate(members, question, [claim], arrays, {"both": BOTH})


ALTERNATE = [0, 1] * 2 + [0] * 8  # in state 0 the row is the memory state
FLIP = [1, 0] * 2 + [0, 1] * 4  # in state 0 the memory flips
STUBBORN = [0, 0] * 2 + [0] * 8


def test_finite_memory(tmp_path, capsys):
    for policy, expected in ((ALTERNATE, 0), (STUBBORN, 1)):
        made = memory_file(policy, FLIP)
        status, text = outcome(tmp_path, capsys, made)
        assert status == expected, text


def test_policies_that_see_observations_alone(tmp_path, capsys):
    more = {"question": {"observations": "seen"}, "tail": " // policies see observations"}
    for seen, expected in (([0, 1, 1], 0), ([0, 0, 1], 1)):
        arrays = {"seen": ("uint32", [3], seen)}
        made = memory_file(ALTERNATE, FLIP, arrays=arrays, **more)
        status, text = outcome(tmp_path, capsys, made)
        assert status == expected and ("more than observations" in text) == expected, text
    # The automaton state is not seen.
    peeking = [0, 0, 1, 1] + [0] * 8
    made = memory_file(peeking, FLIP, arrays={"seen": ("uint32", [3], [0, 1, 1])}, **more)
    assert outcome(tmp_path, capsys, made)[0] == 1


def mixed_values(states, weights, direction, value_of_chain):
    """Values of a randomised policy, with the vertices of each row that are best in a direction."""
    choose, best = {"max": max, "min": min}[direction], None
    every = [vertices(row) for rows in states for row in rows]
    for chosen in itertools.product(*every):
        rows, chain = iter(chosen), []
        for s, options in enumerate(states):
            total = sum(weights[s])
            mean: dict = {}
            for w, row in zip(weights[s], [next(rows) for _ in options], strict=True):
                for t, p in row:
                    mean[t] = mean.get(t, 0) + p * w / total
            chain.append([*mean.items()])
        values = value_of_chain(chain)
        best = values if best is None else [*map(choose, best, values)]
    return best


@pytest.mark.parametrize("nature", ["adversarial", "cooperative"])
@pytest.mark.parametrize("form", ["mdp", "intervals"])
def test_a_given_randomised_policy(form, nature, tmp_path, capsys):
    rng = random.Random(f"{form} {nature}")
    accepted = refused = 0
    goal, everything = {2}, {0, 1, 2}
    for _ in range(10):
        states = random_states(rng, 3, form == "intervals")
        weights = [[Fraction(rng.randint(1, 3)) for _ in rows] for rows in states]
        direction = "max" if nature == "cooperative" else "min"
        best = mixed_values(
            states, weights, direction, lambda chain: chain_values(chain, goal, everything)
        )
        question = {"path": UNTIL, "objective": "max", "policy": "given"}
        question |= {"nature": nature} if form == "intervals" else {}
        head = f"Pmax{direction}" if form == "intervals" else "Pmax"
        question["text"] = f'{head}=? [ F "goal" ] // of a given policy'
        flat = [float(w) for row in weights for w in row]
        for side, sign in (("lower", 1), ("upper", -1)):
            for move in (0, 0.25, -0.25):
                values = [x + Fraction(move) * (i < 2) for i, x in enumerate(best)]
                made = claim_file(
                    model(states, labels={"goal": [2]}), question, side, values, [0] * 3, [3]
                )
                index = json.loads(made["certificate/index.json"])
                del index["claims"][0]["policy"]
                index["members"]["given"] = {"dtype": "double", "shape": [len(flat)]}
                made["certificate/given.bin"] = doubles(flat)
                made["certificate/index.json"] = json.dumps(index).encode()
                status, text = outcome(tmp_path, capsys, made)
                true = sign * (values[0] - best[0]) <= 0
                assert (status == 0) if not move else (status == 1 or true), text
                accepted, refused = accepted + (status == 0), refused + (status == 1)
    assert accepted > 20 and refused > 5


@pytest.mark.parametrize("weights", [[1.0, -1.0, 3.0], [0.0, 0.0, 0.0], [math.nan, 1.0, 1.0]])
def test_weights_of_a_policy_are_numbers_of_at_least_0(weights, tmp_path, capsys):
    arrays = {"policy": ("double", [7], [*weights, 1.0, 1.0, 1.0, 1.0])}
    status, text = outcome(tmp_path, capsys, five(arrays=arrays))
    assert status == 1 and "the weights of a policy" in text


# --- counts -----------------------------------------------------------------------------------

COIN = {  # 90 of 100, with a confidence of 0.95: intervals of three tests
    "hoeffding": (0.7641, 1.0),
    "clopper-pearson": (0.8237, 0.9511),
    "anytime": (0.7724, 0.9710),
}


def coin_file(method, low, high, confidence="0.95", **more):
    """A coin that fell 90 times of 100 on the goal, and its interval."""
    states = [[[(1, (low, high)), (2, (1 - high, 1 - low))]], [[(1, (1.0, 1.0))]]]
    states += [[[(2, (1.0, 1.0))]]]
    question = {"text": 'Pmaxmin=? [ F "goal" ]', "path": UNTIL, "objective": "max"}
    question |= {"nature": "adversarial"}
    arrays = {"low": ("double", [3], [low, 1.0, 0.0]), "counts": ("uint64", [4], [90, 10, 0, 0])}
    claims = [{"side": "lower", "bound": str(Fraction(low)), "values": "low"}]
    made = certificate(model(states, labels={"goal": [1]}), question, claims, arrays)
    counts = {"member": "counts", "method": method, "confidence": confidence}
    return edited(made, counts={**counts, "assumption": "there are no others"}, **more)


@pytest.mark.parametrize("method", COIN)
def test_intervals_contain_confidence_sets_of_counts(method, tmp_path, capsys):
    low, high = COIN[method]
    status, text = outcome(tmp_path, capsys, coin_file(method, low, high))
    assert status == 0 and "with confidence 0.95" in text and "there are no others" in text
    assert ("fixed in advance" in text) == (method != "anytime")
    for ends in ((low + 0.001, high), (low, high - 0.001)):
        status, text = outcome(tmp_path, capsys, coin_file(method, *ends))
        assert status == 1 and "the counts allow more" in text, ends
    assert outcome(tmp_path, capsys, coin_file(method, low, high, "0.96"))[0] == 1
    assert outcome(tmp_path, capsys, coin_file("guess", low, high))[0] == 2
    huge = {**coin_file(method, low, high), "certificate/counts.bin": words([2**40, 10, 0, 0])}
    status, text = outcome(tmp_path, capsys, huge)
    assert status == 2 and "over 2^20 samples" in text
    index = json.loads(coin_file(method, low, high)["certificate/index.json"])
    question = {**index["question"], "nature": "cooperative", "text": 'Pmaxmax=? [ F "goal" ]'}
    status, text = outcome(tmp_path, capsys, coin_file(method, low, high, question=question))
    assert status == 1 and "what all intervals prove" in text


def test_intervals_of_the_library_contain_confidence_sets():
    intervals_from_counts = jaxltl.statistics.intervals_from_counts

    rng = random.Random(3)
    for method in COIN:
        for n in (1, 2, 7, 40, 1000):
            counts = [[k, n - k] for k in {0, 1, n, rng.randint(0, n)} if k <= n]
            found = intervals_from_counts(counts, 0.9, method=method)
            chance = Fraction(1, 10) / len(counts)
            for (k, j), low in zip(counts, found.lower, strict=True):
                for count, end in ((k, low[0]), (j, low[1])):
                    for shift, expected in ((0, True), (2.0**-8, False)):
                        x = Fraction(float(end)) + Fraction(shift) * (count > 0)
                        is_in = x == 0 or excludes(method, count, n, x, chance)
                        assert is_in == (expected or count == 0), (method, n, count)


def test_the_command_verify_is_the_checker(tmp_path):
    from click.testing import CliRunner

    from jaxltl.cli import main as command

    for bounds, status, last in (
        (("0.589", "0.611"), 0, "ACCEPTED"),
        (("0.6", "0.611"), 1, "beyond 0.6"),
    ):
        path = write(tmp_path / "file.umb", five(bounds=bounds))
        result = CliRunner().invoke(command, ["verify", str(path)])
        assert result.exit_code == status and result.output.strip().endswith(last)
