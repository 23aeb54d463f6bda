"""Files of other tools, format by format.

``jaxltl.read_model`` and ``jaxltl.write_model`` choose among the formats of models by a file's
name and beginning; here each has its own functions, with its options. Automata come in the Hanoi
format, games in its extended form and in that of PGSolver, logs as tables of text. What is named
here is imported when it is first used. Files have no derivatives; what is read of functions
(``read_parametric``) is differentiable in its parameters.
"""

import importlib
from typing import TYPE_CHECKING, Any

_MODULES = {
    "colored_world": "load_world read_world save_world write_world",
    "drn": "read_drn write_drn",
    "hoa": "read_hoa read_hoa_stream write_hoa",
    "hoa_game": "HoaGame read_hoa_game write_hoa_game",
    "learned_reward": "LearnedReward load_reward plan_in save_reward",
    "log": "read_labels read_log",
    "model_files": "read_model write_model",
    "npz": "read_npz write_npz",
    "parametric": "ParametricModel RationalFunction read_parametric",
    "pgsolver": "ParityGame objective_of read_pgsolver write_pgsolver",
    "prism_explicit": "read_prism write_prism",
    "reward_machine": "RewardMachine machine_reward read_reward_machine",
    "storm": "from_stormpy to_stormpy",
    "umb": "read_umb write_umb",
    "umb_sharded": "read_sharded",
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names.split()}

__all__ = sorted(_MODULE_OF)

if TYPE_CHECKING:
    from jaxltl.io.colored_world import load_world as load_world
    from jaxltl.io.colored_world import read_world as read_world
    from jaxltl.io.colored_world import save_world as save_world
    from jaxltl.io.colored_world import write_world as write_world
    from jaxltl.io.drn import read_drn as read_drn
    from jaxltl.io.drn import write_drn as write_drn
    from jaxltl.io.hoa import read_hoa as read_hoa
    from jaxltl.io.hoa import read_hoa_stream as read_hoa_stream
    from jaxltl.io.hoa import write_hoa as write_hoa
    from jaxltl.io.hoa_game import HoaGame as HoaGame
    from jaxltl.io.hoa_game import read_hoa_game as read_hoa_game
    from jaxltl.io.hoa_game import write_hoa_game as write_hoa_game
    from jaxltl.io.learned_reward import LearnedReward as LearnedReward
    from jaxltl.io.learned_reward import load_reward as load_reward
    from jaxltl.io.learned_reward import plan_in as plan_in
    from jaxltl.io.learned_reward import save_reward as save_reward
    from jaxltl.io.log import read_labels as read_labels
    from jaxltl.io.log import read_log as read_log
    from jaxltl.io.model_files import read_model as read_model
    from jaxltl.io.model_files import write_model as write_model
    from jaxltl.io.npz import read_npz as read_npz
    from jaxltl.io.npz import write_npz as write_npz
    from jaxltl.io.parametric import ParametricModel as ParametricModel
    from jaxltl.io.parametric import RationalFunction as RationalFunction
    from jaxltl.io.parametric import read_parametric as read_parametric
    from jaxltl.io.pgsolver import ParityGame as ParityGame
    from jaxltl.io.pgsolver import objective_of as objective_of
    from jaxltl.io.pgsolver import read_pgsolver as read_pgsolver
    from jaxltl.io.pgsolver import write_pgsolver as write_pgsolver
    from jaxltl.io.prism_explicit import read_prism as read_prism
    from jaxltl.io.prism_explicit import write_prism as write_prism
    from jaxltl.io.reward_machine import RewardMachine as RewardMachine
    from jaxltl.io.reward_machine import machine_reward as machine_reward
    from jaxltl.io.reward_machine import read_reward_machine as read_reward_machine
    from jaxltl.io.storm import from_stormpy as from_stormpy
    from jaxltl.io.storm import to_stormpy as to_stormpy
    from jaxltl.io.umb import read_umb as read_umb
    from jaxltl.io.umb import write_umb as write_umb
    from jaxltl.io.umb_sharded import read_sharded as read_sharded
else:

    def __getattr__(name: str) -> Any:
        if name not in __all__:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return getattr(importlib.import_module(f"{__name__}.{_MODULE_OF[name]}"), name)

    def __dir__() -> list[str]:
        return sorted({*globals(), *__all__})
