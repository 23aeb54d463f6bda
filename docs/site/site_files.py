"""Reference pages of task and game files, generated from the schemas that validate them."""

import dataclasses
import re
from typing import Any, Literal, NamedTuple, get_args, get_origin

import attrs

from jaxltl.algos import cce, finite_state_controllers, mlirl, ppo, todirl, trust_region
from jaxltl.app.files import (
    game,
    schema,
    task_irl,
    task_rl,
)
from jaxltl.app.files.schema import File, TomlTable


class FilePage(NamedTuple):
    """A kind of file: title of its page, schema, introduction, and the name of an example."""

    title: str
    schema: type[File]
    about: str
    example: str


PAGES = {
    "task-file-mlirl": FilePage(
        "Task files: mlirl",
        task_irl.MlirlFile,
        "``jaxltl learn`` reads a world, a formula and demonstrations, and learns a policy by "
        ":doc:`maximum-likelihood inverse reinforcement learning </docs/guides/mlirl>`. The world "
        "is a map, a :doc:`model file </docs/models>` or a :doc:`log </docs/data>`.",
        "two_goals.toml",
    ),
    "task-file-todirl": FilePage(
        "Task files: todirl",
        task_irl.TodirlFile,
        "``jaxltl learn`` reads training worlds, a formula and demonstrations, learns a "
        ":doc:`reward that transfers </docs/guides/todirl>`, and evaluates it in test worlds.",
        "in_order.toml",
    ),
    "task-file-grounding": FilePage(
        "Task files: symbols of unknown meaning",
        task_irl.GroundingFile,
        "``jaxltl learn`` reads maps, a formula over symbols without a meaning, observations and "
        "demonstrations, learns :doc:`what the symbols mean </docs/guides/grounding>`, and certifies "
        "a policy in each map.",
        "unlabelled_delivery.toml",
    ),
    "task-file-controller": FilePage(
        "Task files: partial observability",
        task_rl.ControllerFile,
        "``jaxltl learn`` reads a map, what a robot sees of it, and a formula, learns a finite-state "
        "controller, and bounds :doc:`what any controller attains </docs/partial-observability>`.",
        "two_rooms.toml",
    ),
    "task-file-environment": FilePage(
        "Task files: environments",
        task_rl.EnvironmentFile,
        "``jaxltl learn`` reads an environment, a formula and a method, and evaluates the learned "
        "policy in fresh episodes; see :doc:`task files for environments "
        "</docs/learn-in-environments>`. Hyperparameters are in the table of the method's name.",
        "flat_world.toml",
    ),
    "game-file": FilePage(
        "Game files",
        game.GameFile,
        "``jaxltl synthesize`` reads a game and an objective of the system, and returns its winning "
        "region and a strategy; see :doc:`permissive strategies </docs/guides/permissive-strategies>`.",
        "patrol.toml",
    ),
}
# Learners whose defaults hold for keys that a file leaves out.
HPARAMS: dict[type[TomlTable], Any] = {
    task_irl.MlirlTable: mlirl.Hparams,
    task_irl.TodirlTable: todirl.Hparams,
    task_rl.ControllerTable: finite_state_controllers.Hparams,
    task_rl.PpoTable: ppo.Hparams,
    task_rl.CceTable: cce.Hparams,
    task_rl.CpoTable: trust_region.Hparams,
}


class Entry(NamedTuple):
    """A row of a table of keys, as texts."""

    key: str
    value: str
    default: str
    example: str
    meaning: str


class KeyHelp(NamedTuple):
    """Entry of a key in the reference: name, requirement on values, default, help, an example."""

    name: str
    requirement: str
    default: Any
    help: str
    example: str


def keys_of(kind: type[TomlTable]) -> list[KeyHelp]:
    """The keys of a table in the order of the schema; a required key has the default ``...``."""
    entries = []
    for field in schema._fields(kind):
        value, default = field.type, field.default
        if default is attrs.NOTHING:
            default = ... if schema.is_required(field) else None
        elif hasattr(default, "factory"):
            default = default.factory()
        about, example = field.metadata["texts"]
        example = example or _example(value, default)
        entries.append(
            KeyHelp(schema.key_name(field), schema.requirement(value), default, about, example)
        )
    return entries


def _example(kind: object, default: object) -> str:
    """Example of a type: of its requirement, or an option that is not the default."""
    for part in schema._parts(kind):
        for meta in getattr(part, "__metadata__", ()):
            if isinstance(meta, schema.Meta) and (meta.example or "such as " in meta.title):
                return meta.example or meta.title.partition("such as ")[2].partition(", with")[0]
        if get_origin(part) is Literal:
            options = get_args(part)
            return f'"{next((x for x in options if x != default), options[0])}"'
        if part is bool:
            return "true"
    return ""


def tables(file: type[File]) -> dict[str, tuple[type[TomlTable], bool]]:
    """Tables of a file by name, and whether each is required."""
    found = {}
    for field in schema._fields(file):
        if kind := schema._table_of(field.type):
            found[schema.key_name(field)] = (kind, schema.is_required(field))
    return found


