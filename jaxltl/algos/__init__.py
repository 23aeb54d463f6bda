"""Learners: one module or package each, all with the same interface, and their shared parts.

A learner has ``Problem``, ``Hparams``, ``State`` and ``Metrics``; ``make_problem``, then
``train(key, problem, hparams, num_steps=...)``, or ``init``, ``step`` and ``run``; and
``policy(state, problem, hparams)``. Steps and runs support ``jit`` and ``vmap``; they are not
differentiable unless their documentation says so.

From demonstrations: ``mlirl``, ``todirl``, ``behavioral_cloning``; of tasks with unknown labels:
``grounding``. From interaction with a model:
``expected_sarsa``, ``maximin_q``, ``rmax``, ``interval_learning``. From interaction with a
simulator: ``ppo``, ``many_tasks``, ``cce``, ``trust_region``. Parameters of a parametric model:
``feasible``, ``regions``. Shared parts are in ``common``.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
