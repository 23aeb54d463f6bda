"""Pictures: they are drawn whole, labels stand free, and misfits are named."""

import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest

from jaxltl import drawing, plot
from jaxltl.core.translate import to_automaton

MAP = "b . r\n. # y"
GOOD = [
    "F a",
    "true",
    "false",
    "G (a -> X b)",
    "F a & F b",
    'F "a $x$ & b" & !c U d',
    "(!r & !y) -> ((!r U y) & (!y U g1) & (!y U g2) & F y)",
]


@pytest.mark.parametrize("formula", GOOD)
def test_an_automaton_is_drawn(formula):
    table = to_automaton(formula)
    figure = plot.automaton(table)
    axes = figure.axes[0]
    shown = {text.get_text() for text in axes.texts}
    assert {str(q) for q in range(len(table.delta))} <= shown
    ElementTree.fromstring(plot.to_bytes(figure))


@pytest.mark.parametrize("formula", GOOD)
def test_labels_stand_clear_of_states_and_each_other(formula):
    table = to_automaton(formula)
    texts = plot._guard_texts(table)
    graph = drawing.arrange(table.delta, int(table.initial), drawing.rejecting(table), texts)
    boxes = [drawing._Box(x.center, drawing._size(x.text) / 2) for x in graph.labels]
    if len(table.delta) <= 5:  # in a dense graph a label may touch its neighbour
        assert not any(a.overlaps(b) for i, a in enumerate(boxes) for b in boxes[:i])
    assert sum(box.near(graph.position, drawing.RADIUS) for box in boxes) == 0
    for box in boxes:
        assert (box.center - box.half >= 0).all()
        assert (box.center + box.half <= graph.size).all()


def test_states_do_not_overlap():
    table = to_automaton("F a & F b & F c")
    texts = plot._guard_texts(table)
    graph = drawing.arrange(table.delta, 0, drawing.rejecting(table), texts)
    gaps = np.hypot(*(graph.position[:, None] - graph.position[None]).transpose(2, 0, 1))
    assert gaps[~np.eye(len(gaps), dtype=bool)].min() > 2 * drawing.RADIUS


def test_the_longest_guard_says_else():
    texts = plot._guard_texts(to_automaton("!red U (goal & !red)"))
    assert "else" in texts.values() and texts[0, 1] != texts[0, 0]


def test_the_same_picture_has_the_same_bytes():
    first, second = (plot.to_bytes(plot.automaton(to_automaton("F a"))) for _ in range(2))
    assert b"<dc:date>" not in first
    assert len(first) == len(second)


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
    figures = [plot.grid(MAP), plot.grid(large, np.full(750, np.nan)),
               plot.grid(MAP, np.arange(6.0), limits=None)]
    for figure in figures:
        assert b"</svg>" in plot.to_bytes(figure)


@pytest.mark.parametrize(("options", "message"), [
    ({"values": np.zeros(5)}, r"values have shape \(5,\); the map has 6 cells"),
    ({"policy": np.zeros((6, 3))}, r"policy has shape \(6, 3\)"),
    ({"values": np.zeros((2, 6)), "policy": np.zeros((3, 6, 4))}, r"2 panels and the policy 3"),
    ({"policy": np.zeros((6, 1)), "actions": ["jump"]}, r"action 'jump' has no direction"),
])
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
