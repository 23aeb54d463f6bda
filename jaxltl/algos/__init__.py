"""Learners: one module or package each, all with the same interface, and their shared parts.

A learner has ``Problem``, ``Hparams``, ``State`` and ``Metrics``; ``make_problem``, then
``train(key, problem, hparams, num_steps=...)``, or ``init``, ``step`` and ``run``; and
``policy(state, problem, hparams)``. Steps and runs support ``jit`` and ``vmap``; they are not
differentiable unless their documentation says so.

``dir(jaxltl.algos)`` lists them; the page "Which function to use" helps to choose one. Shared parts are
in ``common``.
"""

from jaxltl.core.lazy import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
