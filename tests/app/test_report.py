"""The page about a learned policy: what it holds, and that it works in a browser."""

import html
import json
import os
import re
import subprocess
from dataclasses import replace
from html.parser import HTMLParser
from xml.etree import ElementTree

import numpy as np
import pytest

from jaxltl.app.reports.page import render_page
from jaxltl.core.models.construct.lifting import lift_trajectories
from jaxltl.core.models.product import product
from jaxltl.core.models.trajectories import make_trajectories
from jaxltl.envs.gridworld import ACTIONS, gridworld
from jaxltl.envs.text_map import parse_map
from jaxltl.plot import explorer as exploring
from jaxltl.plot.drawing import Picture, draw, drawing
from jaxltl.plot.explorer import (
    START,
    Explorer,
    MapLayer,
    curves,
    demonstrated_runs,
    learned_runs,
)

MAP = """
. . a .
. # . .
s . r b
"""
CELLS = parse_map(MAP)
MODEL = product(gridworld(MAP, slip=0.1, initial="s"), "!r U (a & (!r U b))")
ROWS, COLUMNS = CELLS.shape
UP, DOWN, LEFT, RIGHT = range(4)
SHOWN = make_trajectories(
    MODEL.mdp,
    [
        [(8, UP), (4, UP), (0, RIGHT), (1, RIGHT), (2, RIGHT), (3, DOWN), (7, DOWN)],
        [(8, RIGHT), (9, LEFT)],
    ],
)
RESULT = {
    "task": "</script><b>a & b",
    "formula": "a < b",
    "seconds": 1.0,
    "versions": {"jaxltl": "0", "jax": "0"},
}
PICTURES = [
    (Picture("policy.svg", "As a picture", drawing("grid", CELLS), "Told", "policy"), b"<svg/>")
]


def policy():
    rng = np.random.default_rng(0)
    return rng.dirichlet(np.ones(4), (ROWS * COLUMNS, MODEL.num_memory))


def layers():
    value = np.linspace(0, 1, CELLS.size)
    moves = policy()
    return {
        **{
            str(q): MapLayer(f"memory {q}", value if q else value[::-1], moves[:, q])
            for q in (0, 1)
        },
        START: MapLayer(
            "where a run starts", np.where(np.arange(CELLS.size) == 8, 0.5, np.nan), None
        ),
    }


def runs():
    return [*demonstrated_runs(MODEL, SHOWN), *learned_runs(MODEL, policy(), 0)]


def made(**options):
    options = {"place": CELLS, "actions": ACTIONS, "label": "probability", "size": 12} | options
    texts = {"name": "policy", "title": "Learned policy", "caption": "A caption"}
    return Explorer(automaton=MODEL.automaton, layers=layers(), runs=runs(), **texts, **options)


def page(*parts, remarks=()):
    drawn = [(p, {k: draw(d).decode() for k, d in p.drawings.items()}) for p in parts]
    return render_page(
        "page.html", RESULT, drawn, PICTURES, "[task]", sentence="a sentence", remarks=remarks
    )


def learning():
    history = {
        "step": np.arange(1, 31),
        "loss": np.geomspace(900, 1, 30)[:, None] * [1, 1.5],
        "satisfaction": np.full((30, 2), np.nan),
    }
    return curves("learning", "Learning", "A caption", history, ("loss", "satisfaction"))


# --- what is shown --------------------------------------------------------------------------


def test_demonstrations_have_the_memory_that_the_product_gives_them():
    lifted = np.asarray(lift_trajectories(MODEL, SHOWN).state)
    for run, row, length in zip(demonstrated_runs(MODEL, SHOWN), lifted, SHOWN.length, strict=True):
        met = [s * MODEL.num_memory + q for s, q, a in run.steps if a is not None]
        assert met == row[:length].tolist()


def test_where_a_demonstration_ended_is_told_only_if_it_is_sure():
    sure = product(gridworld(MAP, initial="s"), "F a")
    shown = make_trajectories(sure.mdp, [[(8, UP)]])
    assert demonstrated_runs(sure, shown)[0].steps[-1][::2] == (4, None)
    slippery = demonstrated_runs(MODEL, SHOWN)
    assert all(action is not None for _, _, action in slippery[0].steps)


