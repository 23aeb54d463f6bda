"""Rational numbers that doubles of a model stand for."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction

_DENOMINATOR = 10**6  # the largest of a simple fraction


def rational(number: float) -> Fraction:
    """The simple fraction, or the decimal of 15 digits, next to a double; else the double itself.

    >>> rational(0.1), rational(1 / 3), rational(0.1 + 0.2) == Fraction(0.1 + 0.2)
    (Fraction(1, 10), Fraction(1, 3), True)
    """
    exact = Fraction(float(number))
    for reading in (exact.limit_denominator(_DENOMINATOR), Fraction(f"{float(number):.15g}")):
        if float(reading) == number:
            return reading
    return exact


def rational_distribution(probabilities: Iterable[float]) -> list[Fraction]:
    """The fractions that the doubles of a distribution stand for; their sum is one.

    >>> rational_distribution([0.3, 0.7])
    [Fraction(3, 10), Fraction(7, 10)]
    """
    doubles = [float(x) for x in probabilities]
    readings = [rational(x) for x in doubles]
    if sum(readings) == 1:
        return readings
    exact = [Fraction(x) for x in doubles]
    total = sum(exact)
    return [x / total for x in exact]
