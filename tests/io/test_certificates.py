"""Certificates of the solvers' bounds: the checker accepts them, or they are not written."""

from dataclasses import replace
from fractions import Fraction

import jax
import numpy as np
import pytest

import jaxltl as jl
from jaxltl.checker import main
from jaxltl.io import read_drn, read_umb, write_certificate, write_storm_certificate

SIZE = 12


@pytest.fixture(autouse=True)
def in_double_precision():
    with jax.enable_x64(True):
        yield


def random_model(seed, *, size=SIZE, reward=False):
    """A sparse MDP with end components, a goal (the last state) and a trap."""
    rng = np.random.default_rng(seed)
    rows, entries, successor, probability = [0], [0], [], []
    for s in range(size):
        for _ in range(1 if s >= size - 2 else rng.integers(1, 4)):
            width = 1 if s >= size - 2 else int(rng.integers(1, 4))
            targets = [s] if s >= size - 2 else rng.choice(size, width, replace=False)
            successor += sorted(int(t) for t in targets)
            probability += list(rng.dirichlet(np.ones(width)))
            entries.append(len(successor))
        rows.append(len(entries) - 1)
    rewards = (
        {"cost": jl.models.Rewards(state=np.r_[rng.random(size - 1), 0.0])} if reward else None
    )
    return jl.make_sparse(
        rows,
        entries,
        successor,
        probability,
        initial=np.eye(size)[0],
        label={"goal": [size - 1], "safe": [*range(size - 2)]},
        rewards=rewards,
    )


def verified(path, capsys):
    status = main([str(path)])
    assert status == 0, capsys.readouterr().out
    return capsys.readouterr().out


def width(text):
    """Upper minus lower bound of the claims."""
    bounds = [line.split(" is ")[1].split()[1] for line in text.splitlines() if "claimed" in line]
    low, high = (float(x) if "/" not in x else eval(x) for x in bounds)
    return high - low


@pytest.mark.parametrize("objective", ["max", "min"])
@pytest.mark.parametrize("seed", range(6))
def test_probabilities(objective, seed, tmp_path, capsys):
    model = random_model(seed)
    goal, safe = (np.asarray(model.states_with_label(x)) for x in ("goal", "safe"))
    for stay, formula in ((None, 'F "goal"'), (safe, '"safe" U "goal"')):
        found = jl.reachability_probability(model, goal, stay=stay, objective=objective)
        path = tmp_path / "file.umb"
        write_certificate(path, model, found, f"P{objective}=? [ {formula} ]")
        assert width(verified(path, capsys)) < 1e-5
    assert read_umb(path).num_states == SIZE  # other tools read the model


@pytest.mark.parametrize("objective", ["max", "min"])
@pytest.mark.parametrize("seed", range(4))
def test_rewards(objective, seed, tmp_path, capsys):
    model, path = random_model(seed, reward=True), tmp_path / "file.umb"
    goal = np.asarray(model.states_with_label("goal"))
    found = jl.total_reward(model, "cost", goal, objective=objective)
    write_certificate(path, model, found, f'R{{"cost"}}{objective}=? [ F "goal" ]')
    text = verified(path, capsys)
    assert np.isinf(found.value[0]) == ("inf" in text)
    if objective == "max":
        found = jl.optimal_value(model, jl.models.choice_reward(model, "cost"), 0.95)
        write_certificate(path, model, found, 'R{"cost"}max=? [ C ]', discount=0.95)
        assert width(verified(path, capsys)) < 1e-4


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("directions", ["maxmin", "maxmax", "minmax", "minmin"])
def test_intervals(seed, directions, tmp_path, capsys):
    model, path = random_model(seed, reward=True), tmp_path / "file.umb"
    p = np.asarray(model.probability)
    rough = jl.make_interval(model, 0.5 * p, np.minimum(1.5 * p, 1))
    objective = directions[:3]
    nature = "cooperative" if directions[3:] == objective else "adversarial"
    goal = np.asarray(model.states_with_label("goal"))
    found = jl.reachability_probability(rough, goal, objective=objective, nature=nature)
    write_certificate(path, rough, found, f'P{directions}=? [ F "goal" ]')
    assert width(verified(path, capsys)) < 1e-4
    found = jl.optimal_value(rough, "cost", 0.9, objective=objective, nature=nature)
    write_certificate(path, rough, found, f'R{{"cost"}}{directions}=? [ C ]', discount=0.9)
    verified(path, capsys)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("objective", ["max", "min"])
