"""What a task file asks of its policy is what the policy has, and the report says why."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import jaxltl as jl
from benchmarks.mistakes import losses
from jaxltl.algos import mlirl
from jaxltl.algos.common.seeds import Training, make_hparams
from jaxltl.algos.mlirl import guaranteed
from jaxltl.app import learn as job
from jaxltl.app.learn import report
from jaxltl.core.values.undiscounted.mixture import WINDOW, at_starts
from tests.algos.test_guaranteed import bottoms, evaluate
from tests.app.test_task import write  # noqa: F401

EXAMPLES = Path(__file__).parents[2] / "examples"


def learned(path, seed=0):
    """The outcome of a task file, and its summary."""
    setup = job.prepare(job.FILE.read(path), seed)
    outcome = job.learn(setup, Training(seed, 1))
    return outcome, job.summary(outcome)


def kept_policy(outcome):
    return np.asarray(outcome.kept.policy)


# --- the examples ------------------------------------------------------------------------------


def likeliest_routes(model, policy, start, num_steps, ending):
    """The two most likely sequences of actions that end in a set of pairs: logarithms, the first.

    In a world without chance, by dynamic programming from behind.

    Args:
      start: state and memory.
      ending: ``bool[S, Q]``.
    """
    assert (np.asarray(model.mdp.probability) == [1] + [0] * (model.num_successors - 1)).all()
    after = np.asarray(model.mdp.successor)[:, :, 0]
    read = after if model.label_on == "entry" else np.arange(len(after))[:, None]
    memory = np.asarray(model.next_memory)[read].swapaxes(1, 2)  # [S, Q, A]
    with np.errstate(divide="ignore"):
        step = np.log(policy)[..., None]
    best = np.where(ending[..., None], [0, -np.inf], -np.inf)
    choices = []
    for _ in range(num_steps):
        ways = (step + best[after[:, None], memory]).reshape(*ending.shape, -1)
        order = np.argsort(-ways, axis=-1, kind="stable")
        choices.append(order[..., 0] // 2)
        best = np.take_along_axis(ways, order[..., :2], -1)
    first, (s, q) = [], start
    for choice in reversed(choices):
        first.append(int(choice[s, q]))
        s, q = after[s, first[-1]], memory[s, q, first[-1]]
    return best[start], first


def check_demonstrated_route(outcome, ending):
    """No other route of its length that ends well is as likely as the one demonstrated."""
    model, shown = outcome.setup.model, outcome.setup.demonstrations
    s = int(shown.state[0, 0])
    start = s, int(model.initial_memory[s])
    values, route = likeliest_routes(
        model, kept_policy(outcome), start, int(shown.length[0]), ending
    )
    assert route == np.asarray(shown.action)[0].tolist()
    assert values[0] > values[1] + 1
    return np.exp(values)


@pytest.fixture(scope="module")
def fetched():
    return learned(EXAMPLES / "one_demonstration.toml")


@pytest.mark.slow
def test_one_demonstration_is_enough(fetched):
    outcome, result = fetched
    assert result["satisfaction"]["minimum"]["lower"] == 1
    assert (
        "good",
        "By the transition graph: from every initial state the policy satisfies the formula with "
        "probability 1, whatever the transition probabilities are. It takes only actions that "
        "preserve this.",
    ) in report.remarks(result)
    *_, sure = bottoms(outcome.setup.model, kept_policy(outcome))
    start = int(outcome.setup.demonstrations.state[0, 0])
    assert sure[start, int(outcome.setup.model.initial_memory[start])]


@pytest.mark.slow
def test_the_demonstrated_route_is_the_most_likely_one(fetched):
    outcome, _ = fetched
    first, second = check_demonstrated_route(outcome, np.asarray(outcome.setup.model.final))
    assert first > 0.9 and second < 0.01


@pytest.mark.slow
def test_one_round_shown_is_repeated_for_ever():
    outcome, result = learned(EXAMPLES / "patrol_two.toml")
    model, shown = outcome.setup.model, outcome.setup.demonstrations
    assert result["satisfaction"]["minimum"]["lower"] == 1
    *_, sure = bottoms(model, kept_policy(outcome))
    start = int(shown.state[0, 0])
    assert sure[start, int(model.initial_memory[start])]
    # At the end it is where it was after three steps, and its ways lead round and round.
    s, a = int(shown.state[0, -1]), int(shown.action[0, -1])
    last, again = int(model.mdp.successor[s, a, 0]), int(shown.state[0, 3])
    assert last == again
    ending = np.zeros(model.state_shape, bool)
    ending[last] = True
    first, second = check_demonstrated_route(outcome, ending)
    assert first > 0.9 and second < 0.01
    policy, done = kept_policy(outcome), np.asarray(shown.action)[0]
    s, q = start, int(model.initial_memory[start])
    for t in range(100):
        a = int(policy[s, q].argmax())
        assert a == (done[t] if t < 3 else done[3 + (t - 3) % 16])
        assert policy[s, q, a] > 0.99
        s = int(model.mdp.successor[s, a, 0])
        q = int(model.next_memory[s, q])


# --- a probability -----------------------------------------------------------------------------

FORMULAS = ("!r U y", "F(a & X F y)", "!r U (a | y)", "F y & (!r U y)")
RISKY = """
[world]
map = '''
{map}
'''
slip = {slip}
absorbing = ["y"]
initial = "!r & !y"