def file_keys(file: type[File]) -> list[KeyHelp]:
    """Keys of a file outside of its tables."""
    return [key for key in keys_of(file) if key.name not in tables(file)]


def table_keys(table: type[TomlTable]) -> list[KeyHelp]:
    """Keys of a table that a file may have."""
    keys = keys_of(table)
    return [key for key in keys if not key.requirement.startswith("left out")]


def toml(value: Any) -> str:
    """A value as in a file.

    >>> toml(True), toml("a"), toml((64, 64)), toml({}), toml(1e-06)
    ('true', '"a"', '[64, 64]', '{}', '1e-06')
    """
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(toml, value))}]"
    return str(value)


def entry(table: type[TomlTable], key: KeyHelp) -> Entry:
    """The row of a key; ValueError if its help states no default."""
    about, _, default = key.help.rstrip(".").partition("; default ")
    learner = HPARAMS.get(table)
    own = {x.name: x for x in dataclasses.fields(learner)} if learner else {}
    meaning = about or (meaning_of(learner, key.name) if learner else "")
    if key.default is ...:
        default = "required"
    elif key.default is not None:
        default = toml(key.default)
    elif key.name in own and not default:
        value = own[key.name].default
        default = "none" if value is None else toml(value)
    if f'"{default}"' in key.requirement:
        default = toml(default)
    if not (meaning and default and key.example):
        raise ValueError(
            f"{table.__module__}: {key.name} lacks a text, a default or an example; give "
            'key("Meaning; default ...", "example in TOML").'
        )
    return Entry(key.name, key.requirement, default, key.example, f"{meaning}.")


def meaning_of(hparams: Any, name: str) -> str:
    """Meaning of a hyperparameter, from the docstring of its class, in terms of files.

    >>> meaning_of(ppo.Hparams, "learning_rate")
    'Learning rate of Adam'
    """
    entries = re.split(r"\n {6}(?=\S)", (hparams.__doc__ or "").partition("Attributes:")[2])
    for text in entries:
        names, _, about = text.strip().partition(": ")
        if name in names.split(", "):
            about = " ".join(about.replace("``", "").replace("()", "[]").split())
            about = re.sub(r"[;.]? ?[Dd]efault [^;.]*(\.\d[^;.]*)*\.?$", "", about)
            about = re.sub(r"; static\b|; a schedule\b|, a schedule\b|^static\. ", "", about)
            about = about.replace(", or None", "").replace("None:", "Without it:").strip()
            word = "learning rate" if name == "learning_rate" else name.rpartition("_")[2]
            about = f"{word} {about}" if about.startswith("of ") else about
            return about[:1].upper() + about[1:]
    raise ValueError(f"{hparams.__module__}: the docstring of Hparams lacks {name}.")


def _marked(text: str) -> str:
    """Text in which values of files are code.

    >>> _marked('"a", 0.1 or a list such as ["a"]')
    '``"a"``, 0.1 or a list such as ``["a"]``'
    """
    value = r'\{[^{}]*(?:\{[^{}]*\}[^{}]*)*\}|\[[^][]*"[^]]*\]|"[^"]*"'
    return re.sub(value, r"``\g<0>``", text)


def _rows(table: type[TomlTable], keys: list[KeyHelp]) -> list[str]:
    lines = [".. list-table::", "   :header-rows: 1", "   :widths: 14 26 22 18 20", ""]
    rows = [("Key", "Meaning", "Value", "Default", "Example")]
    for key in keys:
        found = entry(table, key)
        is_value = re.match(r'["\d\[{#-]|true|false', found.default) and " " not in found.default
        default = f"``{found.default}``" if is_value else _marked(found.default)
        texts = (_marked(found.meaning), _marked(found.value), default)
        rows.append((f"``{found.key}``", *texts, f"``{found.key} = {found.example}``"))
    for row in rows:
        lines += [f"   {'*' if i == 0 else ' '} - {cell}" for i, cell in enumerate(row)]
    return [*lines, ""]


def page(found: FilePage) -> str:
    """The reference of a kind of file, in reStructuredText."""
    lines = [found.title, "=" * len(found.title), "", found.about, ""]
    lines += [
        "A file is `TOML <https://toml.io>`_; names of files in it are relative to its folder. An "
        "unknown key or an invalid value is an error that names the file, the table, the key and "
        "the valid values. ``jaxltl check FILE`` validates a file without computing.",
        "",
        "Top level",
        "---------",
        "",
        *_rows(found.schema, file_keys(found.schema)),
    ]
    for name, (table, required) in tables(found.schema).items():
        title = f"Table [{name}]"
        lines += [title, "-" * len(title), "", "Required." if required else "Optional.", ""]
        lines += _rows(table, table_keys(table))
    path = f"examples/{found.example}"
    lines += ["A complete file", "-" * 15, "", f"``{path}``:", ""]
    return "\n".join([*lines, f".. literalinclude:: ../../{path}", "   :language: toml", ""])


def pages() -> dict[str, str]:
    """Text of each page by its name."""
    return {slug: page(found) for slug, found in PAGES.items()}
