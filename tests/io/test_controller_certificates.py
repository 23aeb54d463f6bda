"""Certificates of controllers of POMDPs: written, accepted, and refused once something is changed."""

import gzip
import io
import json
import re
import tarfile
from dataclasses import replace

import jax
import numpy as np
import pytest

import jaxltl as jl
from jaxltl.checker import main
from jaxltl.io import read_umb, write_certificate
from tests.io.same import assert_same_pomdp


@pytest.fixture(autouse=True)
def in_double_precision():
    with jax.enable_x64(True):
        yield


def coin(initial=(0.25, 0.75, 0, 0, 0, 0)):
    """A hidden coin: guess heads, guess tails, or look at it, which lasts a step."""
    table = np.zeros((6, 3, 6))
    table[0, :, [3, 2, 4]] = table[1, :, [2, 3, 5]] = np.eye(3)
    table[4, :, [3, 2, 0]] = table[5, :, [2, 3, 1]] = np.eye(3)
    table[[2, 3], :, [2, 3]] = 1
    cost = jl.models.Rewards(choice=np.array([1, 1, 3] * 2 + [0] * 6 + [1, 1, 1] * 2, float))
    world = jl.to_sparse(jl.from_dense(table, initial=initial, label={"right": [2], "end": [2, 3]}))
    return jl.models.make_pomdp(replace(world, rewards={"cost": cost}), [0, 0, 1, 1, 2, 3])


# Guess tails; or look once, and guess what was seen: memory 0, then the coin.
BLIND = jl.FiniteMemoryPolicy(np.array([[0]] * 4), np.zeros(4, int), np.zeros((4, 1), int))
MIXED = BLIND.replace(action=np.full((4, 1, 3), [0.5, 0.25, 0.25]))
LOOK = jl.FiniteMemoryPolicy(
    np.array([[2], [0], [1], [0]]), np.zeros(4, int), np.zeros((4, 1), int)
)


def claims(path, capsys):
    assert main([str(path)]) == 0, capsys.readouterr().out
    lines = capsys.readouterr().out.splitlines()
    found = {}
    for line in lines:
        if line.startswith("claimed: "):
            relation, bound = line.rsplit(" is ", 1)[1].split(" ")[:2]
            above, _, below = bound.partition("/")
            found[relation] = int(above) / int(below) if below else float(above)
    return found, lines[0]


@pytest.mark.parametrize("initial", [(0.25, 0.75, 0, 0, 0, 0), (0, 1, 0, 0, 0, 0)])
@pytest.mark.parametrize(
    ("policy", "question", "value"),
    [
        (BLIND, 'Pmax=? [ F "right" ]', lambda p: p),
        (MIXED, 'Pmax=? [ F "right" ]', None),
        (LOOK, 'Pmax=? [ F G "right" ]', lambda p: 1),
        (LOOK, 'Pmin=? [ (G F "right") & (F "end") ]', lambda p: 1),
        (LOOK, 'R{"cost"}min=? [ F "end" ]', lambda p: 4),
        (BLIND, 'R{"cost"}max=? [ C ]', lambda p: 1),
    ],
)
def test_both_bounds_of_a_given_controller(policy, question, value, initial, tmp_path, capsys):
    pomdp, path = coin(initial), tmp_path / "file.umb"
    write_certificate(path, pomdp, None, question, policy=policy)
    found, text = claims(path, capsys)
    assert "policies see observations, of a given policy" in text
    assert ("from a distribution of initial states" in text) == (initial[0] > 0)
    assert found["<="] - found[">="] < 1e-9
    if value is None:
        expected = jl.reachability_probability(pomdp, "right", policy=policy).value
    else:
        expected = value(initial[1])
    assert found[">="] - 1e-9 <= expected <= found["<="] + 1e-9
    assert_same_pomdp(
        replace(read_umb(path), fully_observable=pomdp.fully_observable), replace(pomdp)
    )


@pytest.mark.parametrize("objective", ["max", "min"])
@pytest.mark.parametrize("formula", ["", "formula"])
def test_the_optimum_lies_between_a_controller_and_policies_that_see(
    objective, formula, tmp_path, capsys
):
    pomdp, path = coin(), tmp_path / "file.umb"
    answer = jl.values.belief_bounds(pomdp, "right", objective=objective)
    inner = 'G F "right"' if formula else 'F "right"'
    write_certificate(path, pomdp, answer, f"P{objective}=? [ {inner} ]")
    found, text = claims(path, capsys)
    assert "policies see observations, from" in text and "given" not in text
    assert abs(found[">="] - answer.lower) < 1e-9 and abs(found["<="] - answer.upper) < 1e-9


