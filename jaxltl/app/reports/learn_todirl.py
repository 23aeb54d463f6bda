"""What was learned of a reward that is to carry over: as a page, and as text."""

from __future__ import annotations

import html
from collections.abc import Mapping
from typing import Any

from jaxltl.app.files.task import place
from jaxltl.app.reports.live import Said, live_page
from jaxltl.app.reports.page import (
    Remark,
    certified,
    number,
    probability,
    rows,
    spread,
    tiles,
    told,
)

_WHO = {
    "learned": "learned reward",
    "expert": "expert, who knows the task",
    "random": "random moves",
}
_EXPERT = {
    "soft": "The expert knows the task and is soft-optimal for it.",
    "quickest": "The expert knows the task: no policy does it with a greater probability, and of "
    "those that do it as well it is the quickest.",
}
_ROWS = 20  # worlds in a table


def page(result: Mapping[str, Any], *shown: Any) -> str:
    """The report of :func:`jaxltl.app.learn_todirl.summary`.

    Args:
      result: the summary.
      shown: what moves, pictures and the task file, as for :func:`~.live.live_page`.
    """
    said = Said(_sentence(result), remarks(result), _tiles(result), _told(result))
    return live_page(result, said, *shown)


def _told(result: Mapping[str, Any]) -> list[str]:
    """What stands after the policies."""
    told = [
        f"<h2>Mean probability of doing the task{_within(result)}</h2>",
        _evidence_table(result),
    ]
    for key, title in (("test", "Test worlds"), ("training", "Training worlds")):
        if result[key]:
            told += [f"<h2>{title}</h2>", _worlds_table(result[key])]
    return [*told, _seeds(result), _network(result)]


def remarks(result: Mapping[str, Any]) -> list[Remark]:
    """What the page says first."""
    found = [("warning", text) for text in warnings(result)]
    if result["guarantee"]["asked"] == "best":
        found.append(
            (
                "good",
                (
                    "By construction: in every world, new ones too, the policy takes moves that lose "
                    "nothing of the task, and no others; what was learned decides how. Taken alike, they "
                    f"are certified to lose at most {number(result['guarantee']['loss'])} here."
                ),
            )
        )
    elif result["guarantee"]["asked"] != "none":
        found.append(("good", _asked(result)))
    if result["trivial"]:
        found.append(("note", result["trivial"]))
    if lost := result["guarantee"]["left_out"]:
        found.append(("note", f"{lost} demonstrated steps lose something and were left out."))
    return found


def _asked(result: Mapping[str, Any]) -> str:
    """How a probability that was asked for was reached."""
    asked = result["guarantee"]
    over = "on average over its starts" if asked["over"] == "mean" else "from its worst start"
    worlds = [
        world
        for key in ("training", "test")
        if result[key]
        for world in result[key]["worlds"]
        if world["name"] not in result[key]["left_out"]
    ]
    least = min(world["attained"] for world in worlds)
    how = (
        "the likeliest reward is taken as it is"
        if not asked["weight"]
        else f"the task is weighed by mu = {asked['weight']:.3g} in learning"
    )
    mixed = [world["share"] for world in worlds if world["share"]]
    more = ""
    if mixed:
        shares = number(mixed[0]) if len(mixed) == 1 else f"{min(mixed):.3g} to {max(mixed):.3g}"
        more = (
            f", and in {len(mixed)} of {len(worlds)} worlds a share of {shares} of moves that "
            "lose nothing is mixed in"
        )
    return (
        f"Asked for {probability(asked['asked'])} in every world, new ones too, {over}; certified "
        f"at least {probability(least)} here: {how}{more}."
    )


