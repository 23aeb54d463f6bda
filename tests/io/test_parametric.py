"""Models with parameters: functions are what their texts say, exactly."""

import re
from dataclasses import replace
from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxltl.core.models.sparse import choice_reward
from jaxltl.io.drn.drn import read_drn, write_drn
from jaxltl.io.drn.parametric import read_parametric
from tests.io.same import assert_same, full_model
from tests.support import counted_traces

CHAIN = """\
@type: DTMC
@parameters
p q\x20
@placeholders
$0 : (p+q)/2
@reward_models
cost\x20
@nr_states
3
@nr_choices
3
@model
state 0 [2*p] init
\taction 0 [p^2-q/3]
\t\t2 : (-1)*p+1
\t\t1 : p
state 1 [0] goal
\taction 0 [(p+1)*(q-2)^2/(p-3)]
\t\t1 : $0
\t\t0 : (2-p-q)/2
state 2 [1/3]
\taction 0 [0]
\t\t2 : 1
"""


def read(tmp_path, text):
    path = tmp_path / "m.drn"
    path.write_text(text)
    return read_parametric(path)


def test_a_chain_with_parameters(tmp_path):
    found = read(tmp_path, CHAIN)
    p, q = Fraction(1, 5), Fraction(1, 4)
    assert found.parameters == ("p", "q")
    model = found.at({"q": q, "p": p})
    assert model.successor.tolist() == [1, 2, 0, 1, 2]
    assert model.probability.tolist() == [0.2, 0.8, 31 / 40, 9 / 40, 1]
    assert model.propositions == ("goal",) and model.initial.tolist() == [1, 0, 0]
    assert model.rewards["cost"].state.tolist() == [0.4, 0, 1 / 3]
    exact = [p**2 - q / 3, (p + 1) * (q - 2) ** 2 / (p - 3), Fraction(0)]
    assert model.rewards["cost"].choice.tolist() == [float(x) for x in exact]
    other = found.at({"p": 0.0, "q": 1.0})  # what has probability zero is left out
    assert other.successor.tolist() == [2, 0, 1, 2]


def test_functions_are_what_their_texts_say(tmp_path):
    rng = np.random.default_rng(0)
    point = {"p": Fraction(2, 7), "q": Fraction(-3, 5)}

    def text(depth):
        if depth == 0 or rng.random() < 0.2:
            return str(rng.choice(["p", "q", "2", "0.5", "(-1)", "1e-2", "3/4"]))
        a, b = text(depth - 1), text(depth - 1)
        kind = rng.integers(5)
        if kind == 4:
            return f"({a})^{rng.integers(4)}"
        return f"({a}){'+-*/'[kind]}({b})" if rng.random() < 0.5 else f"({a}{'+-*+'[kind]}{b})"

    for _ in range(60):
        given = text(3)
        exact = re.sub(r"\d+(\.\d+|e-\d+)?", r"F('\g<0>')", given.replace("^", "**"))
        try:
            value = eval(exact, {"F": Fraction, **point})
        except ZeroDivisionError:
            continue
        chain = CHAIN.replace("2*p", given)
        found = read(tmp_path, chain)
        number = found.rewards["cost"][0][0]
        assert found.functions[number].at(tuple(point.values())) == value, given


def test_signs_and_powers_bind_as_in_storm(tmp_path):
    """Signs bind less than powers; sums of a thousand terms are within the limits of nesting."""
    for text, value in {
        "-p^2": -4,
        "3-+-p**2": 7,
        "2^-p": None,
        "p^-2": Fraction(1, 4),
        "1" + "+p-q" * 500: -499,
        "0.12345678901234567890123*p": Fraction("0.24691357802469135780246"),
    }.items():
        chain = CHAIN.replace("2*p", text)
        if value is None:
            with pytest.raises(ValueError, match="no power with an integer"):
                read(tmp_path, chain)
            continue
        model = read(tmp_path, chain)
        assert model.functions[model.rewards["cost"][0][0]].at((2, 3)) == value, text


def test_models_without_parameters_are_read_as_ever(tmp_path):
    model = full_model(np.random.default_rng(2), transition_rewards=False)
    finite = {
        name: type(r)(
            *(
                None if x is None else np.where(abs(x) < 1e99, x, 1)
                for x in (r.state, r.choice, None)
            )
        )
        for name, r in model.rewards.items()
    }
    write_drn(tmp_path / "m.drn", replace(model, rewards=finite))
    found = read_parametric(tmp_path / "m.drn").at({})
    assert_same(found, read_drn(tmp_path / "m.drn"))


