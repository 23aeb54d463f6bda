"""Pictures: they are drawn whole, labels stand free, and misfits are named."""

import io
import re
import stat
import xml.etree.ElementTree as ElementTree
from collections import Counter

import numpy as np
import pytest
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_hex, to_rgb
from matplotlib.patches import Circle, FancyArrowPatch, Rectangle

from jaxltl import plot
from jaxltl.core.automata.automaton import Automaton, complement, make_automaton
from jaxltl.core.automata.translate import to_automaton
from jaxltl.core.models.trajectories import Trajectories, make_trajectories
from jaxltl.envs.temporal_gridworld import random_world, training_world
from jaxltl.plot import layout as drawing
from jaxltl.plot.automata import edge_texts
from jaxltl.plot.board import WALL
from jaxltl.plot.maps import MARKED, NEVER, TINTS
from jaxltl.plot.style import ACCENT, INK, MUTED, PAPER

MAP = "b . r\n. # y"
GOOD = [
    "F a",
    "true",
    "false",
    "G (a -> X b)",
    "F a & F b",
    'F "a $x$ & b" & !c U d',
    "(!r & !y) -> ((!r U y) & (!y U g1) & (!y U g2) & F y)",
    "G F a & G F b",
    "F G a",
    "G (r -> F g)",
    "G F a -> G F b",
    "F a & G F b",
    "a U (b U G c)",
    "G (a -> F b) & G (c -> F d)",
]


def arranged(table):
    """The drawing that `plot.automaton` makes without graphviz."""
    doomed = drawing.rejecting(table)
    texts = edge_texts(table, doomed)
    return drawing.arrange(table.delta, int(table.initial), doomed, texts)


def colors(figure):
    """How many curves there are of each colour."""
    drawn = [x for x in figure.axes[0].patches if isinstance(x, FancyArrowPatch)]
    return Counter(to_hex(x.get_edgecolor()) for x in drawn)


def marks(figure):
    """The fill of each circle that is no state, from top to bottom and left to right."""
    found = [x for x in figure.axes[0].patches if isinstance(x, Circle) and x.get_radius() < 0.1]
    return [
        to_hex(x.get_facecolor()) for x in sorted(found, key=lambda x: (-x.center[1], x.center[0]))
    ]


@pytest.mark.few(7)
@pytest.mark.parametrize("formula", GOOD)
def test_an_automaton_is_drawn(formula):
    table = to_automaton(formula)
    figure = plot.automaton(table, layout="matplotlib")
    axes = figure.axes[0]
    shown = {text.get_text() for text in axes.texts}
    assert {str(q) for q in range(len(table.delta))} <= shown
    ElementTree.fromstring(plot.to_bytes(figure))


@pytest.mark.parametrize("formula", GOOD)
def test_labels_stand_clear_of_states_and_each_other(formula):
    table = to_automaton(formula)
    graph = arranged(table)
    boxes = [drawing.Rectangle(x.center, drawing.label_size(x.rows) / 2) for x in graph.labels]
    if len(table.delta) <= 5:  # in a dense graph a label may touch its neighbour
        for i, box in enumerate(boxes):
            assert not box.overlapped(np.array(boxes[:i]).reshape(-1, 2, 2)).any()
    assert sum(box.num_within(graph.position, drawing.RADIUS) for box in boxes) == 0
    for box in boxes:
        assert (box.center - box.half >= 0).all()
        assert (box.center + box.half <= graph.size).all()


def test_states_do_not_overlap():
    table = to_automaton("F a & F b & F c")
    graph = arranged(table)
    gaps = np.hypot(*(graph.position[:, None] - graph.position[None]).transpose(2, 0, 1))
    assert gaps[~np.eye(len(gaps), dtype=bool)].min() > 2 * drawing.RADIUS


def test_the_longest_guard_says_else():
    table = to_automaton("!red U (goal & !red)")
    texts = edge_texts(table, drawing.rejecting(table))
    assert (("", "else"),) in texts.values() and texts[0, 1, 0] != texts[0, 0, 0]


