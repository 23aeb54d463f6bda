"""Files of other tools, format by format.

``jaxltl.read_model`` and ``jaxltl.write_model`` choose among the formats of models by a file's
name and beginning; here each has its own functions, with its options. Automata come in the Hanoi
format, games in its extended form and in that of PGSolver, logs as tables of text. What is named
here is imported when it is first used. Files have no derivatives; what is read of functions
(``read_parametric``) is differentiable in its parameters.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
