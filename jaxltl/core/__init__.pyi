from . import automata as automata
from . import environments as environments
from . import games as games
from . import graphs as graphs
from . import logic as logic
from . import models as models
from . import statistics as statistics
from . import values as values