def test_accepting_arrows_are_coloured_and_have_a_dot():
    figure = plot.automaton(to_automaton("F a & G F b"), layout="matplotlib")
    # One arrow comes from nowhere; 0 -> 0, 0 -> 1 and 1 -> 1 do not accept, the other 1 -> 1 does.
    assert colors(figure) == {INK: 4, ACCENT: 1}
    assert marks(figure) == [ACCENT]
    notes = " ".join(text.get_text() for text in figure.texts)
    assert "●: accepting" in notes
    finite = plot.automaton(to_automaton("F a"), layout="matplotlib")
    assert marks(finite) == [] and colors(finite) == {INK: 3}


def test_priorities_stand_before_their_guards():
    table = to_automaton("G F a -> G F b")
    texts = edge_texts(table, drawing.rejecting(table))
    assert texts == {(0, 0, 0): (("0", "b"), ("1", "a ∧ ¬b"), ("2", "¬a ∧ ¬b"))}
    figure = plot.automaton(table, layout="matplotlib")
    shown = {text.get_text(): text.get_position()[1] for text in figure.axes[0].texts}
    assert shown["2"] == shown["¬a ∧ ¬b"] < shown["1"] == shown["a ∧ ¬b"]
    assert marks(figure) == [ACCENT, PAPER, ACCENT]


def test_no_mark_counts_on_the_way_to_a_rejecting_state():
    # Reading b, or a in the last state, has an even number and leads nowhere good.
    table = make_automaton(
        [[0, 1, 1], [1, 1, 1]],
        0,
        [[True, False], [False, True], [False, False]],
        ["a", "b"],
        priority=[[2, 0, 1], [1, 3, 3]],
    )
    texts = edge_texts(table, drawing.rejecting(table))
    assert texts == {(0, 0, 0): (("2", "a"),), (0, 1, 0): (("", "¬a"),), (1, 1, 0): (("", "⊤"),)}
    assert len(arranged(table).edges) == 2
    assert colors(plot.automaton(table, layout="matplotlib")) == {INK: 2, MUTED: 1}


def test_rejecting_states_of_every_acceptance():
    for formula, acceptance in (("!r U g", "dfa"), ("!r U g", "buchi"), ("!r U g", "parity")):
        table = to_automaton(formula, acceptance=acceptance)
        assert drawing.rejecting(table).tolist() == [False, False, True]
        assert drawing.rejecting(complement(table)).tolist() == [False, True, False]


def test_the_notes_are_not_cut_off():
    for formula in ("G F a", "F G a", "!red U (goal & !red)", 'F "a place with a long name"'):
        figure = plot.automaton(to_automaton(formula), layout="matplotlib")
        figure.draw_without_rendering()
        for text in figure.texts:
            assert text.get_window_extent().x1 <= figure.bbox.x1, text.get_text()


FAKE_DOT = """#!/bin/sh
cat > "$0.read"
echo 'graph 1 9 9'
echo 'node 1 5.5 2.5 0.48 0.48 1 solid circle black lightgrey'
echo 'node 0 1.5 1.5 0.48 0.48 0 solid circle black lightgrey'
echo 'edge 0 1 4 1 1 2 2 3 3 4 4 m 2 2 solid black'
echo stop
"""


def test_graphviz_may_place_the_states(monkeypatch, tmp_path):
    program = tmp_path / "dot"
    program.write_text(FAKE_DOT)
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setattr("shutil.which", lambda name: str(program))
    table = to_automaton('G F "say \\"a\\"" & G F b')

    def centers(layout):
        circles = [
            x
            for x in plot.automaton(table, layout=layout).axes[0].patches
            if isinstance(x, Circle) and x.get_radius() == drawing.RADIUS
        ]
        return np.array([x.center for x in circles])

    np.testing.assert_allclose(np.diff(centers("auto"), axis=0), [[4, 1]])
    np.testing.assert_allclose(np.diff(centers("matplotlib"), axis=0)[0, 1], 0, atol=1e-12)
    assert (tmp_path / "dot.read").read_text().count(" -> ") == 4
    program.write_text("#!/bin/sh\nexit 1\n")
    np.testing.assert_array_equal(centers("auto"), centers("matplotlib"))
    with pytest.raises(ValueError, match="Install graphviz, or pass layout='matplotlib'"):
        plot.automaton(table, layout="graphviz")
    with pytest.raises(ValueError, match="Pass one of auto, graphviz, matplotlib"):
        plot.automaton(table, layout="neato")