def table(result: Mapping[str, Any]) -> str:
    """The result as text for the terminal."""
    learning, seeds = result["learning"], result["seeds"]
    lines = [
        f"{result['task']}: {_plain_sentence(result)}",
        "",
        f"mean probability of doing the task{_within(result)}",
    ]
    for key in ("training", "test"):
        about = result[key]
        if not about:
            continue
        lines.append(f"  in {_number_of_worlds(about)} {key} world{_s(about['num_counted'])}")
        for who, title in _WHO.items():
            one = about[who]
            worst = (
                f"worst {probability(one['worst_world']['value'])} in {one['worst_world']['name']}"
            )
            lines.append(
                f"    {title:27} {probability(one['mean']['value']):>8}   certified "
                f"{certified(one['mean']):15} {worst if about['num_counted'] > 1 else ''}".rstrip()
            )
        one = about["learned"]
        lines.append(f"    {'from the worst start':27} {probability(one['worst_start']):>8}")
    lines += ["", f"learning  {_how_it_ended(result)}"]
    if learning["held_out"] is not None:
        lines.append(
            f"          negative log-likelihood of a held-out pair {number(learning['held_out'])}"
        )
    if seeds["number"] > 1:
        lines += [
            "",
            f"over {seeds['number']} seeds (the one with the best held-out likelihood is above)",
            f"  training mean  {spread(seeds['training_mean'])}",
        ]
        if seeds["test_mean"]:
            lines.append(f"  test mean      {spread(seeds['test_mean'])}")
    return "\n".join([*lines, *told(remarks(result))])


def warnings(result: Mapping[str, Any]) -> list[str]:
    """What a reader must know before trusting the figures, as sentences."""
    found = []
    for key in ("training", "test"):
        about = result[key]
        if not about:
            continue
        worlds = {world["name"]: world for world in about["worlds"]}
        for name in about["infeasible"]:
            world = worlds[name]
            counted = "it is left out" if name in about["left_out"] else "it counts in the mean"
            fix = (
                " unless [test] leave_out names it"
                if key == "test" and name not in about["left_out"]
                else ""
            )
            found.append(
                f"No policy can do the task from {world['infeasible_starts']} of "
                f"{world['num_starts']} starts of the {key} world {name}; {counted}{fix}."
            )
        others = [name for name in about["left_out"] if name not in about["infeasible"]]
        if others:
            found.append(
                f"Left out of the figures as the file asks, though the task can be done there: "
                f"{', '.join(others)}."
            )
        if about["solver"] != "CONVERGED":
            found.append(
                f"The solver for the policies of the {key} worlds ended with {about['solver']}."
            )
        for who, title in _WHO.items():
            if about[who]["uncertain"]:
                listed = ", ".join(about[who]["uncertain"][:5])
                found.append(
                    f"The probability in the {key} worlds ({title}) is known only within its "
                    f"bounds in {listed}{', ...' if len(about[who]['uncertain']) > 5 else ''}."
                )
    learning = result["learning"]
    if learning["solver"] != "CONVERGED":
        found.append(
            f"The solver for soft values ended with {learning['solver']} during learning; a "
            "smaller learning_rate or discount may help."
        )
    improving = learning["best_step"] >= learning["steps"] - 2
    if learning["held_out"] is not None and not learning["stopped_early"] and improving:
        found.append(
            f"The held-out likelihood was still improving after {learning['steps']} steps: raise "
            "steps."
        )
    return found


def _within(result: Mapping[str, Any]) -> str:
    how = "for" if result["acceptance"] == "safety" else "within"
    return f" {how} {result['horizon']} steps" if result["horizon"] else ""


def _s(count: int) -> str:
    return "" if count == 1 else "s"


def _number_of_worlds(about: Mapping[str, Any]) -> str:
    left_out = f" of {about['num_worlds']}" if about["left_out"] else ""
    return f"{about['num_counted']}{left_out}"


def _plain_sentence(result: Mapping[str, Any]) -> str:
    shown = result["demonstrations"]
    kind = "synthetic demonstrations" if shown["synthetic"] else "demonstrations"
    dropped = f", {shown['dropped']} unfinished dropped" if shown["dropped"] else ""
    worlds, tests = result["training"]["num_worlds"], result["test"]
    also = f", tested in {tests['num_worlds']}" if tests else ""
    return (
        f"todirl in {worlds} world{_s(worlds)}{also}, {result['num_memory']} memory states, "
        f"{sum(shown['number'])} {kind} ({sum(shown['pairs'])} pairs{dropped})"
    )


def _sentence(result: Mapping[str, Any]) -> str:
    text = html.escape(_plain_sentence(result))
    if result["memory"] != result["formula"]:
        text += f"; the learner remembers <code>{html.escape(result['memory'])}</code>"
    return text


