"""What is told of a network that was learned in a simulated world: a page, and a text."""

from __future__ import annotations

import html
from collections.abc import Iterator, Mapping
from typing import Any

from jaxltl.app.files.task import many
from jaxltl.app.reports.live import Said, live_page
from jaxltl.app.reports.page import Remark, number, probability, rows, tiles, told

_SHARES = ("success", "violation", "undecided")


def page(result: Mapping[str, Any], *shown: Any) -> str:
    """The report of :func:`jaxltl.app.learn_environment.summary`.

    Args:
      result: the summary.
      shown: what moves, pictures and the task file, as for :func:`~.live.live_page`.
    """
    about = [
        f"<h2>Evaluation</h2><p class=muted>{html.escape(_judged(result))}</p>",
        _table(result),
        _seeds(result),
    ]
    return live_page(
        result, Said(html.escape(_sentence(result)), remarks(result), _tiles(result), about), *shown
    )


def _sentence(result: Mapping[str, Any]) -> str:
    world, training = result["environment"], result["training"]
    acts = world["actions"]
    does = f"{acts} actions" if isinstance(acts, int) else f"actions in a box {acts}"
    return (
        f"{result['method']} in {world['name']}: {does}, {many(result['num_memory'], 'state')} of "
        f"memory, {training['transitions']:,} simulated steps a seed, "
        f"{many(result['seeds']['number'], 'seed')}; {result['policy']['made_of']}"
    )


def _judged(result: Mapping[str, Any]) -> str:
    found = result["evaluation"]
    acts = {"drawn": "its actions are drawn", "likeliest": "it takes the likeliest action"}
    how = "" if result["method"] == "cce" else f" ({acts[result['policy']['acts']]})"
    return (
        f"{found['num_episodes']:,} fresh episodes of at most {found['num_steps']:,} steps of the "
        f"policy that is kept{how}; each interval holds with {found['confidence']:g}."
    )


def _interval(entry: Mapping[str, Any]) -> str:
    return f"[{number(entry['lower'])}, {number(entry['upper'])}]"


def _rows(result: Mapping[str, Any]) -> Iterator[tuple[str, str, str, str]]:
    """What is estimated, its value, its interval, and what that rests on."""
    found = result["evaluation"]
    finite = result["acceptance"] in ("cosafe", "safety")
    for name in found["estimates"]:
        if finite and "visits" in name:
            continue
        entry = found[name]
        value = probability(entry["mean"]) if name in _SHARES else number(entry["mean"])
        ends = (
            f"[{entry['lower']:.4f}, {entry['upper']:.4f}]" if name in _SHARES else _interval(entry)
        )
        yield name.replace("_", " "), value, ends, entry["method"]


def _table(result: Mapping[str, Any]) -> str:
    found = result["evaluation"]
    ended = (
        f"{found['terminated']:,} terminated, {found['truncated']:,} truncated, "
        f"{found['cut_off']:,} cut off"
    )
    return rows(
        ("of an episode", "estimate", "interval", "by"),
        [tuple(map(html.escape, line)) for line in _rows(result)],
    ) + (
        f"<p class=muted>How they ended: {ended}. Rewards are the task's, with its shaping, "
        "and not discounted.</p>"
    )


def _tiles(result: Mapping[str, Any]) -> str:
    found, shown = result["evaluation"], []
    for name in _SHARES:
        entry = found[name]
        shown.append(
            (probability(entry["mean"]), f"{name}, in [{entry['lower']:.4f}, {entry['upper']:.4f}]")
        )
    if result["acceptance"] not in ("cosafe", "safety"):
        entry = found["visits"]
        shown.append((number(entry["mean"]), f"accepting visits, in {_interval(entry)}"))
    shown.append((number(found["length"]["mean"]), "steps of an episode"))
    return tiles(shown)


def remarks(result: Mapping[str, Any]) -> list[Remark]:
    """What a reader must know first."""
    found, said = result["evaluation"], []
    if result["trivial"]:
        said.append(("note", result["trivial"]))
    if found["threshold"] is not None:
        text = {
            None: ("warning", "It is open whether success is"),
            True: ("good", "Success is"),
            False: ("warning", "Success is not"),
        }[found["decision"]]
        said.append(
            (
                text[0],
                f"{text[1]} at least {found['threshold']:g}, with confidence "
                f"{found['confidence']:g}.",
            )
        )
    if result["acceptance"] == "safety" and found["violation"]["mean"] < 1:
        said.append(
            (
                "note",
                (
                    "A task that forbids is never done in finite time: an episode that is undecided kept "
                    f"to it for {found['num_steps']:,} steps, or until it was truncated."
                ),
            )
        )
    elif result["acceptance"] != "cosafe" and found["undecided"]["mean"] > 0:
        said.append(
            (
                "note",
                (
                    "A task without end is not decided by a finite episode: what counts is how often it "
                    "accepts, the visits."
                ),
            )
        )
    elif found["undecided"]["mean"] > 0.5:
        said.append(
            (
                "warning",
                (
                    f"{probability(found['undecided']['mean'])} of the episodes end undecided: learn for "
                    "more steps, give episodes more time, or shape the reward (shaping in [task])."
                ),
            )
        )
    if found["status"] == "NONFINITE":
        said.append(("warning", "A reward or a cost of an episode is not finite."))
    if result["training"]["troubled_rows"]:
        said.append(
            (
                "warning",
                (
                    f"In {many(result['training']['troubled_rows'], 'reported step')} of the learner a "
                    "number was not finite, no step was found, or no action was allowed."
                ),
            )
        )
    return said


def _seeds(result: Mapping[str, Any]) -> str:
    seeds = result["seeds"]
    if seeds["number"] == 1:
        return ""
    lines, finite = [], result["acceptance"] in ("cosafe", "safety")
    for i, found in enumerate(seeds["evaluations"]):
        kept = " (kept)" if i == seeds["kept"] else ""
        lines.append(
            (
                f"{i}{kept}",
                *(
                    f"{probability(found[n]['mean'])} [{found[n]['lower']:.4f}, {found[n]['upper']:.4f}]"
                    for n in _SHARES
                ),
                *(
                    []
                    if finite
                    else [f"{number(found['visits']['mean'])} {_interval(found['visits'])}"]
                ),
            )
        )
    head = ("seed", *_SHARES, *([] if finite else ["visits"]))
    return rows(head, lines, "<caption>Every seed</caption>") + (
        "<p class=muted>The seed that is kept was chosen by other episodes, so that its intervals "
        "are not those of a winner.</p>"
    )


def table(result: Mapping[str, Any]) -> str:
    """The result as text for the terminal."""
    lines = [f"{result['task']}: {_sentence(result)}", "", _judged(result)]
    lines += [
        f"  {name:18} {value:>10}  {ends:24} {method}"
        for name, value, ends, method in _rows(result)
    ]
    seeds = result["seeds"]
    if seeds["number"] > 1:
        each = ", ".join(probability(x["success"]["mean"]) for x in seeds["evaluations"])
        lines += [
            "",
            f"success of {seeds['number']} seeds: {each}; number {seeds['kept']} is "
            "kept, chosen by other episodes",
        ]
    return "\n".join([*lines, *told(remarks(result))])
