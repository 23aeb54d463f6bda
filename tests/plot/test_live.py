"""Pictures for pages: what they show, read back from the text of the SVG."""

import re
from xml.etree import ElementTree

import numpy as np
import pytest

from jaxltl.core.automata.translate import to_automaton
from jaxltl.envs import temporal_gridworld
from jaxltl.envs.text_map import parse_map
from jaxltl.plot import live_automaton, live_curve, live_map
from jaxltl.plot.live import CELL

CELLS = parse_map("a . #\n. . b\n")
STEP = {0: (0, -1), 1: (0, 1), 2: (-1, 0), 3: (1, 0)}  # up, down, left, right: across and down


def parts(text, tag, kind):
    """The elements of a tag and a class, in order."""
    return [
        x for x in ElementTree.fromstring(text).iter(tag) if kind in (x.get("class") or "").split()
    ]


def points(path):
    return np.array(re.findall(r"-?[\d.]+", path), float).reshape(-1, 2)


@pytest.mark.parametrize("action", range(4))
@pytest.mark.parametrize("state", [0, 4])
def test_an_arrow_points_where_its_action_leads_and_is_as_long_as_it_is_likely(state, action):
    def tip(chance):
        policy = np.zeros((6, 4))
        policy[state, action] = chance
        (drawn,) = parts(live_map(CELLS, "m", {"0": (None, policy)}), "path", "arrows")
        corners = points(drawn.get("d")) / CELL - [state % 3 + 0.5, state // 3 + 0.5]
        return (corners @ STEP[action]).max(), np.abs(corners).max()

    (some, _), (more, reach) = tip(0.3), tip(0.9)
    assert 0 < some < more < reach + 1e-9 < 0.5
    assert "arrows" not in live_map(CELLS, "m", {"0": (None, np.full((6, 4), np.nan))})


def test_an_arrow_can_be_seen_on_what_is_beneath_it():
    policy = np.eye(4)[np.zeros(6, int)]
    value = np.array([0.0, 1.0, np.nan, np.nan, np.nan, np.nan])
    found = parts(live_map(CELLS, "m", {"0": (value, policy)}), "path", "arrows")
    tones = {x.get("class").removeprefix("arrows").strip(): x.get("d").count("M") for x in found}
    # Light on the dark of 0, dark on 1 and on the colour of b, the page's ink elsewhere.
    assert tones == {"light": 1, "dark": 2, "": 3}


def test_a_map_shows_its_kinds_walls_layers_and_runs():
    text = live_map(
        CELLS,
        "m",
        {"0": (np.zeros(6), None), "1": (np.ones(6), None)},
        runs=[[0, 1, 4], [5]],
        marked=[(4, 1, 3)],
        num_pieces=2,
    )
    assert [x.text for x in parts(text, "text", "name")] == ["a", "b"]
    assert [x.get("x") for x in parts(text, "rect", "wall")] == [str(2 * CELL)]
    fills = [{x.get("fill") for x in group.iter("rect")} for group in parts(text, "g", "layer")]
    assert len(fills[0]) == len(fills[1]) == 1 and fills[0] != fills[1]
    lines = [points(x.find("polyline").get("points")).tolist() for x in parts(text, "g", "track")]
    assert lines == [[[20, 20], [60, 20], [60, 60]], [[100, 60]]]
    (marked,) = parts(text, "g", "marked")
    frame = marked.find("rect")
    assert (frame.get("x"), frame.get("y")) == ("40", "40")
    assert len(parts(text, "circle", "token")) == 2
    numbers = [x.text for x in parts(text, "text", "number")]
    assert numbers == ["1", "2", "3", "1", "2"]


def test_a_coloured_world_has_its_ring_and_names():
    world = temporal_gridworld.make_world({"o1": [(1, 2)], "ob": [(4, 4)]}, 0, shape=(4, 5))
    text = live_map(world, "m", {"0": (None, None)})
    assert len(parts(text, "rect", "ring")) == 6 * 7 - 20
    assert len(parts(text, "rect", "cell")) == 20
    names = [x.text for x in parts(text, "text", "name")]
    assert names.count("o1") == 1 and "ob" in names
    low, _, width, height = map(float, ElementTree.fromstring(text).get("viewBox").split())
    assert low < -CELL and width + low >= 6 * CELL and height + low >= 5 * CELL


def test_a_large_map_has_marks_with_a_legend_and_counts_in_strides():
    cells = np.full((40, 40), ".", dtype="<U5")
    cells[3, 3], cells[9, 30], cells[12, 1] = "b", "goal", "gold"
    text = live_map(cells, "m", {"0": (None, None)})
    names = [x.text for x in parts(text, "text", "name")]
    assert names == ["b", "g", "o", "g: goal", "o: gold"]
    box = [float(x) for x in ElementTree.fromstring(text).get("viewBox").split()]
    assert all(float(x.get("y")) < box[1] + box[3] for x in parts(text, "text", "name"))
    assert [x.text for x in parts(text, "text", "number")][:3] == ["1", "4", "7"]


@pytest.mark.parametrize(
    ("formula", "marks"),
    [
        ("F a", set()),
        ("G F a", {"●"}),
        ("F G a & G F b | F G c", set("01234")),
    ],
)
def test_an_automaton_shows_its_acceptance(formula, marks):
    automaton = to_automaton(formula)
    text = live_automaton(automaton, "x")
    assert {x.text for x in parts(text, "tspan", "mark")} <= marks
    assert bool(marks) == bool(parts(text, "tspan", "mark"))
    assert [x.get("id") for x in parts(text, "g", "state")] == [
        f"x-q{q}" for q in range(len(automaton.delta))
    ]
    for edge in parts(text, "g", "edge"):
        if source := edge.get("data-from"):
            assert int(edge.get("data-to")) in np.asarray(automaton.delta)[int(source)]
    assert "nan" not in text


@pytest.mark.parametrize("values", [np.geomspace(1e4, 1e-3, 9), np.linspace(5, 1, 9)])
def test_a_curve_falls_evenly_on_its_scale(values):
    text = live_curve("loss", values[:, None], np.arange(9))
    (line,) = parts(text, "path", "curve")
    across, down = points(line.get("d")).T
    assert np.ptp(np.diff(across)) < 0.11 and np.ptp(np.diff(down)) < 0.11
    assert down[0] < down[-1] and not parts(text, "path", "band")
    told = [float(x.text) for x in parts(text, "text", "end")[:3]]
    assert told == pytest.approx([values[-1], values[4], values[0]], rel=1e-2)


def test_a_band_holds_all_seeds_and_gaps_are_left_out():
    values = np.array([[1.0, 3], [np.nan, np.nan], [2, 2], [4, np.nan]])
    text = live_curve("loss", values, np.arange(4))
    (band,), (line,) = parts(text, "path", "band"), parts(text, "path", "curve")
    assert len(points(band.get("d"))) == 6 and len(points(line.get("d"))) == 3
    inside, middle = points(band.get("d"))[:, 1], points(line.get("d"))[:, 1]
    assert inside.min() <= middle.min() <= middle.max() <= inside.max()
