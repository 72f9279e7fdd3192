"""Virtual gyros from arrays: their weights, how certain these are, and which sensor disagrees with the others."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from gyrofuse.fusion.faults.reference import ParityReference
from gyrofuse.fusion.faults.result import ParityResult
from gyrofuse.fusion.multiscale_result import MultiScaleResult
from gyrofuse.fusion.result import SVOResult
from gyrofuse.fusion.uncertainty.tests import EnoughData, WeightsTest
from gyrofuse.fusion.uncertainty.variance_reduction import VarianceReduction
from gyrofuse.fusion.weights.baselines import shrinkage_weights
from gyrofuse.fusion.weights.rdvg import RDVGResult
from gyrofuse.fusion.weights.selection import Selection
from gyrofuse.fusion.weights.subsets import subset_weights

if TYPE_CHECKING:
    from gyrofuse.fusion.streaming import StreamedSVOResult

__all__ = [
    "EnoughData",
    "MultiScaleResult",
    "ParityReference",
    "ParityResult",
    "RDVGResult",
    "SVOResult",
    "Selection",
    "StreamedSVOResult",
    "VarianceReduction",
    "WeightsTest",
    "shrinkage_weights",
    "subset_weights",
]


def __getattr__(name: str) -> Any:
    if name == "StreamedSVOResult":  # its module loads torchmetrics
        return import_module("gyrofuse.fusion.streaming").StreamedSVOResult
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
