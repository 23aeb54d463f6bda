from .graph_assumption import LeastProbability as LeastProbability
from .confidence_sets import (
    ConfidenceSets as ConfidenceSets,
    intervals_from_counts as intervals_from_counts,
)