def test_what_is_not_covered_is_refused(tmp_path):
    path = tmp_path / "file.umb"
    for policy, message in (
        (None, "certificates of a POMDP are written for a controller"),
        (np.zeros((6, 3)), "give a FiniteMemoryPolicy whose states are the 4 observations"),
    ):
        with pytest.raises(ValueError, match=message):
            write_certificate(path, coin(), None, 'Pmax=? [ F "right" ]', policy=policy)
    with pytest.raises(ValueError, match="memory and bounded steps"):
        write_certificate(path, coin(), None, 'Pmax=? [ F<=3 "right" ]', policy=LOOK)
    answer = jl.values.belief_bounds(coin(), "right")
    wrong = replace(answer, upper=np.float64(0.5), lower=np.float64(0.4))
    with pytest.raises(ValueError, match="contradict"):
        write_certificate(path, coin(), wrong, 'Pmax=? [ F "right" ]')
    assert not path.exists()


def members(path):
    with tarfile.open(fileobj=io.BytesIO(gzip.decompress(path.read_bytes()))) as archive:
        return {x.name: archive.extractfile(x).read() for x in archive if x.isreg()}


def rewritten(path, contents):
    with tarfile.open(path, "w") as archive:
        for name, content in contents.items():
            info = tarfile.TarInfo(name)
            info.size = len(content)
            archive.addfile(info, io.BytesIO(content))


def numbers(contents, name, dtype, change):
    values = np.frombuffer(contents[name], dtype).copy()
    change(values)
    contents[name] = values.tobytes()


def question(contents, change):
    index = json.loads(contents["certificate/index.json"])
    change(index["question"], index)
    contents["certificate/index.json"] = json.dumps(index).encode()


def peek(values):
    """Another choice in state 1, which looks like state 0."""
    values[values.size // 6 : values.size // 3] ^= 1


def swap(values):
    values[:2] = values[1::-1].copy()


def unnamed(q, index):
    del q["observations"]
    q["text"] = q["text"].replace("policies see observations, ", "")


def everywhere(q, index):
    del q["initial"]
    q["text"] = q["text"].replace(", from a distribution of initial states", "")


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (
            lambda c: numbers(c, "certificate/policy.bin", "<u4", peek),
            "REFUSED: state 1: the policy depends on more than observations",
        ),
        (
            lambda c: numbers(c, "certificate/next.bin", "<u4", peek),
            "REFUSED: (state 1: the policy depends on more|a memory state is out of range)",
        ),
        (
            lambda c: numbers(c, "observations/states/values.bin", "<u8", swap),
            None,  # both look alike
        ),
        (
            lambda c: numbers(
                c, "observations/states/values.bin", "<u8", lambda x: x.put([0], [1])
            ),
            "not a certificate: .* the question has not the observations of the model",
        ),
        (
            lambda c: numbers(c, "certificate/observations.bin", "<u4", lambda x: x.put([0], [1])),
            "not a certificate: .* the question has not the observations of the model",
        ),
        (
            lambda c: question(c, unnamed),
            "not a certificate: .* the question has not the observations of the model",
        ),
        (
            lambda c: question(c, everywhere),
            "REFUSED: lower bound: state 0.* is beyond 3/4",
        ),
        (
            lambda c: numbers(c, "certificate/initial.bin", "<f8", swap),
            "REFUSED: lower bound: .* is beyond 3/4",
        ),
        (
            lambda c: numbers(c, "certificate/initial.bin", "<f8", lambda x: x.put([2], [0.5])),
            "not a certificate: .* the weights of initial states are no distribution",
        ),
        (
            lambda c: numbers(c, "certificate/initial.bin", "<f8", lambda x: x.put([0], [-0.5])),
            "not a certificate: .* the weights of initial states are no distribution",
        ),
        (
            lambda c: numbers(c, "certificate/initial.bin", "<f8", lambda x: x.put([0], [np.nan])),
            "not a certificate: ValueError",
        ),
    ],
)
def test_changed_files_are_refused(change, reason, tmp_path, capsys):
    path = tmp_path / "file.umb"
    write_certificate(path, coin(), None, 'Pmax=? [ F "right" ]', policy=BLIND)
    contents = members(path)
    change(contents)
    rewritten(path, contents)
    status, text = main([str(path)]), capsys.readouterr().out
    if reason is None:
        assert status == 0, text
    else:
        assert status in (1, 2) and "ACCEPTED" not in text
        assert re.search(reason, text), text
