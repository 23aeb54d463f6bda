"""Properties of interval models: values that others published, and laws by brute force."""

from itertools import islice, product

import numpy as np
import pytest

from jaxltl.core.models.interval import interval_rows
from jaxltl.core.models.sparse import Rewards, make_sparse
from jaxltl.core.types import Status
from jaxltl.core.values.properties.solve_property import solve_property
from jaxltl.io.drn.drn import read_drn
from jaxltl.io.storm import to_stormpy
from tests.core.sparse.bounded.test_uncertain_steps import random_interval, vertices

BOTH = ("maxmin", "maxmax", "minmin", "minmax")


def opposite(directions):
    """Both directions turned round: "minmax" of "maxmin"."""
    return "".join({"max": "min", "min": "max"}[directions[i : i + 3]] for i in (0, 3))


def drn(tmp_path, rows, *, kind="MDP", rewards="", labels=None):
    """A model from what each state's choices lead to, in the DRN format."""
    lines = [
        f"@type: {kind}",
        "@value_type: double-interval",
        "@reward_models",
        rewards,
        "@nr_states",
        str(len(rows)),
        "@model",
    ]
    for s, choices in enumerate(rows):
        reward = " [[1, 1]]" if rewards else ""
        lines.append(f"state {s}{reward} {'init ' if s == 0 else ''}{(labels or {}).get(s, '')}")
        for i, choice in enumerate(choices):
            lines.append(f"\taction {i}{' [0]' if rewards else ''}")
            lines += [f"\t\t{t} : {p}" for t, p in choice.items()]
    path = tmp_path / "model.drn"
    path.write_text("\n".join(lines) + "\n")
    return read_drn(path)


def robot(tmp_path, p="[0.45, 0.55]", south="[0.1, 0.1]", rest="[0.8, 0.8]", hazard="[0.1, 0.1]"):
    """The robot of PRISM's lectures; `p` both ways out of the hazard."""
    return drn(
        tmp_path,
        [
            [{0: 0.4, 1: 0.6}, {1: hazard, 2: rest, 3: south}],
            [{1: "[0.1, 0.2]", 4: "[0.8, 0.9]"}, {3: p, 4: p}],
            [{2: 1}],
            [{5: 1}, {2: 0.6, 3: 0.4}],
            [{4: 1}],
            [{4: 0.9, 5: 0.1}, {3: 1}],
        ],
        rewards="time",
        labels={1: "hazard", 2: "goal2", 4: "goal2", 5: "goal1"},
    )


def assert_enclosed(model, prop, value, *, width=1e-6, near=1e-9):
    found = solve_property(model, prop, tolerance=width)
    lower, upper = float(found.lower[0]), float(found.upper[0])
    assert lower - near <= value <= upper + near, (prop, value, lower, upper)
    assert upper - lower <= width * max(1, abs(value)) and found.status == Status.CONVERGED, prop
    assert lower <= found.value[0] <= upper


@pytest.mark.parametrize(("delta", "p", "q"), [(0.05, 0.45, 0.55), (0.25, 0.25, 0.75)])
def test_the_robot_of_prism(delta, p, q, tmp_path):
    model = robot(tmp_path, f"[{p}, {q}]")
    assert_enclosed(model, 'Pmaxmin=? [ F "goal1" ]', max(p, 0.1 + 0.1 * p))
    assert_enclosed(model, 'Pmaxmax=? [ F "goal1" ]', q)
    first = 'F "goal1" | "goal2"'
    assert_enclosed(model, f'R{{"time"}}minmin=? [ {first} ]', min(109 / 90, 6 / 5 + p / 10))
    assert_enclosed(model, f'R{{"time"}}minmax=? [ {first} ]', 98 / 80)
    for aim in ("maxmin", "minmax"):
        steps = solve_property(model, f'P{aim}=? [ F<=4 "goal1" ]').value[0]
        assert_enclosed(model, f'P{aim}=? [ F{{"time"}}<=4 "goal1" ]', steps)
    if delta == 0.05:
        assert_enclosed(model, 'Rminmax=? [ F "goal2" ]', 31 / 24)
        assert_enclosed(model, 'Tminmax=? [ F "goal2" ]', 31 / 24)


def test_formulas_of_the_robot(tmp_path):
    safely = '(G !"hazard") & (G F "goal1")'
    model = robot(tmp_path, "0.5", "[0.05, 0.15]", "[0.75, 0.85]", "[0.05, 0.15]")
    for directions, value in (("maxmin", 0.05), ("maxmax", 0.15)):
        assert_enclosed(model, f"P{directions}=? [ {safely} ]", value)
        assert_enclosed(model, f'P{directions}=? [ G F "goal1" ]', 0.5)
    assert_enclosed(robot(tmp_path, "0.5"), f"Pmaxmin=? [ {safely} ]", 0.1)


