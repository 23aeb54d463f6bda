"""Transition counts from logs, confidence sets, and guarantees from data."""

from jaxltl.core.models.build.counts import (
    TransitionCounts as TransitionCounts,
    counted_model as counted_model,
    counts_on as counts_on,
    make_counts as make_counts,
)
from jaxltl.core.statistics.confidence_sets import (
    ConfidenceSets as ConfidenceSets,
    intervals_from_counts as intervals_from_counts,
)
from jaxltl.core.values.evaluation.data_guarantee import (
    DataGuarantee as DataGuarantee,
    guarantee_curve as guarantee_curve,
    learn_guarantee as learn_guarantee,
)
from jaxltl.io.log import read_labels as read_labels, read_log as read_log

__all__ = sorted(name for name in dir() if not name.startswith("_"))
