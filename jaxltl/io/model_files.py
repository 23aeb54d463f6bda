"""Reading and writing models in any supported format."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import cast

from jaxltl.core.models import POMDP, Game, IntervalMDP, MultiplayerGame, SparseMDP, to_sparse
from jaxltl.core.models.protocols import Model
from jaxltl.io.cassandra import read_cassandra, write_cassandra
from jaxltl.io.files import decompressed, opened, suffix_of
from jaxltl.io.drn.drn import read_drn, write_drn
from jaxltl.io.npz import read_npz, write_npz
from jaxltl.io.prism.explicit import read_prism, write_prism
from jaxltl.io.prism.program import SUFFIXES, Constants, is_program, read_program_model
from jaxltl.io.umb.umb import read_umb, write_umb

_BEGINNING = 4096  # bytes inspected to detect the format


def _read_cassandra(path: str | os.PathLike[str]) -> POMDP:
    return read_cassandra(path).pomdp


@dataclass(frozen=True)
class Format:
    """File format: name, suffixes, reader, writer and supported kinds of models."""

    name: str
    suffixes: tuple[str, ...]
    read: Callable[[str | os.PathLike[str]], SparseMDP | IntervalMDP | Game | POMDP]
    write: Callable[..., None]  # of a path and a model of this kind
    holds: tuple[type, ...]  # kinds of models, with SparseMDP for all that ``to_sparse`` takes


FORMATS = (
    Format("UMB", (".umb",), read_umb, write_umb, (SparseMDP, IntervalMDP, Game, POMDP)),
    Format(
        "PRISM's explicit files",
        (".tra", ".pexp"),
        read_prism,
        write_prism,
        (SparseMDP, IntervalMDP),
    ),
    Format("DRN", (".drn",), read_drn, write_drn, (SparseMDP, IntervalMDP, POMDP)),
    Format("numpy", (".npz",), read_npz, write_npz, (SparseMDP, IntervalMDP, Game, POMDP)),
    Format("Cassandra's POMDP format", (".pomdp",), _read_cassandra, write_cassandra, (POMDP,)),
)


def read_model(
    path: str | os.PathLike[str],
    *,
    constants: Constants = None,
    max_states: int | None = None,
    coalition: Sequence[str] | None = None,
) -> SparseMDP | IntervalMDP | Game | MultiplayerGame | POMDP:
    """Model of a file, with the format detected by suffix or contents.

    Formats: programs in the PRISM language (``.prism``, ``.pm``, ``.nm``, ``.sm``, ``.smg``), UMB
    (``.umb``), PRISM's explicit files (``.tra`` with its companions, ``.pexp``), DRN (``.drn``),
    ``.npz`` and Cassandra's POMDP format (``.pomdp``); all but ``.npz`` may be compressed (``.gz``,
    ``.xz``).

    Args:
      path: the file.
      constants: of a program, values in a dict or as a text such as ``"N=64,MAX=4"``.
      max_states: of a program, the largest number of states; default 10 million.
      coalition: of a program of a game, the players that are the system of a two-player game.

    Returns:
      A SparseMDP, a Game or a POMDP over one, or an IntervalMDP; of a program of a game without a
      coalition a MultiplayerGame.

    Raises:
      ValueError: with file and place, for unknown formats and missing or malformed files.

    Example:
      >>> import tempfile, jaxltl as jl
      >>> path = tempfile.mkdtemp() + "/coin.drn.gz"
      >>> write_model(path, jl.make_sparse(None, [0, 2, 3, 4], [1, 2, 1, 2], [0.5, 0.5, 1, 1],
      ...                                  initial=[1, 0, 0], label={"heads": [1]}))
      >>> read_model(path).propositions
      ('heads',)
    """
    if is_program(path):
        return read_program_model(path, constants, max_states, coalition)
    if not (constants is None and max_states is None and coalition is None):
        raise ValueError(
            f"{str(path)!r} is no program; constants, max_states and coalition are for programs in "
            f"the PRISM language ({', '.join(SUFFIXES)})."
        )
    return (_by_name(path) or _by_beginning(path)).read(path)


def write_model(path: str | os.PathLike[str], model: Model | POMDP) -> None:
    """Writes a model in the format of the file suffix, atomically.

    Args:
      path: the file.
      model: a model that ``to_sparse`` takes, a Game, an IntervalMDP or a POMDP.

    Raises:
      ValueError: the format is unknown or cannot represent the model, or the file cannot be
        written.

    Example:
      >>> import tempfile, jaxltl as jl
      >>> path = tempfile.mkdtemp() + "/coin.umb"
      >>> write_model(path, jl.make_sparse(None, [0, 2, 3, 4], [1, 2, 1, 2], [0.5, 0.5, 1, 1]))
      >>> read_model(path).successor.tolist()
      [1, 2, 1, 2]
    """
    form = _by_name(path)
    if is_program(path):
        raise ValueError(f"{str(path)!r}: programs are read, not written; write {_known()}.")
    if form is None:
        raise ValueError(f"{str(path)!r}: the suffix names no format; known are {_known()}.")
    if isinstance(model, MultiplayerGame):
        raise ValueError(
            f"{str(path)!r}: files hold games of two players; write model.game([...]), the game of a "
            "coalition."
        )
    kind = next((x for x in (Game, IntervalMDP, POMDP) if isinstance(model, x)), SparseMDP)
    if kind not in form.holds:
        noun = {Game: "games", POMDP: "POMDPs", IntervalMDP: "interval models"}.get(
            kind, "fully observable models"
        )
        raise ValueError(
            f"{str(path)!r}: {form.name} holds no {noun}; write "
            f"{_listed((x for x in FORMATS if kind in x.holds), ' or ')}."
        )
    is_other = isinstance(model, Game | IntervalMDP | POMDP)
    form.write(path, model if is_other else to_sparse(cast(Model, model)))


def _by_name(path: str | os.PathLike[str]) -> Format | None:
    suffix = suffix_of(path)
    return next((x for x in FORMATS if suffix in x.suffixes), None)


def _by_beginning(path: str | os.PathLike[str]) -> Format:
    """Format detected by content; PRISM files require their suffix."""
    with opened(path) as file:
        if file.read(2) == b"PK":
            return _named("numpy")
        file.seek(0)
        start = decompressed(file).read(_BEGINNING)
    if start[257:262] == b"ustar":
        return _named("UMB")
    if start.lstrip().startswith(b"@") or b"\n@type:" in start:
        return _named("DRN")
    raise ValueError(
        f"{str(path)!r}: neither the suffix nor the contents name a known format; known are {_known()}."
    )


def _named(name: str) -> Format:
    return next(x for x in FORMATS if x.name == name)


def _listed(formats: Iterable[Format], separator: str = ", ") -> str:
    return separator.join(f"{x.name} ({', '.join(x.suffixes)})" for x in formats)


def _known() -> str:
    return _listed(FORMATS)