SMALL = {
    "one": ([[{1: "[0.4, 0.5]", 2: "[0.5, 0.6]"}], [{1: 1}], [{2: 1}]], (0.4, 0.5, 0.5, 0.4)),
    "two": (
        [
            [{1: "[0.4, 0.5]", 2: "[0.5, 0.6]"}, {1: "[0.3, 0.6]", 2: "[0.4, 0.7]"}],
            [{1: 1}],
            [{2: 1}],
        ],
        (0.4, 0.6, 0.5, 0.3),
    ),
    "loop": (
        [[{1: 1}, {0: "[0.5, 0.51]", 1: 0.21, 2: "[0.28, 0.29]"}], [{1: 1}], [{2: 1}]],
        (1, 1, 3 / 7, 0.42),
    ),
    "open": ([[{1: "[0.3, 0.4]", 2: "[0, 1]"}], [{1: 1}], [{2: 1}]], (0.3, 0.4, 0.4, 0.3)),
}


@pytest.mark.parametrize("name", SMALL)
def test_small_models_with_published_values(name, tmp_path):
    rows, (robust_max, helped_max, robust_min, helped_min) = SMALL[name]
    model = drn(tmp_path, rows, labels={1: "goal"})
    for directions, value in (
        ("maxmin", robust_max),
        ("maxmax", helped_max),
        ("minmax", robust_min),
        ("minmin", helped_min),
    ):
        assert_enclosed(model, f'P{directions}=? [ F "goal" ]', value)
        assert_enclosed(model, f'P{directions}=? [ true U "goal" ]', value)
        assert_enclosed(model, f'P{opposite(directions)}=? [ G !"goal" ]', 1 - value)


def test_the_die_of_knuth_and_yao_with_a_coin_of_thirds(tmp_path):
    coin = "[1/3, 2/3]"
    tree = {0: (1, 2), 1: (3, 4), 2: (5, 6), 3: (1, 7), 4: (8, 9), 5: (10, 11), 6: (12, 2)}
    rows = [[dict.fromkeys(tree[s], coin)] if s in tree else [{s: 1}] for s in range(13)]
    model = drn(tmp_path, rows, kind="DTMC", labels={7: "one", 8: "two"})
    assert model.is_chain
    assert_enclosed(model, 'Pmin=? [ F "one" ]', 9 / 189)
    assert_enclosed(model, 'Pmax=? [ F "one" ]', 72 / 189)
    assert_enclosed(model, 'Pmaxmin=? [ F "one" ]', 9 / 189)  # nobody else chooses
    assert solve_property(model, 'P>=0.04 [ F "one" ]').holds == [True]  # whatever nature picks
    assert solve_property(model, 'P>=0.05 [ F "one" ]').holds == [False]
    assert solve_property(model, 'P<=0.39 [ F "one" ]').holds == [True]
    assert solve_property(model, 'Pmax>=0.38 [ F "one" ]').holds == [True]
    for text in ('P=? [ F "one" ]', 'P=? [ G F "one" ]'):
        with pytest.raises(ValueError, match=r"what nature picks .* ask for Pmin=\? or Pmax=\?"):
            solve_property(model, text)


def consensus(lower, upper, bound=2):
    """The shared coin of Aspnes and Herlihy; the first of two processes has an uncertain coin."""
    left, right, top = 2, 4 * (bound + 1) - 2, 4 * (bound + 1)
    number, queue, choices = {}, [], []

    def state(s):
        if s not in number:
            number[s] = len(number)
            queue.append(s)
        return number[s]

    state((2 * (bound + 1), (0, 0), (0, 0)))
    for s in queue:
        counter, place, coin = s
        found = []
        for i in range(2):

            def moved(pc, side, count=counter, i=i, place=place, coin=coin):
                def put(x, v):
                    return (v, x[1]) if i == 0 else (x[0], v)

                return state((count, put(place, pc), put(coin, side)))

            if place[i] == 0:
                ends = (0.5, 0.5) if i else (lower, upper)
                found.append({moved(1, 0): ends, moved(1, 1): ends})
            elif place[i] == 1:
                step = counter + (1 if coin[i] else -1)
                if 0 <= step <= top:
                    found.append({moved(2, 0, step): (1, 1)})
            elif place[i] == 2:
                if counter <= left:
                    found.append({moved(3, 0): (1, 1)})
                elif counter >= right:
                    found.append({moved(3, 1): (1, 1)})
                else:
                    found.append({moved(0, coin[i]): (1, 1)})
        if place == (3, 3):
            found.append({number[s]: (1, 1)})
        choices.append(found)
    rows = np.concatenate([[0], np.cumsum([len(x) for x in choices])])
    flat = [row for x in choices for row in x]
    entry = np.concatenate([[0], np.cumsum([len(x) for x in flat])])
    ends = [e for row in flat for e in row.values()]
    states = list(number)
    initial = np.eye(1, len(states))[0]
    finished = [i for i, s in enumerate(states) if s[1] == (3, 3)]
    return interval_rows(
        rows,
        entry,
        [t for row in flat for t in row],
        [a for a, _ in ends],
        [b for _, b in ends],
        initial=initial,
        label={
            "finished": finished,
            "zeros": [i for i, s in enumerate(states) if s[2] == (0, 0)],
            "ones": [i for i, s in enumerate(states) if s[2] == (1, 1)],
            "agree": [i for i, s in enumerate(states) if s[2][0] == s[2][1]],
        },
        rewards={"steps": Rewards(state=np.ones(len(states)))},
    )