def test_notebooks_show_a_picture_unless_it_would_crowd():
    import jaxltl.plot.notebook  # noqa: F401  as the package's first public name has it

    picture = to_automaton("G F a")._repr_svg_()
    assert picture is not None
    assert ElementTree.fromstring(picture).tag == "{http://www.w3.org/2000/svg}svg"
    for states, letters in ((41, 1), (16, 16)):
        count = np.arange(states)[:, None] + np.arange(1, letters + 1)
        rows = [[bool(n >> p & 1) for p in range(4)] for n in range(letters)]
        crowd = make_automaton(count % states, 0, rows, "abcd", accepting=np.arange(states) == 0)
        assert isinstance(crowd, Automaton) and crowd._repr_svg_() is None


def test_the_same_picture_has_the_same_bytes():
    first, second = (plot.to_bytes(plot.automaton(to_automaton("F a"))) for _ in range(2))
    assert b"<dc:date>" not in first
    assert len(first) == len(second)


@pytest.mark.parametrize(
    "draw",
    [
        lambda: plot.grid(MAP, np.linspace(0, 1, 6), np.full((6, 4), 0.25), titles="memory 0"),
        lambda: plot.curves({"loss": np.linspace(1, 0, 5)}),
        lambda: plot.automaton(to_automaton("F a")),
    ],
)
def test_a_picture_is_what_matplotlib_saves(draw):
    """Drawn once, not twice; but for names that are made up anew each time."""
    figure, saved = draw(), io.BytesIO()
    found = plot.to_bytes(figure)
    assert b"</svg>" in plot.to_bytes(figure)  # once more
    draw().savefig(saved, format="svg", dpi=150, metadata={"Date": None})
    plain = [re.sub(rb"(p|m|image)[0-9a-f]{10}", b"", x) for x in (found, saved.getvalue())]
    assert plain[0] == plain[1]


def test_a_grid_with_values_and_policy():
    values = np.linspace(0, 1, 6)
    policy = np.full((6, 4), 0.25)
    figure = plot.grid(MAP, values, policy, titles="memory 0", label="probability")
    assert plot.to_bytes(figure, "png").startswith(b"\x89PNG")
    greedy = plot.grid(MAP, policy=np.zeros(6, int))
    assert len(greedy.axes[0].collections[-1].get_paths()) == 6
    panels = plot.grid(
        MAP, np.tile(values, (4, 1)), np.tile(policy, (4, 1, 1)), titles=list("abcd")
    )
    assert [axes.get_title(loc="left") for axes in panels.axes[:4]] == list("abcd")


def test_a_blank_and_a_large_map():
    large = "\n".join(["." * 30] * 25)
    figures = [
        plot.grid(MAP),
        plot.grid(large, np.full(750, np.nan)),
        plot.grid(MAP, np.arange(6.0), limits=None),
    ]
    for figure in figures:
        assert b"</svg>" in plot.to_bytes(figure)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"values": np.zeros(5)}, r"values have shape \(5,\); the map has 6 cells"),
        ({"policy": np.zeros((6, 3))}, r"policy has shape \(6, 3\)"),
        ({"values": np.zeros((2, 6)), "policy": np.zeros((3, 6, 4))}, r"2 panels and the policy 3"),
        ({"policy": np.zeros((6, 1)), "actions": ["jump"]}, r"action 'jump' has no direction"),
    ],
)
def test_grid_misfits(options, message):
    with pytest.raises(ValueError, match=message):
        plot.grid(MAP, **options)


