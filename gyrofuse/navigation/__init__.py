"""What error models cost in position and attitude: flights, strapdown navigation and a filter with GNSS."""

from gyrofuse.navigation.emulation import Emulation, emulate
from gyrofuse.navigation.filter import Alignment, Flown, Gnss, fly
from gyrofuse.navigation.sensors import UnitErrors
from gyrofuse.navigation.strapdown import State, navigate
from gyrofuse.navigation.trajectory import Trajectory, flight, read_trajectory

__all__ = [
    "Alignment",
    "Emulation",
    "Flown",
    "Gnss",
    "State",
    "Trajectory",
    "UnitErrors",
    "emulate",
    "flight",
    "fly",
    "navigate",
    "read_trajectory",
]