def test_the_consensus_protocol_of_prism():
    model = consensus(0.4, 0.6)
    assert (model.num_states, model.num_rows, model.num_transitions) == (272, 400, 492)
    near = 6e-7  # of values that are published with six digits
    assert_enclosed(model, 'Pminmin=? [ F "finished" & "zeros" ]', 0.114195, near=near)
    assert_enclosed(model, 'Pminmax=? [ F "finished" & "ones" ]', 0.418800, near=near)
    assert_enclosed(model, 'Pmaxmin=? [ F "finished" & !"agree" ]', 0.101786, near=near)
    assert_enclosed(model, 'Pmaxmax=? [ F "finished" & !"agree" ]', 0.3249961130231, near=1e-12)
    for directions, steps in (
        ("minmin", 280 / 9),
        ("minmax", 48),
        ("maxmin", 75),
        ("maxmax", 162.375),
    ):
        assert_enclosed(model, f'R{{"steps"}}{directions}=? [ F "finished" ]', steps)


# --- laws -------------------------------------------------------------------------------------


def labelled(rng, **options):
    model = random_interval(rng, 4, **options)
    label = rng.random((4, 2)) < 0.5
    nominal = model.nominal
    return interval_rows(
        nominal.row_start,
        nominal.entry_start,
        nominal.successor,
        model.lower,
        model.upper,
        initial=np.eye(1, 4)[0],
        label=label,
        propositions=["a", "b"],
    )


def members(model):
    """Models in which nature keeps to one vertex of each row; policies are left open."""
    host = model.host.mdp
    points = [
        vertices(model.lower[a:b], model.upper[a:b])
        for a, b in zip(host.entry_start[:-1], host.entry_start[1:], strict=True)
    ]
    for chosen in product(*points):
        p = np.array([x for row in chosen for x in row])
        yield make_sparse(
            host.row_start,
            host.entry_start,
            host.successor,
            p,
            initial=np.asarray(model.initial),
            label=np.asarray(model.label),
            propositions=model.propositions,
        )


# Neither side needs a memory for these.
PLAIN = (
    'F "a"',
    '"a" U "b"',
    'G "a"',
    '"a" W "b"',
    '"a" R "b"',
    'X "a"',
    'G F "a"',
    'F G "b"',
    '(G F "a") => (G F "b")',
    '"b" | X "a"',
)


@pytest.mark.few(1)
@pytest.mark.parametrize(
    "seed", [*range(3), *(pytest.param(x, marks=pytest.mark.exhaustive) for x in range(3, 60))]
)
def test_any_formula_beside_all_that_nature_may_keep_to(seed):
    rng = np.random.default_rng(seed)
    worlds = []
    while not 2 < len(worlds) <= 16:
        model = labelled(rng)
        worlds = list(islice(members(model), 17))
    for text in (*PLAIN, 'F ("a" & X "b")'):
        each = {
            aim: [float(solve_property(w, f"P{aim}=? [ {text} ]").value[0]) for w in worlds]
            for aim in ("max", "min")
        }
        for directions in BOTH:
            found = solve_property(model, f"P{directions}=? [ {text} ]")
            assert found.status == Status.CONVERGED
            assert found.upper[0] - found.lower[0] <= 1e-6
            policy, nature = directions[:3], directions[3:]
            best = (max if nature == "max" else min)(each[policy])
            # With a memory nature has at least what it has without one.
            above = text in PLAIN or nature == "max"
            below = text in PLAIN or nature == "min"
            assert not above or found.upper[0] >= best - 1e-6, (text, directions)
            assert not below or found.lower[0] <= best + 1e-6, (text, directions)