def test_curves_with_and_without_spread():
    loss = np.geomspace(1e3, 1e-3, 20)
    figure = plot.curves({"loss": np.stack([loss, 2 * loss]), "unknown": np.full((2, 20), np.nan)})
    assert len(figure.axes) == 1 and figure.axes[0].get_yscale() == "log"
    assert len(figure.axes[0].collections) == 1
    alone = plot.curves({"loss": loss}, steps=np.arange(20) * 5)
    assert len(alone.axes[0].collections) == 0
    with pytest.raises(ValueError, match="nothing to show among unknown"):
        plot.curves({"unknown": [np.nan]})


def test_curves_of_stacked_seeds():
    loss = np.arange(30.0).reshape(2, 3, 5)  # of a vmap within a vmap
    (stacked,) = plot.curves({"loss": loss, "weight": np.ones(2)}, show=["loss"]).axes
    (flat,) = plot.curves({"loss": loss.reshape(6, 5)}).axes
    np.testing.assert_array_equal(stacked.lines[0].get_ydata(), flat.lines[0].get_ydata())
    with pytest.raises(ValueError, match="loss are single numbers; give a run's history"):
        plot.curves({"loss": 3.0})


def arrows(axes, base=0.2):
    """Tips of a map's arrows, those with a wide base and the others."""
    found = [x.get_xy() for x in axes.patches if not isinstance(x, Circle | Rectangle)]
    wide = [float(np.abs(xy[0] - xy[2]).sum()) > base for xy in found]
    tips = [tuple(np.round(xy[1], 2)) for xy in found]
    return (
        sorted(t for t, big in zip(tips, wide, strict=True) if big),
        sorted(t for t, big in zip(tips, wide, strict=True) if not big),
    )


def test_rare_moves_have_small_arrows():
    play = np.zeros((2, 6, 4))
    play[0, 1] = [0, 1 - 1e-6, 1e-6, 0]  # b . r over . # y
    play[0, 5] = [0.5, 0, 0.5, 0]
    play[1, 0] = np.nan
    play[1, 4] = 0
    marked = np.zeros((2, 6), bool)
    marked[0, 5] = marked[1, 0] = True
    figure = plot.strategies(MAP, play, marked=marked, mark="good", titles=["one", "two"])
    first, second = figure.axes
    assert arrows(first) == ([(1.5, 0.96), (2.04, 1.5), (2.5, 1.04)], [(1.2, 0.5)])
    assert arrows(second) == ([], [])
    fills = [
        {x.get_xy(): to_hex(x.get_facecolor()) for x in axes.patches if isinstance(x, Rectangle)}
        for axes in (first, second)
    ]
    assert fills[0][2, 1] == MARKED and fills[0][0, 0] == PAPER
    assert fills[1][0, 0] == NEVER and fills[1][1, 1] == WALL
    assert [axes.get_title(loc="left") for axes in figure.axes] == ["one", "two"]
    assert [t.get_text() for t in figure.legends[0].texts] == [
        "good",
        "never reached",
        "often",
        "seldom",
    ]
    assert {t.get_text() for t in first.texts} == {"b", "r", "y"}
    assert b"</svg>" in plot.to_bytes(figure)
    single = plot.strategies(MAP, play[0], seldom=1e-7)
    assert len(arrows(single.axes[0])[0]) == 4 and not single.legends
    # A row of maps has at most so many.
    assert len(plot.strategies(MAP, play[[0] * 5], num_columns=3).axes) == 6


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"play": np.zeros((6, 3))},
            r"play has shape \(6, 3\); the map has 6 cells and there are 4",
        ),
        (
            {"play": np.zeros((6, 4)), "marked": np.zeros((2, 6))},
            r"marked has shape \(2, 6\); play",
        ),
        ({"play": np.zeros((6, 1)), "actions": ["jump"]}, r"action 'jump' has no direction"),
    ],
)
def test_misfits_of_strategies(options, message):
    with pytest.raises(ValueError, match=message):
        plot.strategies(MAP, **options)


