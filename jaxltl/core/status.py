"""Status of solvers and learners."""

import enum


class Status(enum.IntEnum):
    """Status of a solver or a learner, ordered by severity; one code per lane under ``vmap``.

    - ``CONVERGED``: certified; the bounds are as narrow as the tolerance.
    - ``COMPLETED``: a learner's numbers are finite, or its stopping condition holds; no claim of
      optimality.
    - ``UNCERTIFIED``: the residual is below the tolerance, but no bound on the error is known.
    - ``PRECISION``: rounding errors alone keep the bounds wider than the tolerance.
    - ``MAX_STEPS``: stopped by `max_steps`, or without further progress.
    - ``NONFINITE``: NaN or infinity where a number should be.
    - ``INVALID``: an argument is invalid. Concrete invalid arguments raise ValueError, so this and
      the next occur inside ``jit`` only.
    - ``INVALID_POLICY``: a policy is not a distribution over available actions.
    - ``INVALID_DISCOUNT``: a discount is out of range.
    - ``INVALID_OPTION``: a tolerance or a number of steps is out of range.

    Example:
      >>> [status.name for status in Status if Status.MAX_STEPS < status <= Status.INVALID]
      ['NONFINITE', 'INVALID']
    """

    CONVERGED = 0
    COMPLETED = 1
    UNCERTIFIED = 2
    PRECISION = 3
    MAX_STEPS = 4
    NONFINITE = 5
    INVALID = 6
    INVALID_POLICY = 7
    INVALID_DISCOUNT = 8
    INVALID_OPTION = 9