def test_bounded_steps(objective, seed, tmp_path, capsys):
    model, path = random_model(seed, reward=True), tmp_path / "file.umb"
    goal, safe = (np.asarray(model.states_with_label(x)) for x in ("goal", "safe"))
    for steps in (0, 1, 7):
        found = jl.values.bounded_reachability(model, goal, steps, stay=safe, objective=objective)
        write_certificate(path, model, found, f'P{objective}=? [ "safe" U<={steps} "goal" ]')
        assert width(verified(path, capsys)) < 1e-11
        found = jl.values.cumulative_reward(model, "cost", steps, objective=objective)
        write_certificate(path, model, found, f'R{{"cost"}}{objective}=? [ C<={steps} ]')
        assert width(verified(path, capsys)) < 1e-11
    wrong = replace(found, lower=np.asarray(found.lower) + 1e-3)
    with pytest.raises(ValueError, match="no lower bounds"):
        write_certificate(path, model, wrong, f'R{{"cost"}}{objective}=? [ C<=7 ]')


@pytest.mark.parametrize("directions", ["maxmin", "minmin"])
def test_bounded_steps_of_interval_models_and_games(directions, tmp_path, capsys):
    model, path = random_model(1), tmp_path / "file.umb"
    p, goal = np.asarray(model.probability), np.asarray(model.states_with_label("goal"))
    rough = jl.make_interval(model, 0.5 * p, np.minimum(1.5 * p, 1))
    objective = directions[:3]
    nature = "cooperative" if directions[3:] == objective else "adversarial"
    found = jl.values.bounded_reachability(rough, goal, 5, objective=objective, nature=nature)
    write_certificate(path, rough, found, f'P{directions}=? [ F<=5 "goal" ]')
    assert width(verified(path, capsys)) < 1e-11
    game = jl.make_game(model, np.random.default_rng(2).random(SIZE) < 0.5)
    found = jl.values.bounded_reachability(game, goal, 5, objective=objective)
    write_certificate(path, game, found, f'P{objective}=? [ F<=5 "goal" ]')
    text = verified(path, capsys)
    assert "<<system>>" in text and width(text) < 1e-11


FORMULAS = [
    'G F "a"',
    'F G "a"',
    '(G F "a") & (F G !"b")',
    '(G F "a") => (G F "b")',
    'X ("a" U "b")',
]


@pytest.mark.parametrize("objective", ["max", "min"])
@pytest.mark.parametrize("formula", FORMULAS)
def test_formulas(formula, objective, tmp_path, capsys):
    for seed in range(3):
        model, path = random_model(seed), tmp_path / "file.umb"
        label = np.random.default_rng(seed).random((SIZE, 2)) < 0.5
        labels = {name: np.flatnonzero(column) for name, column in zip("ab", label.T, strict=True)}
        model = jl.make_sparse(
            model.row_start,
            model.entry_start,
            model.successor,
            model.probability,
            initial=np.eye(SIZE)[0],
            label=labels,
        )
        found = jl.optimal_satisfaction(model, formula.replace("=>", "->"), objective=objective)
        write_certificate(path, model, found, f"P{objective}=? [ {formula} ]")
        text = verified(path, capsys)
        low, high = (
            float(Fraction(line.split(" is ")[1].split()[1]))
            for line in text.splitlines()
            if "claimed" in line
        )
        assert high - low < 1e-5
        assert low <= float(found.value[0]) + 1e-9
        assert float(found.value[0]) <= high + 1e-9
        if 0.01 < found.value[0] < 0.99:
            wrong = replace(found, lower=found.lower + 0.01)
            with pytest.raises(ValueError, match="contradict"):
                write_certificate(path, model, wrong, f"P{objective}=? [ {formula} ]")


@pytest.mark.parametrize("label_on", ["entry", "exit"])
def test_products_with_formulas(label_on, tmp_path, capsys):
    world = jl.gridworld("s . t\n. . g", slip=0.2, initial="s")
    product = jl.product(world, 'G F "g" & G !"t"', label_on=label_on)
    found, path = jl.optimal_satisfaction(product), tmp_path / "file.umb"
    write_certificate(path, product, found, 'Pmax=? [ (G F "g") & (G !"t") ]')
    assert width(verified(path, capsys)) < 1e-5
    found = jl.optimal_satisfaction(jl.product(world, "F g", label_on=label_on))
    write_certificate(path, product, found, 'Pmax=? [ F "g" ]')  # without an automaton
    assert width(verified(path, capsys)) < 1e-5