def test_values_are_compared_state_by_state():
    best, mine = [3.0, 1.0, 2.0, 1.0], [0.5, 0.9, 2.0, 0.1]
    figure = plot.compare({"best": best, "mine": mine}, groups=["x", "x", "y", "x"], label="worth")
    axes = figure.axes[0]
    found = {line.get_label(): line for line in axes.lines if len(line.get_xdata()) == 4}
    assert found["best"].get_ydata().tolist() == [1.0, 1.0, 3.0, 2.0]
    assert found["mine"].get_ydata().tolist() == [0.1, 0.9, 0.5, 2.0]
    np.testing.assert_array_equal(found["best"].get_xdata(), found["mine"].get_xdata())
    left, right = (text.get_position()[0] for text in axes.texts)
    assert [text.get_text() for text in axes.texts] == ["x", "y"] and left < right
    assert [t.get_text() for t in figure.legends[0].texts] == ["best", "mine"]
    assert axes.get_ylabel() == "worth"
    assert b"</svg>" in plot.to_bytes(plot.compare({"alone": best}))


@pytest.mark.parametrize(
    ("values", "groups", "message"),
    [
        ({}, None, "compare needs values of the same states; it has none"),
        ({"a": []}, None, "it has a: 0"),
        ({"a": [1.0], "b": [1.0, 2.0]}, None, "it has a: 1, b: 2"),
        ({"a": [1.0]}, ["x", "y"], "groups has 2 names; there are 1 states"),
    ],
)
def test_misfits_of_values_to_compare(values, groups, message):
    with pytest.raises(ValueError, match=message):
        plot.compare(values, groups=groups)


def states(count, environment, system, turn=1):
    """The number of a state of a game of two robots."""
    return (environment * count + system) * 2 + turn


def shown_values(axes):
    """The values that a map shades, by row and column."""
    return axes.images[0].get_array()


def test_values_of_a_game_lie_as_its_places_do():
    values = np.full(2 * 4 * 4, 0.0)
    values[states(4, 0, 3)] = 7.29  # the environment in the lower left, the system opposite
    values[states(4, 0, 3, turn=0)] = 100  # not where the system moves
    values[states(4, 1, 1)] = np.nan
    figure = plot.game_values(values, 2, label="reward")
    maps = figure.axes[:4]
    tables = [shown_values(axes) for axes in maps]
    assert tables[2][0, 1] == 7.29 and sum(float(x.sum()) for x in tables) == 7.29
    assert tables[3].mask.tolist() == [[False, False], [False, True]]
    assert {x.norm.vmax for axes in maps for x in axes.images} == {7.29}
    robots = [[x.center for x in axes.patches if isinstance(x, Circle)] for axes in maps]
    assert robots == [[(0.5, 0.5)], [(1.5, 0.5)], [(0.5, 1.5)], [(1.5, 1.5)]]
    assert "7.29" in {text.get_text() for text in maps[2].texts}
    assert b"</svg>" in plot.to_bytes(figure)


def test_walls_have_no_map_of_their_own():
    game = "a#\n.b"
    figure = plot.game_region(np.ones(18, bool), game)
    assert [axes.axison for axes in figure.axes] == [True, False, True, True]
    few = plot.game_region(np.ones(18, bool), game, environment=[2, 0])
    assert [axes.get_title() for axes in few.axes] == ["row 2, column 2", "row 1, column 1"]
    won = np.zeros(18, bool)
    won[states(3, 0, 2)] = True
    cells = plot.game_region(won, game).axes[0].patches
    fills = {x.get_xy(): to_hex(x.get_facecolor()) for x in cells if not isinstance(x, Circle)}
    assert fills[(1, 1)] != fills[(0, 1)] == fills[(0, 0)] and len(fills) == 4


def marks_of_moves(axes):
    """Where the filled triangles and dots of a map lie, as the places that they point to."""
    ink = to_hex(INK)
    return sorted(
        tuple(x.center if isinstance(x, Circle) else x.get_xy()[1])
        for x in axes.patches
        if not isinstance(x, Rectangle)
        and x.get_facecolor()[3] > 0
        and to_hex(x.get_facecolor()) == ink
    )