def test_learned_runs_follow_the_policy_and_the_world():
    moves, found = policy(), learned_runs(MODEL, policy(), 3, count=20)
    moves[..., UP] = 0
    only = learned_runs(MODEL, moves / moves.sum(-1, keepdims=True), 3, count=20)
    assert UP not in [a for run in only for _, _, a in run.steps]
    successor, chance = np.asarray(MODEL.mdp.successor), np.asarray(MODEL.mdp.probability)
    table = np.asarray(MODEL.next_memory)
    for run in found:
        for (s, q, a), (t, p, _) in zip(run.steps, run.steps[1:], strict=False):
            assert t in successor[s, a][chance[s, a] > 0] and p == table[t, q]
        assert run.steps[-1][2] is None
    within = learned_runs(MODEL, np.broadcast_to(policy(), (3, *policy().shape)), 0)
    assert max(len(run.steps) for run in within) <= 4


def test_what_solvers_fail_at_does_not_stop_the_page():
    nowhere = np.full((CELLS.size, MODEL.num_memory, 4), np.nan)
    assert [run.steps for run in learned_runs(MODEL, nowhere, 0, count=1)] == [[(8, 0, None)]]
    history = {"step": np.arange(3), "loss": np.array([[1.0], [np.nan], [np.inf]])}
    told = page(curves("learning", "Learning", "", history, ("loss",)))
    assert told.count("<td>unknown</td>") == 2 and told.count('class="plot"') == 1
    started_where_it_is_done = replace(SHOWN, length=np.array([0, 2]))
    assert [run.name for run in demonstrated_runs(MODEL, started_where_it_is_done)] == [
        "demonstration 2 of 2"
    ]


def test_pictures_are_whole_and_their_parts_can_be_found():
    part = made(marked=[(9, 1, RIGHT)], marks="Told not to")
    automaton, board = (
        ElementTree.fromstring(draw(part.drawings[k]).decode()) for k in ("automaton", "map")
    )
    states = [g for g in automaton.iter("g") if "state" in (g.get("class") or "").split()]
    assert [g.get("id") for g in states] == [f"policy-q{q}" for q in range(MODEL.num_memory)]
    assert sum("final" in g.get("class") for g in states) == 1
    edges = {(g.get("data-from"), g.get("data-to")) for g in automaton.iter("g")} - {(None, None)}
    delta = np.asarray(MODEL.automaton.delta)
    moves = {(str(q), str(t)) for q in range(len(delta)) for t in delta[q] if q != t}
    assert moves <= edges
    shown = [g for g in board.iter("g") if g.get("class") == "layer"]
    assert [g.get("data-memory") for g in shown] == ["0", "1", START]
    assert [("none" in (g.get("style") or "")) for g in shown] == [False, True, True]
    values = [len([r for r in g.iter("rect") if r.get("class") == "value"]) for g in shown]
    assert values == [12, 12, 1]
    (marked,) = [g for g in board.iter("g") if g.get("class") == "marked"]
    assert (marked.get("data-state"), marked.get("data-memory"), marked.get("data-action")) == (
        "9",
        "1",
        str(RIGHT),
    )
    assert len([r for r in board.iter("rect") if r.get("class") == "wall"]) == 1
    assert "Told not to:</b> row 3, column 2, memory state 1, right" in page(part)


