from .confidence_sets import (
    ConfidenceSets as ConfidenceSets,
    LeastProbability as LeastProbability,
    intervals_from_counts as intervals_from_counts,
)
