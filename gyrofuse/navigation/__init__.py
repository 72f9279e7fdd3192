"""Effect of noise models on navigation: strapdown navigation and a Kalman filter with GNSS, over simulated flights."""

from gyrofuse._base.deprecation import moved_names
from gyrofuse.navigation.emulation import Emulation, compare_filters
from gyrofuse.navigation.filter import FilterErrors, Gnss, InitialUncertainty, run_filter
from gyrofuse.navigation.sensors import UnitErrors
from gyrofuse.navigation.strapdown import State, navigate
from gyrofuse.navigation.trajectory import Trajectory, flight, read_trajectory

__all__ = [
    "Emulation",
    "FilterErrors",
    "Gnss",
    "InitialUncertainty",
    "State",
    "Trajectory",
    "UnitErrors",
    "compare_filters",
    "flight",
    "navigate",
    "read_trajectory",
    "run_filter",
]

__getattr__ = moved_names(
    __name__,
    {
        "Alignment": "gyrofuse.navigation.filter.InitialUncertainty",
        "Flown": "gyrofuse.navigation.filter.FilterErrors",
        "emulate": "gyrofuse.navigation.emulation.compare_filters",
        "fly": "gyrofuse.navigation.filter.run_filter",
    },
)