def test_the_page_is_one_file_and_nothing_in_it_is_taken_for_markup():
    told = [("warning", "<i>beware</i>"), ("note", "mind")]
    text = page(made(label="</script><b>"), learning(), remarks=told)
    assert not re.search("http|<i>b|</script><b>", text)
    assert '<li class="warning"><b>Warning:</b> &lt;i&gt;beware' in text
    (data,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>', text, re.S)
    (found,) = json.loads(data)
    assert found["first"] == "0" and found["columns"] == COLUMNS
    assert found["layers"]["1"]["policy"][3] == pytest.approx(policy()[3, 1], abs=1e-6)
    assert [s for s, _, _ in found["runs"][0]["steps"]] == [8, 4, 0, 1, 2, 3, 7]
    assert "As a picture" not in text  # the live part says the same
    assert text.count('class="plot"') == 1  # what is nowhere known has no curve


class Tables(HTMLParser):
    """The texts of all cells of the tables of a page."""

    def __init__(self, text):
        super().__init__()
        self.cells, self.within = [], False
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.within |= tag in ("td", "th")
        if tag in ("td", "th"):
            self.cells.append("")

    def handle_endtag(self, tag):
        self.within &= tag not in ("td", "th")

    def handle_data(self, data):
        if self.within:
            self.cells[-1] += data


def test_tables_say_what_the_pictures_show():
    part = made()
    cells = Tables(page(part, learning())).cells
    value, moves = layers()["1"].value, policy()
    for state in (2, 7):  # one that has a name and one that has none
        sign = "↑↓←→"[int(np.argmax(moves[state, 1]))]
        name = "a " if state == 2 else ""
        assert f"{name}{value[state]:.4f} {sign}" in cells
    assert "the formula is satisfied" in cells and "the formula is violated" in cells
    assert {"row 3, column 1", "right"} <= set(cells)
    assert "1125" in cells  # the median of the first loss


def test_a_model_without_a_map_and_a_marked_step():
    part = made(place=None, marked=[(9, 1, RIGHT)], marks="Told not to")
    assert set(part.drawings) == {"automaton"}
    text = page(part)
    assert 'class="map"' not in text and "Told not to:</b> state 9, memory state 1, right" in text


def test_what_is_too_large_is_said_and_shown_as_a_picture(monkeypatch):
    monkeypatch.setattr(exploring, "MAX_CELLS", 30)
    part = made()
    assert part.too_large and not part.drawings
    text = page(part)
    assert "12 states by 3 maps" in text and "As a picture" in text and "data:image" in text


# --- in a browser ---------------------------------------------------------------------------


TRIAL = """
<script>
window.addEventListener("load", () => {
  const one = (q) => document.querySelector(q), found = {};
  const shown = (q) => [...document.querySelectorAll(q)]
    .filter((x) => x.style.display !== "none").map((x) => x.dataset.memory ?? x.dataset.run);
  const pressed = () => [...document.querySelectorAll("[data-memory][aria-pressed=true]")]
    .map((x) => x.dataset.memory);
  const look = () => ({ layer: shown(".layer"), table: shown("table[data-memory]"),
    pressed: pressed(), told: one(".memory").textContent, readout: one(".readout").textContent,
    track: shown(".track"), token: one(".token").style.transform, slider: one("input").value,
    marked: shown(".marked") });
  const press = (element, key) => element.dispatchEvent(
    new KeyboardEvent("keydown", { key, bubbles: true, cancelable: true }));
  found.first = look();
  one("#policy-q1").dispatchEvent(new MouseEvent("click", { bubbles: true }));
  found.clicked = look();
  press(one("#policy-q0"), "Enter");
  found.keyed = look();
  one("button[data-memory=start]").click();
  found.starts = look();
  press(one(".board"), "ArrowDown");
  press(one(".board"), "ArrowDown");
  press(one(".board"), "ArrowDown");
  found.cell = look();
  const box = one("svg.map").getScreenCTM();
  one("svg.map").dispatchEvent(new MouseEvent("click", { bubbles: true,
    clientX: box.a * 100 + box.e, clientY: box.d * 20 + box.f }));
  found.pointed = look();
  one(".on").click();
  found.step = look();
  one("select").value = "1";
  one("select").dispatchEvent(new Event("change"));
  found.other = look();
  one("select").value = "0";
  one("select").dispatchEvent(new Event("change"));
  one("input").value = "4";
  one("input").dispatchEvent(new Event("input"));
  found.slid = look();
  found.taken = [...document.querySelectorAll(".edge.taken")]
    .map((x) => [x.dataset.from, x.dataset.to]);
  document.querySelectorAll("details").forEach((x) => { x.open = true; });
  found.width = document.documentElement.scrollWidth;
  found.outside = [...document.querySelectorAll("body *")].filter((x) => {
    const side = x.getBoundingClientRect();
    return side.width > 0 && !x.closest(".scroll, .skip, svg")
      && (side.right > innerWidth + 0.5 || side.left < -0.5);
  }).map((x) => x.outerHTML.slice(0, 80));
  found.small = [...document.querySelectorAll("button, select")].filter((x) => {
    const side = x.getBoundingClientRect();
    return side.height < 43 || side.width < 43;
  }).length;
  one(".play").click();
  found.playing = one(".play").textContent;
  setTimeout(() => { found.soon = one("input").value; }, 900);
  setTimeout(() => {
    found.played = look();
    found.frames = [...document.querySelectorAll(".scroll")].filter((x) => x.clientWidth)
      .map((x) => [x.scrollWidth > x.clientWidth + 1, x.matches(".before, .after"),
        x.nextElementSibling.getBoundingClientRect().height > 0]);
    found.ended = one(".play").textContent;
    const verdict = document.createElement("pre");
    verdict.id = "verdict";
    verdict.textContent = JSON.stringify(found);
    document.body.append(verdict);
  }, 5000);
});
</script></body>"""


FRAME = """<!doctype html><body style="margin:0">
<iframe id="page" width="{width}" height="900" style="border:0" srcdoc="{page}"></iframe>
<script>
const wait = setInterval(() => {{
  const inner = document.getElementById("page").contentDocument.getElementById("verdict");
  if (!inner) return;
  clearInterval(wait);
  const verdict = document.createElement("pre");
  verdict.id = "verdict";
  verdict.textContent = inner.textContent;
  document.getElementById("page").remove();
  document.body.append(verdict);
}}, 50);
</script></body>"""


@pytest.fixture(scope="module")
def browser():
    found = os.environ.get("CHROMIUM")
    if not found:
        pytest.skip("CHROMIUM names no browser, such as /usr/bin/chromium")

    def visit(path, width, *options):
        # In a frame: windows of some browsers are never narrower than 485 pixels.
        framed = path.with_name(f"frame-{width}-{path.name}")
        framed.write_text(FRAME.format(width=width, page=html.escape(path.read_text())))
        done = subprocess.run(
            [
                found,
                "--headless",
                "--no-sandbox",
                "--disable-gpu",
                "--enable-logging=stderr",
                f"--user-data-dir={path.parent / 'profile'}",
                "--window-size=1400,1000",
                "--virtual-time-budget=20000",
                "--dump-dom",
                *options,
                framed.as_uri(),
            ],
            capture_output=True,
            text=True,
            check=True,
            timeout=120,
        )
        said = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
        (verdict,) = re.findall(r'<pre id="verdict">(.*?)</pre>', done.stdout, re.S)
        return json.loads(html.unescape(verdict)), said

    return visit


@pytest.fixture(scope="module", params=[390, 1280])
def trial(request, browser, tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "report.html"
    text = page(made(marked=[(9, 1, RIGHT)]), learning(), remarks=[("warning", "mind " * 40)])
    path.write_text(text.replace("</body>", TRIAL))
    return request.param, *browser(path, request.param)


def test_the_console_is_silent_and_nothing_sticks_out(trial):
    width, found, said = trial
    assert said == []
    assert found["width"] <= width and found["outside"] == [] and found["small"] == 0


def test_frames_that_scroll_say_so(trial):
    width, found, _ = trial
    assert all(scrolls == fades == told for scrolls, fades, told in found["frames"])
    assert any(scrolls for scrolls, _, _ in found["frames"]) == (width == 390)


def test_the_stepper_changes_what_is_shown(trial):
    _, found, _ = trial
    assert found["first"]["layer"] == found["first"]["table"] == ["0"] == found["keyed"]["layer"]
    assert found["first"]["pressed"] == ["0", "0"] and found["first"]["marked"] == []
    clicked = found["clicked"]
    assert clicked["layer"] == clicked["table"] == clicked["marked"] == ["1"]
    assert clicked["pressed"] == ["1", "1"] and clicked["told"].startswith(
        "Memory state 1: remaining"
    )
    assert found["starts"]["layer"] == [START] and found["starts"]["pressed"] == [START]


def test_the_figures_of_a_cell_are_told(trial):
    _, found, _ = trial
    assert found["cell"]["readout"] == "row 3, column 1 · probability 0.5000"
    # 100 and 20 pixels from the map's corner, in cells of 40.
    assert found["pointed"]["readout"] == "row 1, column 3 · no values here"


def test_a_run_plays_on_map_and_automaton(trial):
    _, found, _ = trial
    steps = runs()[0].steps
    (_, memory, _), step = steps[1], found["step"]
    assert step["slider"] == "1" and step["track"] == ["0"] and step["layer"] == [str(memory)]
    assert step["token"] == "translate(20px, 60px)" and "step 1 of 6" in step["readout"]
    assert found["other"]["track"] == ["1"] and found["other"]["slider"] == "0"
    # The fifth place is the first in which the memory is another.
    assert [q for _, q, _ in steps[:5]] == [0, 0, 0, 0, 1] and found["taken"] == [["0", "1"]]
    assert found["slid"]["token"] == "translate(100px, 20px)" and found["slid"]["layer"] == ["1"]
    assert (found["playing"], found["soon"], found["ended"]) == ("Pause", "5", "Play")
    assert found["played"]["slider"] == "6" and "row 2, column 4" in found["played"]["readout"]