def test_moves_point_where_they_lead():
    allowed = np.zeros((2, 18, 5), bool)
    allowed[0, states(3, 0, 2), [2, 4]] = True  # left and stay, in the lower right
    allowed[1, states(3, 0, 1), 3] = True  # right, in the lower left
    allowed[:, states(3, 1, 2), 0] = True  # while the environment is elsewhere
    allowed[:, states(3, 0, 2, turn=0), 1] = True
    available = allowed[0] | allowed[1]
    figure = plot.game_moves(
        allowed,
        "a#\n.b",
        0,
        available=available,
        titles=["one", "two"],
        region=available.any(-1),
        system=2,
    )
    first, second = figure.axes
    np.testing.assert_allclose(marks_of_moves(first), [(1.08, 1.5), (1.5, 1.5)])
    np.testing.assert_allclose(marks_of_moves(second), [(0.92, 1.5)])
    assert [axes.get_title(loc="left") for axes in figure.axes] == ["one", "two"]
    assert [t.get_text() for t in figure.legends[0].texts] == [
        "the system wins",
        "the environment wins",
        "the environment's robot",
        "allowed",
        "not allowed",
    ]
    assert b"</svg>" in plot.to_bytes(figure)


def test_a_policy_over_the_values_of_a_game():
    policy = np.full(32, -1)
    policy[states(4, 0, 3)] = 2
    figure = plot.game_values(np.zeros(32), 2, policy=policy)
    assert [len(marks_of_moves(axes)) for axes in figure.axes[:4]] == [0, 0, 1, 0]
    several = plot.game_values(np.zeros(32), 2, policy=policy[:, None] == np.arange(5))
    assert [len(marks_of_moves(axes)) for axes in several.axes[:4]] == [0, 0, 1, 0]


@pytest.mark.parametrize(
    ("draw", "message"),
    [
        (
            lambda: plot.game_values(np.zeros(31), 2),
            r"values has shape \(31,\); the board has 4 places, so that the game has 2 \* 4\*\*2 = 32",
        ),
        (
            lambda: plot.game_values(np.zeros(32), 2, policy=np.zeros(4, int)),
            r"policy has shape \(4,",
        ),
        (lambda: plot.game_region(np.zeros(32, bool), "..#"), r"region has shape .* 2 places"),
        (
            lambda: plot.game_moves(np.zeros((32, 1), bool), 2, 0, actions=["jump"]),
            r"action 'jump' has no direction; use up, down, left, right, stay",
        ),
        (
            lambda: plot.game_values(np.zeros(32), 2, policy=np.zeros(32, int), actions=["hop"]),
            r"action 'hop' has no direction",
        ),
        (
            lambda: plot.game_moves(np.zeros((32, 5), bool), 2, 4),
            r"environment 4 .* places are 0 to 3",
        ),
        (lambda: plot.game_values(np.zeros(32), 2, environment=[-1]), r"environment -1 "),
    ],
)
def test_game_misfits(draw, message):
    with pytest.raises(ValueError, match=message):
        draw()


# --- search under constraints -----------------------------------------------------------------


def test_bands_have_means_spreads_and_limits():
    x, mean, spread = [1, 2, 3], [1.0, 2.0, 4.0], [0.5, 0.5, 1.0]
    figure = plot.bands(
        {
            "one": {"cost": {"a": (x, mean, spread), "b": (x, mean, spread)}},
            "two": {"cost": {"b": (x, mean, spread)}},
        },
        limits={"two": {"cost": 3.0}},
        label="trajectories",
    )
    first, second = figure.axes
    assert [len(axes.get_lines()) for axes in (first, second)] == [2, 2]
    np.testing.assert_allclose(second.get_lines()[1].get_ydata(), 3.0)
    # A method has its colour in every panel.
    assert first.get_lines()[1].get_color() == second.get_lines()[0].get_color()
    band = first.collections[0].get_paths()[0].vertices
    assert (band[:, 1].min(), band[:, 1].max()) == (0.5, 5.0)
    assert [t.get_text() for t in figure.legends[0].texts] == ["a", "b"]
    assert (first.get_xlabel(), second.get_xlabel()) == ("", "trajectories")