def test_coalitions_are_games_and_hidden_states_are_refused(tmp_path, capsys):
    model, path = random_model(1, size=5), tmp_path / "file.umb"
    world = jl.models.make_multiplayer_game(model, [0, 1, 2, 0, 1], ["a", "b", "c"])
    write_certificate(path, world, None, '<<a, c>> Pmax=? [ F "goal" ]')
    text = verified(path, capsys)
    found = jl.solve_property(world, '<<a, c>> Pmax=? [ F "goal" ]')
    assert width(text) < 1e-5 and "<<system>>" in text
    low = float(Fraction(text.split(" is ")[1].split()[1]))
    assert abs(low - found.value[0]) < 1e-5
    hidden = jl.models.make_pomdp(
        jl.make_sparse(None, [0, 1, 2], [1, 1], [1.0, 1.0], label={"goal": [1]}), [0, 1]
    )
    for refused, question in (
        (world, 'Pmax=? [ F "goal" ]'),
        (hidden, 'Pmax=? [ F "goal" ]'),
        (jl.make_game(model, [True] * 5), '<<environment>> Pmax=? [ F "goal" ]'),
    ):
        with pytest.raises(ValueError, match=r"certificates .*are written for"):
            write_certificate(path, refused, None, question)


def with_labels(seed):
    """A random model with two labels."""
    model, label = random_model(seed, size=7), np.random.default_rng(seed).random((7, 2)) < 0.5
    return replace(model, label=label, propositions=("a", "b"))


@pytest.mark.parametrize(
    ("formula", "directions"), [*zip(FORMULAS, ("maxmax", "minmin", "maxmin"), strict=False)]
)
def test_formulas_of_interval_models_and_games(formula, directions, tmp_path, capsys):
    model, path, objective = with_labels(2), tmp_path / "file.umb", directions[:3]
    p, plain = np.asarray(model.probability), formula.replace('"', "")
    rough = jl.make_interval(model, 0.5 * p, np.minimum(1.5 * p, 1))
    nature = "cooperative" if directions[3:] == objective else "adversarial"
    found = jl.optimal_satisfaction(rough, plain, objective=objective, nature=nature)
    write_certificate(path, rough, found, f"P{directions}=? [ {formula} ]")
    assert width(verified(path, capsys)) < 1e-5
    game = jl.make_game(model, np.random.default_rng(2).random(7) < 0.5)
    found = jl.optimal_satisfaction(game, plain, objective=objective)
    write_certificate(path, game, found, f"P{objective}=? [ {formula} ]")
    text = verified(path, capsys)
    assert "<<system>>" in text and width(text) < 1e-5


def random_policy(model, shape, seed=0):
    """Weights of all actions of each state, in a shape."""
    number = np.asarray(model.action_number)
    weights = np.zeros((*shape, number.max() + 1))
    some = np.random.default_rng(seed).random((model.num_rows, *shape[1:])) + 0.1
    weights[(model.host.state, ..., number)] = some
    return weights / weights.sum(-1, keepdims=True)


def test_policies_of_states(tmp_path, capsys):
    model, path = random_model(0, reward=True), tmp_path / "file.umb"
    goal, policy = np.asarray(model.states_with_label("goal")), random_policy(model, (SIZE,))
    game = jl.make_game(model, np.random.default_rng(2).random(SIZE) < 0.5)
    for world, one in ((model, policy), (model, policy.argmax(-1)), (game, policy)):
        found = jl.reachability_probability(world, goal, policy=one)
        write_certificate(path, world, found, 'Pmax=? [ F "goal" ]', policy=one)
        text = verified(path, capsys)
        assert "// of a given policy" in text and width(text) < 1e-5
        for question in ('Pmax=? [ F<=5 "goal" ]', 'R{"cost"}max=? [ F "goal" ]'):
            write_certificate(path, world, None, question, policy=one)
            verified(path, capsys)
        write_certificate(path, world, None, 'R{"cost"}max=? [ C ]', policy=one, discount=0.9)
        assert width(verified(path, capsys)) < 1e-5
    with pytest.raises(ValueError, match="contradict"):
        write_certificate(
            path,
            game,
            replace(found, lower=found.lower + 0.5),
            'Pmax=? [ F "goal" ]',
            policy=policy,
        )