def test_numbers_alone_are_not_what_such_files_hold(tmp_path):
    (tmp_path / "m.drn").write_text(CHAIN)
    with pytest.raises(ValueError, match=r"parameters, p, q; jaxltl.io.drn.parametric.read_param"):
        read_drn(tmp_path / "m.drn")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("2*p", "2*r", "line 13: '2.r' stands where a function of p, q .it is malformed at 'r'"),
        ("2*p", "2p", "line 13: '2p' .* malformed at 'p'"),
        ("2*p", "2*", "line 13: .*it is cut"),
        ("2*p", "(2*p", "line 13: .*it is cut"),
        ("2*p", "2/(p-p)", "divided by zero"),
        ("2*p", "p^p", "no power with an integer up to 1000"),
        ("2*p", "p^2000", "no power with an integer up to 1000"),
        ("2*p", "((p+q)^40*(p-q)^40)^40", "too large"),
        ("2*p", "(" * 60 + "p" + ")" * 60, "line 13: .*too large: parentheses are nested deeper"),
        ("2*p", "-" * 9999 + "p", "line 13: .*too large: operators are nested deeper"),
        ("2*p", "p?p:p", "no rational function"),
        ("2*p", "1e999999999", "malformed"),
        ("2*p", "((9^999)^999)", "too large"),
        ("(p+q)/2", "(p+r)/2", "the placeholder .0 stands for '.p.r./2', which is malformed"),
        ("p q", "p p", "a parameter is named twice"),
    ],
)
def test_what_is_wrong_is_named(tmp_path, old, new, message):
    with pytest.raises(ValueError, match=message):
        read(tmp_path, CHAIN.replace(old, new, 1))


def test_points_that_are_none_are_named(tmp_path):
    found = read(tmp_path, CHAIN)
    for values, message in {
        (("p", 0.5),): "values are given for p; the parameters are p, q",
        (("p", 3), ("q", 0)): "a function has a pole at",
        (("p", 2.0), ("q", 0.0)): "state 0, choice 0: probability -1",
        (("p", float("nan")), ("q", 0.0)): r"values\[.p.\]=nan; give a finite number",
    }.items():
        with pytest.raises(ValueError, match=message):
            found.at(dict(values))


# --- as functions of arrays -------------------------------------------------------------------

BOX = {"p": (0.2, 0.6), "q": (0.1, 0.5)}
LOW, HIGH = ({name: ends[i] for name, ends in BOX.items()} for i in range(2))

# Two entries lead from state 1 to state 0; state 2 does not lead to state 1, whatever p is.
PARALLEL = CHAIN.replace("\t\t0 : (2-p-q)/2", "\t\t0 : 1/4\n\t\t0 : 3/4-(p+q)/2").replace(
    "\t\t2 : 1\n", "\t\t2 : 1\n\t\t1 : p-p\n"
)


@pytest.mark.parametrize("text", [CHAIN, PARALLEL])
def test_functions_of_arrays_are_those_of_the_file(tmp_path, text):
    found = read(tmp_path, text)
    over = found.over(LOW, HIGH)
    evaluate = jax.jit(lambda numbers, x: numbers(x))
    for x in ([0.25, 0.5], [0.6, 0.1], over.inside):
        exact = found.at(dict(zip("pq", x, strict=True)))
        probability, rewards = evaluate(over.numbers, jnp.array(x))
        np.testing.assert_allclose(probability, exact.probability, rtol=1e-14)
        np.testing.assert_allclose(rewards["cost"], choice_reward(exact), rtol=1e-13, atol=1e-15)
        assert_same(over.at(x), exact)
    assert_same(over.model, over.at(over.inside))
    assert over.parameters == ("p", "q") and over.low.tolist() == [0.2, 0.1]


def test_a_file_that_is_read_again_compiles_nothing(tmp_path):
    evaluate = jax.jit(lambda model, x: model.numbers(x))
    one, other = (read(tmp_path, CHAIN).over(LOW, HIGH) for _ in range(2))
    evaluate(one, one.inside)
    with counted_traces() as traced:
        evaluate(other, one.inside)
        evaluate(other.within(LOW, 0.5), one.inside)
    assert not traced
    assert read(tmp_path, CHAIN.replace("p^2", "p^3")).over(LOW, HIGH).exact != one.exact


@pytest.mark.parametrize(
    ("low", "high", "message"),
    [
        ({"p": 0.2}, 0.5, "low: q is missing"),
        (0.5, 0.2, "interval of p is .0.5, 0.2.; low must be below high"),
        (-0.9, -0.1, "no model at any of 64 points of the box; at .* probability -"),
        (2.5, 3.5, "no model at any of 64 points"),
    ],
)
def test_boxes_without_a_model_are_refused(tmp_path, low, high, message):
    with pytest.raises(ValueError, match=message):
        read(tmp_path, CHAIN).over(low, high)


def test_where_transitions_are_gone_there_is_no_such_model(tmp_path):
    over = read(tmp_path, CHAIN).over(0.0, 1.0)
    with pytest.raises(ValueError, match="some transitions are gone"):
        over.at({"p": 0.0, "q": 0.5})