def test_a_sweep_has_means_over_seeds_and_their_spread():
    loss = np.random.default_rng(0).normal(size=(2, 3, 4))
    loss[0, 1, 2], loss[1, :, 0] = np.nan, np.nan
    figure = plot.sweep({"loss": loss, "none": loss * np.nan}, ["slow", "fast"], steps=[5, 6, 7, 8])
    (axes,) = figure.axes
    assert [t.get_text() for t in figure.legends[0].texts] == ["slow", "fast"]
    for line, rows in zip(axes.get_lines(), loss, strict=True):
        assert line.get_xdata().tolist() == [5, 6, 7, 8]
        for drawn, column in zip(line.get_ydata(), rows.T, strict=True):
            told = column[~np.isnan(column)]
            assert drawn == pytest.approx(told.mean()) if told.size else np.isnan(drawn)
    edge = axes.collections[0].get_paths()[0].vertices
    for drawn in (
        loss[0, :, 0].mean() + loss[0, :, 0].std(),
        loss[0, [0, 2], 2].mean() - loss[0, [0, 2], 2].std(),
    ):
        assert np.isclose(edge[:, 1], drawn).any()
    for rows, names, message in (
        (loss[0], ["a", "b"], r"loss has shape \[3, 4\]; give \[2, N, T\]"),
        (loss, ["a"], r"loss has shape \[2, 3, 4\]; give \[1, N, T\]"),
        (loss, list("abcdefg"), "7 settings; show at most 6"),
    ):
        with pytest.raises(ValueError, match=message):
            plot.sweep({"loss": rows}, names)


def test_lines_beside_a_reference():
    figure = plot.lines(
        {"net": {"state": (np.zeros((5, 4)), np.ones(4)), "gap": ([[1.0, 2.0]], None)}},
        labels=("time", "seed"),
    )
    assert [len(axes.get_lines()) for axes in figure.axes] == [6, 1]
    assert [axes.get_xlabel() for axes in figure.axes] == ["time", "seed"]


def test_paths_on_a_map():
    place = np.array([[0.0, 1.0, 2.0], [0.0, 0.0, -1.0]])
    figure = plot.paths(
        {"first": (place, place), "second": (place, -place), "third": (place, place)},
        {"goal": ((1, 1), (2, 2))},
        bounds=((-3, -3), (3, 3)),
        num_columns=2,
    )
    assert len(figure.axes) == 4 and figure.axes[1].get_title(loc="left") == "second"
    drawn = figure.axes[1].get_lines()
    np.testing.assert_allclose(drawn[0].get_ydata(), -place[0])
    np.testing.assert_allclose(drawn[-1].get_xdata(), [2.0, -1.0])  # where they end
    goal = figure.axes[0].patches[0]
    assert (goal.get_xy(), goal.get_width()) == ((1.0, 1.0), 1.0)


@pytest.mark.parametrize(
    "draw",
    [
        lambda: plot.bands({}),
        lambda: plot.sweep({"loss": np.full((1, 2, 3), np.nan)}, ["a"]),
        lambda: plot.lines({"net": {}}),
        lambda: plot.paths({}, {}, bounds=((0, 0), (1, 1))),
    ],
)
def test_nothing_to_show_of_a_search(draw):
    with pytest.raises(ValueError, match="nothing to show"):
        draw()


# --- coloured worlds --------------------------------------------------------------------------