@pytest.mark.parametrize("label_on", ["entry", "exit"])
def test_policies_with_memory(label_on, tmp_path, capsys):
    model, path = with_labels(1), tmp_path / "file.umb"
    formula, plain = FORMULAS[2], FORMULAS[2].replace('"', "")
    product = jl.product(model, plain, label_on=label_on)
    policy = random_policy(model, product.state_shape)
    found = jl.satisfaction_probability(product, policy)
    write_certificate(path, product, found, f"Pmax=? [ {formula} ]", policy=policy)
    assert width(verified(path, capsys)) < 1e-5
    best = jl.optimal_satisfaction(model, plain, label_on=label_on)
    policy = jl.project_policy(model, best)
    write_certificate(path, model, best, f"Pmax=? [ {formula} ]", policy=policy)
    assert width(verified(path, capsys)) < 1e-5
    rough = jl.make_interval(model, model.probability, model.probability)
    with pytest.raises(ValueError, match="policy is randomised"):
        policy = random_policy(model, (7,))
        write_certificate(path, rough, None, f"Pmaxmin=? [ {formula} ]", policy=policy)


@pytest.mark.parametrize("objective", ["max", "min"])
def test_guarantees_from_counts(objective, tmp_path, capsys):
    model, path = with_labels(2), tmp_path / "file.umb"
    counts = np.rint(500 * np.asarray(model.probability)).astype(int)
    nature = "min" if objective == "max" else "max"
    question = f'P{objective}{nature}=? [ G F "a" ]'
    for method in ("anytime", "clopper-pearson", "hoeffding"):
        found = jl.learn_guarantee(
            model, counts, "G F a", 0.95, graph="given", method=method, objective=objective
        )
        write_certificate(path, found.model, found, question)
        text = verified(path, capsys)
        assert "with confidence 0.95" in text and text.count("claimed") == 1
        bound = float(Fraction(text.split(" is ")[1].split()[1]))
        assert abs(bound - found.bound) < 1e-5
    found = jl.learn_guarantee(model, counts, "G F a", 0.95, graph="given", method="weissman")
    with pytest.raises(ValueError, match="smallest intervals"):
        write_certificate(path, found.model, found, question)


def test_padded_models_and_chains(tmp_path, capsys):
    path = tmp_path / "file.umb"
    dense = jl.from_dense(
        [[[0.5, 0.25, 0.25], [0, 0.5, 0.5]], [[0, 1.0, 0]] * 2, [[0, 0, 1.0]] * 2],
        label={"goal": [1]},
        initial=[1.0, 0.0, 0.0],
    )
    goal = np.asarray(dense.label)[:, 0] > 0
    for objective in ("max", "min"):
        found = jl.reachability_probability(dense, goal, objective=objective)
        write_certificate(path, dense, found, f'P{objective}=? [ F "goal" ]')
        assert width(verified(path, capsys)) < 1e-6
    cost = np.array([[1.0, 2.0], [0.0, 0.0], [1.0, 1.0]])
    found = jl.optimal_value(dense, cost, 0.9)
    write_certificate(path, dense, found, 'R{"cost"}max=? [ C ]', reward=cost, discount=0.9)
    verified(path, capsys)
    chain = jl.make_sparse(
        None, [0, 2, 3, 4], [1, 2, 1, 2], [0.1, 0.9, 1, 1], label={"goal": [1]}, initial=[1, 0, 0]
    )
    found = jl.reachability_probability(chain, np.array([False, True, False]))
    write_certificate(path, chain, found, 'P=? [ F "goal" ]')
    assert width(verified(path, capsys)) < 1e-6