[task]
formula = "{formula}"
steps_factor = "none"
guarantee = {asked}

[demonstrations]
file = "shown.json"

[learner]
method = "mlirl"
discount = 0.9
steps = 100
"""
STEPS = 8


def careless_walk(rng, world):
    """Straight on, mostly, whatever is in the way."""
    s, straight, states, actions = int(rng.integers(world.num_states)), rng.integers(4), [], []
    for _ in range(STEPS):
        a = int(straight if rng.random() < 0.5 else rng.integers(4))
        states.append(s)
        actions.append(a)
        s = int(
            rng.choice(np.asarray(world.successor)[s, a], p=np.asarray(world.probability)[s, a])
        )
    return {"states": states, "actions": actions}


def risky_task(rng, place, over):
    """A task file that asks for some share of the optimum, which not every policy has."""
    while True:
        cells = rng.choice(list(".ary"), size=(3, 3), p=[0.55, 0.15, 0.2, 0.1])
        if {*cells.ravel()} != {*".ary"}:
            continue
        text = "\n".join(map(" ".join, cells))
        given = {"map": text, "slip": rng.choice([0.1, 0.2, 0.4]), "formula": rng.choice(FORMULAS)}
        world = jl.gridworld(text, slip=given["slip"], absorbing=["y"], initial="!r & !y")
        model = jl.product(world, str(given["formula"]))
        best, _ = at_starts(model, jl.optimal_satisfaction(model).lower, over)
        if best < 0.05:
            continue
        asked = best * float(rng.choice([rng.uniform(0.6, 1), 1 - 10 ** rng.uniform(-4, -1)]))
        runs = {"demonstrations": [careless_walk(rng, world) for _ in range(3)]}
        (place / "shown.json").write_text(json.dumps(runs))
        worst = f'{asked}\nover = "worst"' if over == "worst" else asked
        (place / "risky.toml").write_text(RISKY.format(**given, asked=worst))
        return place / "risky.toml", asked


def weighed(outcome, weights_of_task):
    """What the same seed learns with given weights of the task."""
    setup = outcome.setup
    table, demands = setup.task.learner, setup.demands
    hparams = make_hparams(mlirl.Hparams, table.specified())
    for mu in weights_of_task:
        settings = guaranteed._Settings(
            demands, replace(hparams, mu=float(mu)), table.steps, table.tolerance
        )
        yield settings.train(demands.problem, Training(0, 1))


def check_risky(rng, place, over, weights_of_task):
    path, asked = risky_task(rng, place, over)
    outcome, result = learned(path)
    attempt, model, task = outcome.kept.attempt, outcome.setup.model, outcome.setup.task
    assert (task.guarantee, task.over) == (pytest.approx(asked, rel=1e-15), over)
    value, _ = evaluate(model, kept_policy(outcome))
    attained, _ = at_starts(model, value, over)
    by_itself = attempt.weight == 0 and attempt.share == 0
    assert asked - 1e-12 <= attained and attempt.attained >= asked
    (free,) = weighed(outcome, [0.0])
    # More than was asked for is given only where it makes the demonstrations more likely.
    assert attempt.attained <= asked + WINDOW or (
        attempt.neg_log_likelihood <= free.neg_log_likelihood[0] * (1 + 1e-9)
    )
    assert attempt.attained == pytest.approx(attained, abs=1e-9)
    assert result["guarantee"]["attained"] == attempt.attained
    certified = result["satisfaction"]["mean" if over == "mean" else "minimum"]["lower"]
    assert certified >= asked - 1e-15

    def loss(one, nll):  # without a weight, what is minimised has the prior
        return float(nll + by_itself * np.sum(one.weights[0] ** 2) * 1e-3 / 2)

    found = loss(attempt.learned, attempt.neg_log_likelihood)
    np.testing.assert_allclose(
        outcome.kept.learned.neg_log_likelihood[outcome.kept.chosen], attempt.neg_log_likelihood
    )
    reaching = [
        loss(one, one.neg_log_likelihood[0])
        for one in weighed(outcome, weights_of_task)
        if at_starts(model, jl.satisfaction_probability(model, one.policy[0]).lower, over)[0]
        >= asked
    ]
    return attempt, found / min(reaching, default=np.inf) - 1


def check_many(count, grid, over, place):
    """Likelihoods have several maxima, so that a search may end in a lesser one, seldom and near."""
    rng = np.random.default_rng([count, over == "worst"])
    found, excess = zip(*(check_risky(rng, place, over, grid) for _ in range(count)), strict=True)
    assert any(x.weight or x.share for x in found)
    worse = [x for x in excess if x > 1e-6]
    assert len(worse) <= 1 and max(worse, default=0) < 0.01, excess


@pytest.mark.parametrize(
    ("count", "grid"),
    [
        pytest.param(3, np.logspace(-2, 2, 4), marks=pytest.mark.slow),
        pytest.param(50, np.logspace(-3, 5, 64), marks=pytest.mark.exhaustive),
    ],
)
def test_a_probability_is_reached_and_nothing_given_away(tmp_path, count, grid):
    check_many(count, grid, "mean", tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("count", "grid"),
    [
        (1, np.logspace(-2, 2, 4)),
        pytest.param(8, np.logspace(-3, 5, 64), marks=pytest.mark.exhaustive),
    ],
)
def test_a_probability_is_reached_from_the_worst_start(tmp_path, count, grid):
    check_many(count, grid, "worst", tmp_path)


@pytest.mark.parametrize(
    ("lower", "upper", "kind", "words"),
    [
        (0.5, 0.5 + 1e-9, "good", "A loss of at most 1.0e-09 on average is certified"),
        (0.5, 0.6, "warning", "for the policy a loss of at most 0.1 is certified on average"),
        (None, 0.6, "warning", "for the policy no bound is certified on average"),
    ],
)
def test_no_more_is_said_than_is_certified(lower, upper, kind, words):
    mean = {"value": 0.5, "lower": lower, "upper": upper}
    least = {"value": 0.4, "lower": 0.4, "upper": 0.5, "state": 0}
    solved = {"mean": mean, "minimum": least, "status": "CONVERGED", "num_starts": 1}
    result = {
        "satisfaction": solved,
        "best_achievable": solved,
        "guarantee": {"asked": "best"},
        "training": {"converged": True, "steps": 1},
        "neg_log_likelihood": 1.0,
        "weights": {},
        "expected_steps": None,
        "impossible_starts": [],
        "remark": None,
        "trivial": None,
    }
    ((found, text),) = report.remarks(result)
    assert found == kind and words in text


# --- what is refused, left out, said -----------------------------------------------------------

ERRING = {
    "demonstrations": [
        {"cells": [[2, 1], [2, 2]], "actions": ["right", "right"]},
        {"cells": [[2, 1], [2, 2], [1, 2]], "actions": ["right", "up", "right"]},
    ]
}
SLIPPERY = ('absorbing = ["y"]', 'absorbing = ["y"]\nslip = 0.2')
CORRIDOR = (". . r\nb . y", "r . r\nb . y\nr r r")  # here nothing is sure


def asking(guarantee):
    """Without a bound on the steps, which adds a share of its own."""
    return "[task]", f'[task]\nsteps_factor = "none"\nguarantee = {guarantee}'


def prepared(path):
    return job.prepare(job.FILE.read(path), 0)


@pytest.mark.slow
def test_demonstrated_steps_that_lose_are_left_out_and_named(write):  # noqa: F811
    outcome, result = learned(write(CORRIDOR, SLIPPERY, shown=ERRING))
    setup, lost = outcome.setup, result["guarantee"]["left_out"]
    assert setup.guarantee.forbidden.tolist() == [[False] * 3, [False, True, True]]
    model = setup.model
    start = int(model.initial_memory[4])
    best, _ = evaluate(model, np.eye(4)[np.asarray(setup.guarantee.best.policy)])
    assert lost == {
        "steps": 1,
        "of": 5,
        "demonstration": 2,
        "step": 2,
        "state": 4,
        "row": 2,
        "column": 2,
        "from": pytest.approx(best[4, start]),
        # Up, or by a slip to either side, where the goal is.
        "to": pytest.approx(0.8 * best[1, start] + 0.1 * best[3, start] + 0.1),
    }
    assert lost["from"] > lost["to"] + 0.01
    counts = np.asarray(setup.demands.problem.counts)
    assert counts.sum() == 3 and counts[4, start, 0] == 0
    texts = [text for kind, text in report.remarks(result) if kind == "note"]
    assert texts == [
        "1 of 5 demonstrated steps lowers the maximal satisfaction probability and was left out; first at "
        f"row 2, column 2 (demonstration 2, step 2): from {lost['from']:.4f} to {lost['to']:.4f}.",
        "1 of 5 demonstrated steps comes after the formula was lost, or after a mistake left the best "
        "probability, and was not used.",
    ]
    (good,) = (text for kind, text in report.remarks(result) if kind == "good")
    assert good.startswith("By construction no policy has a greater satisfaction probability")
    value, _ = evaluate(model, kept_policy(outcome))
    np.testing.assert_allclose(value, best, rtol=1e-9, atol=1e-15)


def test_a_demonstration_that_only_loses_is_named(write):  # noqa: F811
    useless = {"cells": [[1, 2]], "actions": ["right"]}
    shown = {"demonstrations": [ERRING["demonstrations"][0], useless]}
    with pytest.raises(ValueError, match="demonstration 2: its only step lowers the best prob"):
        prepared(write(shown=shown))
    useless = {"cells": [[1, 2], [1, 3]], "actions": ["right", "up"]}
    with pytest.raises(ValueError, match="demonstration 1: its first step lowers the best prob"):
        prepared(write(shown={"demonstrations": [useless]}))
    assert prepared(write(asking('"none"'), shown=shown)).guarantee.actions is None
    assert not prepared(write(asking(0.9), shown=shown)).guarantee.usable


def test_formulas_that_nothing_satisfies_are_refused_before_anything_runs(
    write,  # noqa: F811
    monkeypatch,
):
    def never(*_, **__):
        raise AssertionError

    monkeypatch.setattr(job, "optimal_satisfaction", never)
    for formula in ("F (r & y)", "G y & F !y", "r & !r"):
        with pytest.raises(ValueError, match=r"\[task\] formula: nothing satisfies it"):
            prepared(write(("!r U y", formula)))


@pytest.mark.parametrize("formula", ["F y | G !y", "G !(r & y)"])
def test_formulas_that_are_always_true_are_said_to_be(write, formula):  # noqa: F811
    text = prepared(write(("!r U y", formula))).trivial
    assert text == "Every trajectory of this world satisfies the formula, so any policy does."
    assert prepared(write()).trivial is None


def test_what_no_policy_has_is_refused_with_what_is_possible(write):  # noqa: F811
    model = prepared(write(CORRIDOR, SLIPPERY)).model
    best = evaluate(model, np.eye(4)[np.asarray(jl.optimal_satisfaction(model).policy)])[0]
    each = [best[s, int(model.initial_memory[s])] for s in (1, 3, 4)]
    place = (1, 2) if min(each) == each[0] else (2, 1 + int(np.argmin(each[1:])))
    for over, possible in (("mean", np.mean(each)), ("worst", min(each))):
        more, less = (asking(f'{possible + x}\nover = "{over}"') for x in (1e-3, -1e-3))
        where = "least from row {}, column {}".format(*place)
        digits = f"{np.floor(possible * 1e6) / 1e6:g}"
        with pytest.raises(ValueError, match=f"achieved is {digits} .*{where}.; ask for no more"):
            prepared(write(CORRIDOR, SLIPPERY, more))
        assert prepared(write(CORRIDOR, SLIPPERY, less)).guarantee.usable


def test_to_ask_for_certainty_is_to_ask_for_the_best(write):  # noqa: F811
    """From ten cells, whose tenths do not add up to one."""
    wide = (". . r\nb . y", ". . . . . r\nb . . . . y")
    setup = prepared(write(wide, asking(1.0)))
    weight = np.asarray(setup.model.mdp.initial)
    assert np.ones(10) @ weight[weight > 0] < 1 and setup.guarantee.requested == "best"
    assert at_starts(setup.model, np.ones(setup.model.state_shape), "mean")[0] == 1


@pytest.mark.slow
def test_steps_that_lose_nothing_by_themselves_are_left_out_truly_told(write):  # noqa: F811
    """From a, where it may stay for ever, on to b; but back and forth it would fail."""
    path = write(
        (". . r\nb . y", "a . b"),
        ('"y"', '"b"'),
        ("!r & !y", "a"),
        ("!r U y", "F G a | F b"),
        shown={"demonstrations": [{"cells": [[1, 1], [1, 2]], "actions": ["right"] * 2}]},
    )
    _, result = learned(path)
    assert result["guarantee"]["left_out"]["to"] == 1
    (text,) = (text for kind, text in report.remarks(result) if kind == "note")
    assert text == (
        "1 of 2 demonstrated steps leads away from the goal and back, which violates the formula "
        "if repeated for ever, and was left out; first at row 1, column 1 (demonstration 1, step "
        "1)."
    )
    assert result["satisfaction"]["minimum"]["lower"] == 1


@pytest.mark.slow
def test_a_demonstrated_mistake_is_weighed_or_optimal_actions_are_mixed_in(write):  # noqa: F811
    """A weight of the task may attain the probability or not, by the last digits of the search."""
    shown = {"demonstrations": [ERRING["demonstrations"][1]]}
    outcome, result = learned(write(asking('0.9\nover = "worst"'), shown=shown))
    found = result["guarantee"]
    assert 0.9 <= found["attained"] <= 0.9 + WINDOW
    assert (found["weight"] is not None and found["weight"] > 0) or 0 < found["share"] < 1
    value, _ = evaluate(outcome.setup.model, kept_policy(outcome))
    assert at_starts(outcome.setup.model, value, "worst")[0] == pytest.approx(found["attained"])
    assert np.isfinite(result["neg_log_likelihood"])
    (text,) = (text for kind, text in report.remarks(result) if kind == "good")
    assert text.startswith("Asked for 0.9000 from the worst initial state, certified 0.9")
    assert found["share"] == 0 or text.endswith("mixed into the likeliest policy.")


@pytest.mark.slow
def test_where_any_loss_is_all_the_sure_policy_is_what_there_is(write):  # noqa: F811
    shown = {"demonstrations": [ERRING["demonstrations"][1]]}
    outcome, result = learned(write(asking(0.5), ("!r U y", "G F b & G !r"), shown=shown))
    assert result["guarantee"]["share"] == 1 and result["guarantee"]["attained"] == 1
    assert result["neg_log_likelihood"] is None  # a demonstrated step is never taken
    never = result["guarantee"]["never"]
    (text,) = (text for kind, text in report.remarks(result) if kind == "good")
    assert "the only policy found that attains it is one of optimal actions alone." in text
    assert never > 0 and f"It never takes {never} of the demonstrated steps" in text
    shown_in = report.table(result)
    assert "negative log-likelihood  infinite" in shown_in and "unknown" not in shown_in
    _, sure = evaluate(outcome.setup.model, kept_policy(outcome))
    assert sure[3, int(outcome.setup.model.initial_memory[3])]


def test_a_weight_is_not_both_given_and_sought(write):  # noqa: F811
    path = write(asking(0.5), ("discount = 0.9", "discount = 0.9\nmu = 1"))
    with pytest.raises(ValueError, match=r"leave mu out of \[learner\]"):
        job.FILE.read(path)


@pytest.mark.parametrize("asked", ['"best"', '"none"', "0.5"])
def test_steps_after_the_formula_is_lost_are_not_used(write, asked):  # noqa: F811
    """Into r with the second step, and on: only the steps until then count."""
    shown = {
        "demonstrations": [
            {"cells": [[2, 1], [1, 1], [1, 2], [1, 3], [2, 3]], "actions": ["up"] + ["right"] * 2}
        ]
    }
    shown["demonstrations"][0]["actions"] += ["down", "left"]
    setup = prepared(write(asking(asked), shown=shown))
    assert setup.guarantee.used.tolist() == [3]
    assert setup.guarantee.unused(setup.demonstrations).tolist() == [[False] * 3 + [True] * 2]
    counted = 2 if asked == '"best"' else 3  # the mistake itself is left out by the optimal actions
    assert np.asarray(setup.demands.problem.counts).sum() == counted


@pytest.mark.slow
def test_steps_after_a_mistake_would_spoil_the_likelihood(tmp_path):
    (_, few, cut), (_, every, whole) = losses(tmp_path)
    assert few == 132 and every == 177 and cut < 0.1 and whole > 10