def test_a_coloured_world_is_drawn_with_all_that_is_in_it():
    world = training_world(margin=2)
    policy, value = np.full((100, 2, 4), 0.25), np.tile(np.arange(100.0)[:, None], (1, 2))
    policy[:, 1] = [0, 0, 0, 1]
    runs = make_trajectories(world.mdp, [[(0, 3), (1, 3), (2, 1)], [(99, 0)]])
    figure = plot.temporal_gridworld(
        world, policy, [0, 1], runs, value, title=["first", "second"], label="worth"
    )
    first, second, low, _, bar = figure.axes
    assert [a.get_title(loc="left") for a in (first, second)] == ["first", "second"]
    assert first.get_xlim() == (-2, 12) and bar.get_ylabel() == "worth"
    names = Counter(text.get_text() for text in first.texts)
    assert names == {"o1": 1, "o2": 1, "o3": 1, "ob": 5}
    shown = first.images[0].get_array()
    assert shown.shape == (14, 14, 3)
    np.testing.assert_allclose(shown[5, 5], to_rgb(TINTS[4]))  # cell (4, 4) is black
    np.testing.assert_allclose(low.images[0].get_array().ravel(), np.arange(100))
    triangles = next(a for a in second.collections if isinstance(a, PolyCollection))
    assert len(triangles.get_paths()) == 100
    # What is drawn on black cells is light, and dark on all others.
    light = [to_hex(c) == PAPER for c in triangles.get_facecolor()]
    np.testing.assert_array_equal(light, np.asarray(world.colors)[2:-2, 2:-2].ravel() == 4)
    walk = first.get_lines()[0].get_xydata()
    np.testing.assert_allclose(np.diff(walk, axis=0), [[1, 0], [1, 0]])
    np.testing.assert_allclose(walk[0], 0.5, atol=0.25)
    assert [t.get_text() for t in figure.legends[0].texts] == ["first cell", "last cell"]
    ElementTree.fromstring(plot.to_bytes(figure))


def test_a_large_coloured_world_marks_what_is_frequent():
    world = random_world(0, "F o1", shape=(20, 30), num_obstacles=12)
    figure = plot.temporal_gridworld(world)
    texts = Counter(text.get_text() for text in figure.axes[0].texts)
    assert texts == {"o1": 1, "o2": 1, "o3": 1, "ob": 12}
    assert not figure.legends


def test_a_large_grid_has_letters_and_a_legend():
    cells = np.full((30, 30), ".", dtype="<U5")
    cells[0, 0], cells[3, 4], cells[5, 5], cells[29, 29], cells[7, 7] = (
        "a",
        "goal",
        "gold",
        "ab",
        "#",
    )
    shown = np.where(cells == ".", 0.5, np.where(cells == "gold", np.nan, 1.0)).ravel()
    for values in (None, shown):
        figure = plot.grid(cells, values)
        texts = Counter(text.get_text() for text in figure.axes[0].texts)
        assert texts == {"a": 1, "ab": 1, "g": 1, "o": 1}
        assert [t.get_text() for t in figure.legends[0].texts] == ["g: goal", "o: gold"]
        assert all(text.get_fontsize() >= 6.5 for text in figure.axes[0].texts)
    short = plot.grid(np.where(cells == "goal", "b", np.where(cells == "gold", "b", cells)))
    assert not short.legends
    board = plot.strategies(cells, np.full((900, 4), 0.25))
    assert {"goal", "gold", "a", "ab"} <= {text.get_text() for text in board.axes[0].texts}


def test_cells_without_a_value_are_hatched():
    def hatched(figure):
        return {x.get_xy() for x in figure.axes[0].patches if x.get_hatch()}

    values = [0.2, np.nan, 0.5, 0.5, np.nan, np.nan]  # the fifth cell is a wall
    assert hatched(plot.grid(MAP, values)) == {(1, 0), (2, 1)}
    assert hatched(plot.grid(MAP)) == set()


@pytest.mark.parametrize(
    "options, message",
    [
        (
            {"policy": np.zeros((99, 4))},
            r"policy has shape \(99, 4\); .* 100 cells, .*100, memory, 4",
        ),
        ({"policy": np.zeros((100, 2, 4)), "memory": 2}, r"memory 2 does not exist; .* 0 to 1"),
        ({"value": np.zeros((100, 2, 4))}, r"value has shape \(100, 2, 4\)"),
        ({"policy": np.zeros((100, 1)), "actions": ["hop"]}, "action 'hop' has no direction"),
        (
            {"trajectories": Trajectories(np.array([[100]]), np.array([[0]]), np.array([1]))},
            "trajectories have states 100 to 100; the world's cells are 0 to 99",
        ),
    ],
)
def test_what_does_not_fit_a_coloured_world(options, message):
    with pytest.raises(ValueError, match=message):
        plot.temporal_gridworld(training_world(), **options)
