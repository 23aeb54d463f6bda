"""Pictures of controllers and of what a robot sees."""

import pytest

from jaxltl import plot
from jaxltl.core.policies.finite_memory import action_text

MACHINE = [
    (-1, 0, 1, [1.0, 0.0]),
    (0, 0, 2, [1.0, 0.0]),
    (0, 1, 3, [0.3, 0.7]),
    (1, 1, 3, [0.0, 1.0]),
]


def _texts(figure):
    return {text.get_text() for axes in figure.axes for text in axes.texts}


def test_edges_have_observations_by_action():
    texts = _texts(plot.controller(MACHINE, actions=["up", "wait"]))
    assert {"0", "1", "↑ 1 2", "wait .70, ↑ .30 3", "wait 3"} <= texts and "▸" not in texts


def test_a_start_that_no_memory_state_stands_for_is_a_node():
    other = [(-1, 1, 3, [1.0]), (0, 0, 3, [1.0]), (1, 0, 2, [1.0])]
    texts = _texts(plot.controller(other))
    assert "▸" in texts


@pytest.mark.parametrize(
    ("action", "text"), [([1.0, 0.0], "0"), ([0.5, 0.5], "0 .50, 1 .50"), ([0.004, 0.996], "1")]
)
def test_actions_without_names_have_numbers(action, text):
    assert action_text(action, ()) == text


def test_windows_show_what_is_seen_and_not_what_is_hidden():
    figure = plot.windows("a . x . b", [0, 1, 2, 1, 3], hidden=["x"])
    assert [axes.get_title() for axes in figure.axes] == ["0", "1", "2", "3"]
    assert _texts(figure) == {"a", "b"}


def test_a_run_is_played_with_beliefs_and_the_controller():
    beliefs = [[0.5, 0, 0.5], [0, 1, 0]]
    text = plot.playback(
        "a . b",
        [0, 1],
        beliefs=beliefs,
        window=3,
        automaton=MACHINE,
        memory=[0, 1],
        actions=["up", "wait"],
    )
    shades = [text.split(f'class="belief belief{t}">')[1].split("</g>")[0] for t in (0, 1)]
    assert [x.count("<rect") for x in shades] == [2, 1]
    assert 'fill-opacity="0.51"' in shades[0] and 'fill-opacity="0.90"' in shades[1]
    assert 'class="window"' in text and "wait .70" in text and "@keyframes belief1" in text
    assert "belief" not in plot.playback("a . b", [0, 1]).split("</style>")[1]


def test_beliefs_of_another_map_are_refused():
    with pytest.raises(ValueError, match=r"beliefs has shape \[1, 3\]"):
        plot.playback("a . b", [0, 1], beliefs=[[1, 0, 0]])