def test_a_slow_random_walk(tmp_path, capsys):
    """Ten thousand expected steps: bounds are widened by the expected number of steps."""
    size = 100
    successor = [0, *np.ravel([[s - 1, s + 1] for s in range(1, size - 1)]).tolist(), size - 1]
    walk = jl.make_sparse(
        None,
        [0, *range(1, 2 * size - 2, 2), 2 * size - 2],
        successor,
        [1.0, *[0.5] * (2 * size - 4), 1.0],
        label={"goal": [size - 1]},
        initial=np.eye(size)[size // 2],
    )
    goal = np.asarray(walk.states_with_label("goal"))
    found = jl.reachability_probability(walk, goal)
    write_certificate(tmp_path / "walk.umb", walk, found, 'Pmax=? [ F "goal" ]')
    assert width(verified(tmp_path / "walk.umb", capsys)) < 1e-5


def test_games(tmp_path, capsys):
    rng, path = np.random.default_rng(1), tmp_path / "game.umb"
    model = random_model(3, reward=True)
    game = jl.make_game(model, rng.random(SIZE) < 0.5)
    reward = np.asarray(jl.models.choice_reward(model, "cost"))
    found = jl.minimax_value(game, reward, 0.9)
    write_certificate(path, game, found, 'R{"cost"}max=? [ C ]', reward=reward, discount=0.9)
    assert "<<system>>" in verified(path, capsys)


def test_false_bounds_are_not_written(tmp_path):
    model, path = random_model(2), tmp_path / "file.umb"
    found = jl.reachability_probability(model, np.asarray(model.states_with_label("goal")))
    assert 0.05 < found.value[0] < 0.95
    for side, shift in (("lower", 0.01), ("upper", -0.01)):
        bound = np.clip(np.asarray(getattr(found, side)) + shift, 0, 1)
        wrong = replace(found, **{side: bound, "value": np.asarray(found.value) + np.inf})
        with pytest.raises(ValueError, match=f"no {side} bounds"):
            write_certificate(path, model, wrong, 'Pmax=? [ F "goal" ]')
        assert not path.exists()


@pytest.mark.parametrize(
    ("question", "why"),
    [
        ('Pmax=? [ F[1,3] "goal" ]', "certificates are written for"),
        ('Pmax=? [ G<=3 "goal" ]', "certificates are written for"),
        ('LRAmax=? [ "goal" ]', "certificates are written for"),
        ('P=? [ F "goal" ]', "give the objective"),
        ('Pmax>=0.5 [ F "goal" ]', "give the objective"),
        ('Pmax=? [ F "nothing" ]', "nothing"),
    ],
)
def test_other_questions_are_refused_by_name(question, why, tmp_path):
    model = random_model(0)
    found = jl.reachability_probability(model, np.asarray(model.states_with_label("goal")))
    with pytest.raises(ValueError, match=why):
        write_certificate(tmp_path / "file.umb", model, found, question)


def storm_conditions(text, model, direction):
    """The conditions of the format, by its own text: `u >= B u`, `l <= B l`, and the ranks."""
    lines = text.splitlines()
    kind, objective = lines[1].split()
    size, sets = int(lines[2]), [{*map(int, x.split())} for x in lines[3 : 4 + (kind == "until")]]
    target, stay = sets[0], sets[-1] if kind == "until" else {*range(size)}
    table = [x.split() for x in lines[3 + len(sets) :]]
    low, high = ([Fraction(x[i]) for x in table] for i in (1, 3))
    rank = [float(x[2]) for x in table]
    assert objective == direction and [int(x[0]) for x in table] == [*range(size)]
    host, choose = model.host, {"max": max, "min": min}[direction]
    for s in range(size):
        if s in target:
            assert low[s] <= 1 <= high[s]
            continue
        if s not in stay:
            assert low[s] <= 0 <= high[s] and rank[s] == np.inf
            continue
        assert low[s] <= 0 or rank[s] < np.inf
        options = []
        for r in range(host.row_start[s], host.row_start[s + 1]):
            entries = range(host.entry_start[r], host.entry_start[r + 1])
            pairs = [(Fraction(float(host.probability[e])), host.successor[e]) for e in entries]
            pairs = [(p / sum(q for q, _ in pairs), t) for p, t in pairs]
            means = [sum(p * x[t] for p, t in pairs) for x in (low, high)]
            options.append((*means, min(rank[t] for _, t in pairs)))
        best = choose(x[0] for x in options)
        assert best >= low[s] and choose(x[1] for x in options) <= high[s]
        taken = [x[2] for x in options if direction == "min" or x[0] == best]
        assert (max if direction == "min" else min)(taken) + 1 <= rank[s]
    return low[0], high[0]


@pytest.mark.parametrize("objective", ["max", "min"])
@pytest.mark.parametrize("seed", range(4))
def test_certificates_in_storms_format(objective, seed, tmp_path):
    model, path = random_model(seed), tmp_path / "file.txt"
    goal, safe = (np.asarray(model.states_with_label(x)) for x in ("goal", "safe"))
    for stay, formula in ((None, 'F "goal"'), (safe, '"safe" U "goal"')):
        found = jl.reachability_probability(model, goal, stay=stay, objective=objective)
        drn = tmp_path / "model.drn"
        write_storm_certificate(path, model, found, f"P{objective}=? [ {formula} ]", drn=drn)
        read = read_drn(drn)
        assert "@value_type: rational" in drn.read_text() and " : 1\n" in drn.read_text()
        np.testing.assert_array_max_ulp(read.probability, model.probability)
        low, high = storm_conditions(path.read_text(), model, objective)
        assert low - 1e-5 <= found.value[0] <= high + 1e-5 and high - low < 1e-5
    for question in ('Pmax=? [ G F "goal" ]', 'Pmax=? [ F<=3 "goal" ]'):
        with pytest.raises(ValueError, match="Storm has certificates of P of F and U"):
            write_storm_certificate(path, model, None, question)
