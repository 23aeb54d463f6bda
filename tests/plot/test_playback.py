"""Moving pictures, read back from the text of the SVG."""

import re
from xml.etree import ElementTree

import pytest

from jaxltl.core.automata.translate import to_automaton
from jaxltl.plot.live import CELL, playback

MAP = "a . #\n. . b\n"
RUN = [0, 1, 1, 4, 5]
MEMORY = [0, 1, 1, 1, 0]
TASK = to_automaton("G F a & G F b")
SVG = "{http://www.w3.org/2000/svg}"


def keyframes(text, name):
    """What is said of each share of the time, in per cent."""
    body = re.search(rf"@keyframes {name}{{((?:[\d.]+%{{[^}}]*}})+)}}", text)[1]
    return {float(k): v for k, v in re.findall(r"([\d.]+)%{([^}]*)}", body)}


def test_the_token_is_where_the_run_is():
    text = playback(MAP, RUN, wait=0.5)
    frames = keyframes(text, "go")
    share = 100 * 0.5 / (4 * 0.5 + 2)
    for step, cell in enumerate(RUN):
        x, y = ((k + 0.5) * CELL for k in (cell % 3, cell // 3))
        assert frames[round(step * share, 2)] == f"transform:translate({x:.0f}px,{y:.0f}px)"
    assert frames[100.0] == frames[4 * share]
    # The line is as long as the way, and nothing of it is hidden at the end.
    assert set(keyframes(text, "draw").values()) == {
        f"stroke-dashoffset:{k * CELL}" for k in (3, 2, 1, 0)
    }


def test_the_automaton_is_in_the_state_of_each_step():
    text = playback(MAP, RUN, automaton=TASK, memory=MEMORY, wait=0.5)
    for q in (0, 1):
        frames, on = keyframes(text, f"circle{q}"), None
        for step, now in enumerate(MEMORY):
            on = frames.get(round(step * 12.5, 2), on)  # it stays what it was
            assert (on == "fill:#c2571a") == (now == q)
    assert "#task-q0 circle{fill:#c2571a}" in text  # where it rests
    assert "#task-q1 circle{fill:#c2571a}" not in text


def test_it_is_one_image_with_a_text_and_heeds_who_wants_no_motion():
    text = playback(MAP, RUN, automaton=TASK, memory=MEMORY, label="from <a> to b")
    root = ElementTree.fromstring(text)
    assert root.tag == f"{SVG}svg" and root.get("role") == "img"
    assert root.get("aria-label") == root.find(f"{SVG}title").text == "from <a> to b"
    assert not re.search(r'tabindex|role="button"|<script', text)
    plays = [x.start() for x in re.finditer(r"animation:", text)]
    assert plays and all("prefers-reduced-motion:no-preference" in text[i - 120 : i] for i in plays)
    assert "A run of 4 steps" in playback(MAP, RUN)


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"states": []}, "at least one"),
        ({"states": [0.5]}, "give int"),
        ({"states": [6]}, "there are 6 cells, so give 0 to 5"),
        ({"states": RUN, "memory": MEMORY}, "without automaton"),
        ({"states": RUN, "automaton": TASK}, "memory has shape"),
        ({"states": RUN, "automaton": TASK, "memory": [0, 1]}, "2 steps and the run 5"),
        ({"states": RUN, "automaton": TASK, "memory": [0, 0, 0, 0, 9]}, "states of the automaton"),
    ],
)
def test_what_is_no_run_is_refused(given, told):
    with pytest.raises(ValueError, match=told):
        playback(MAP, **given)