def _how_it_ended(result: Mapping[str, Any]) -> str:
    learning = result["learning"]
    if learning["held_out"] is None:
        return f"{learning['steps']} steps, without held-out demonstrations"
    why = "stopped early" if learning["stopped_early"] else "to the end"
    best = learning["best_step"]
    return f"{learning['steps']} steps, {why}; kept are the parameters after {best}"


def _tiles(result: Mapping[str, Any]) -> str:
    training, test, learning = result["training"], result["test"], result["learning"]
    figures = [
        (
            probability(training["learned"]["mean"]["value"]),
            f"mean probability in {training['num_counted']} training world"
            f"{_s(training['num_counted'])}",
        )
    ]
    if test:
        one = test["learned"]
        figures = [
            (
                probability(one["mean"]["value"]),
                f"mean probability in {_number_of_worlds(test)} test worlds",
            ),
            (
                probability(one["worst_world"]["value"]),
                f"in the worst test world, {html.escape(one['worst_world']['name'])}",
            ),
            *figures,
        ]
    figures.append(
        (
            number(learning["held_out"] if learning["held_out"] is not None else learning["loss"]),
            (
                "negative log-likelihood of a held-out pair; "
                if learning["held_out"] is not None
                else "loss; "
            )
            + html.escape(_how_it_ended(result)),
        )
    )
    return tiles(figures)


def _evidence_table(result: Mapping[str, Any]) -> str:
    lines = []
    for key in ("test", "training"):
        about = result[key]
        if not about:
            continue
        for who in _WHO:
            one = about[who]
            lines.append(
                (
                    f"{key}, {who}",
                    probability(one["mean"]["value"]),
                    certified(one["mean"]),
                    number(one["std"]) if about["num_counted"] > 1 else "",
                    f"{probability(one['worst_world']['value'])}, "
                    f"{html.escape(one['worst_world']['name'])}",
                    probability(one["worst_start"]),
                )
            )
    header = ("who", "mean", "certified", "deviation", "worst world", "worst start")
    return rows(header, lines) + (
        "<p class=muted>The true mean over worlds and starts is certified to be that close. The "
        "deviation is over worlds; the worst start is over all starts of all worlds. "
        f"{_EXPERT[result['expert']]}</p>"
    )


def _worlds_table(about: Mapping[str, Any]) -> str:
    worlds = sorted(about["worlds"], key=lambda world: _known(world["mean"]["value"]))
    lines = []
    for world in worlds[:_ROWS]:
        least = world["minimum"]
        name = html.escape(world["name"])
        if world["name"] in about["left_out"]:
            name += " (left out)"
        if world["infeasible_starts"]:
            name += f"<br><span class=bad>{world['infeasible_starts']} infeasible starts</span>"
        lines.append(
            (
                name,
                probability(world["mean"]["value"]),
                certified(world["mean"]),
                f"{probability(least['value'])}, from {place(least)}",
                probability(world["expert"]),
                probability(world["random"]),
            )
        )
    header = ("world", "mean", "certified", "worst start", "expert", "random")
    more = len(worlds) - len(lines)
    return rows(header, lines) + (
        f"<p class=muted>The worst {len(lines)}; the other {more} are in result.json.</p>"
        if more > 0
        else ""
    )


def _known(value: float | None) -> float:
    return -1.0 if value is None else value


def _seeds(result: Mapping[str, Any]) -> str:
    seeds = result["seeds"]
    if seeds["number"] == 1:
        return ""
    test = f", in the test worlds {spread(seeds['test_mean'])}" if seeds["test_mean"] else ""
    return (
        f"<p class=muted>{seeds['number']} seeds: the mean probability in the training worlds is "
        f"{spread(seeds['training_mean'])}{test}. The seed with the best held-out likelihood is "
        "shown; test worlds had no part in the choice.</p>"
    )


def _network(result: Mapping[str, Any]) -> str:
    load = html.escape(result["network"]["load"])
    return (
        "<h2>The learned network</h2><p><code>network.npz</code> holds the reward network and the "
        f"automaton of its memory. <code>{load}</code> reads it, and "
        "<code>jaxltl.io.learned_reward.plan_in</code> plans with it in another world.</p>"
    )