@pytest.mark.parametrize("seed", range(4))
def test_steps_lead_to_what_is_reached_without_bound(seed):
    model = labelled(np.random.default_rng(seed))
    for directions in BOTH:
        free = solve_property(model, f'P{directions}=? [ "a" U "b" ]')
        before = 0.0
        for steps in (0, 1, 2, 10, 400):
            found = solve_property(model, f'P{directions}=? [ "a" U<={steps} "b" ]')
            assert found.lower[0] >= before - 1e-12 and found.lower[0] <= free.upper[0]
            before = float(found.lower[0])
            if steps > 10:
                continue
            other = solve_property(model, f'P{directions}=? [ !("a" U<={steps} "b") ]')
            third = solve_property(model, f'P{opposite(directions)}=? [ "a" U<={steps} "b" ]')
            assert abs(other.value[0] - (1 - third.value[0])) <= 1e-9
        assert abs(before - free.value[0]) <= 1e-6
        assert solve_property(model, f'P{directions}=? [ F[1,2] "b" ]').status == Status.CONVERGED


def test_rewards_of_so_many_steps(tmp_path):
    model = robot(tmp_path)
    first = 'F "goal1" | "goal2"'
    for directions in BOTH:
        assert_enclosed(model, f'R{{"time"}}{directions}=? [ C<=7 ]', 7)  # each step takes one
        assert_enclosed(model, f'R{{"time"}}{directions}=? [ I=7 ]', 1)
        once = solve_property(model, f'P{directions}=? [ F<=1 "goal2" ]')
        assert once.lower[0] <= (0.8 if directions[:3] == "max" else 0) <= once.upper[0]
    assert solve_property(model, f"Rminmax<=1.3 [ {first} ]").holds == [True]
    assert solve_property(model, "Rmaxmin<=7 [ C<=7 ]").holds in ([True], [None])


def test_what_has_no_intervals_takes_one_direction():
    coin = make_sparse(
        None, [0, 2, 3, 4], [1, 2, 1, 2], [0.5, 0.5, 1, 1], initial=[1, 0, 0], label={"a": [1]}
    )
    with pytest.raises(ValueError, match=r"no intervals from which nature .* ask for Pmax=\?"):
        solve_property(coin, 'Pmaxmin=? [ F "a" ]')


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('P=? [ F "goal1" ]', r"ask for Pmaxmin=\?, Pmaxmax=\?, Pminmin=\? or Pminmax=\?"),
        ('Pmax=? [ F "goal1" ]', r"ask for Pmaxmin=\? or Pmaxmax=\?"),
        ('Pmin>0.5 [ F "goal1" ]', r"ask for Pminmin=\? or Pminmax=\?"),
        ('R{"time"}min=? [ F "goal1" ]', r'ask for R\{"time"\}minmin=\? or R\{"time"\}minmax=\?'),
        (
            'Rminmax=? [ F0 "goal1" ]',
            r"rewards that count if a state is reached \(F0\) are not solved for where probabilities are int",
        ),
        ('Pmaxmin=? [ F "nowhere" ]', r"'nowhere'"),
        ('R{"fuel"}minmax=? [ F "goal1" ]', r"no reward 'fuel'"),
    ],
)
def test_what_is_not_offered_is_named(text, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        solve_property(robot(tmp_path), text)


def test_thresholds_are_for_all_strategies_and_all_of_nature(tmp_path):
    model = robot(tmp_path)
    assert solve_property(model, 'P<=0.56 [ F "goal1" ]').holds == [True]
    assert solve_property(model, 'P<=0.54 [ F "goal1" ]').holds == [False]
    assert solve_property(model, 'Pmaxmin>0.44 [ F "goal1" ]').holds == [True]
    assert solve_property(model, 'Pmaxmin>0.46 [ F "goal1" ]').holds == [False]
    assert solve_property(model, 'P>=0 [ F "goal1" ]').holds == [True]
    assert solve_property(model, 'P>0 [ F "goal1" ]').holds == [False]
    assert solve_property(model, 'Rminmax<1.23 [ F "goal1" | "goal2" ]').holds == [True]


def test_storm_finds_the_same():
    storm = pytest.importorskip("stormpy")
    rng = np.random.default_rng(11)
    for _ in range(6):
        model = labelled(rng)
        lower = np.maximum(model.lower, np.minimum(model.upper, 1 / 128))  # Storm wants a graph
        model = interval_rows(
            model.nominal.row_start,
            model.nominal.entry_start,
            model.nominal.successor,
            lower,
            model.upper,
            initial=model.initial,
            label=model.label,
            propositions=model.propositions,
        )
        there = to_stormpy(model)
        for text, directions in product(('F "a"', '"b" U "a"', 'F<=4 "a"', 'X "b"'), BOTH):
            (prop,) = storm.parse_properties(f"P{directions[:3]}=? [ {text} ]")
            mode = getattr(storm.UncertaintyResolutionMode, f"{directions[3:]}imize".upper())
            value = float(
                storm.model_checking(
                    there,
                    prop,
                    only_initial_states=True,
                    uncertainty_resolution_mode=mode,
                ).get_value(0)
            )
            assert_enclosed(model, f"P{directions}=? [ {text} ]", value, near=1e-4)
