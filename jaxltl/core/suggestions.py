"""Suggestions in place of names that do not exist."""

from __future__ import annotations

from collections.abc import Iterable


def suggestion(name: str, known: Iterable[str]) -> str:
    """A question for the known name that is nearest to a wrong one, or empty.

    >>> suggestion("lr", ["clip", "learning_rate"]), suggestion("x", ["clip"])
    (' Did you mean learning_rate?', '')
    """
    import difflib  # takes longer to import than this module

    known = list(known)
    initials = [x for x in known if "".join(word[:1] for word in x.split("_")) == name]
    guess = difflib.get_close_matches(name, known, n=1) or initials
    return f" Did you mean {guess[0]}?" if guess else ""


def unknown_keyword(function: str, name: str, known: Iterable[str]) -> TypeError:
    """The error for a keyword that a function does not take."""
    known = list(known)
    guess = suggestion(name, known) or f" It takes {', '.join(known)}."
    return TypeError(f"{function}() got an unexpected keyword argument {name!r}.{guess}")
