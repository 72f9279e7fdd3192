"""Digital filters of every design, at the output rate: low-pass, high-pass and band-stop filters."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import signal as sps

from .bench import Bench, Part, quantity
from .likelihood import comparison, grid, solve
from .spectral import coloured

Array = NDArray[np.float64]
_MEMORY = 4096  # samples: of the slowest filter, whose corner is 0.003 of the rate, after which nothing is left
FLOOR = 1e-9  # of a filter's squared gain: what it stops leaks in from elsewhere, and cannot be told from nothing


Taps = tuple[Array, Array]


def _average(corner: float) -> Taps:
    """Mean of the last samples, whose number need not be whole; its half-power corner is about 0.443 over it."""
    length = 0.443 / corner
    taps = np.append(np.ones(int(length)), length - int(length))
    return taps / taps.sum(), np.ones(1)


def _pole(corner: float) -> Taps:
    """Exponential smoothing."""
    keep = math.exp(-2 * math.pi * corner)
    return np.array([1 - keep]), np.array([1.0, -keep])


class Design(NamedTuple):
    """A filter by its corner in cycles per sample, a band-stop filter by its width.

    Attributes:
        taps: Numerator and denominator by the corner, or `sections` of second order.
        lowest, highest: Corners that it can have.
    """

    lowest: float
    highest: float
    taps: Callable[[float], Taps] | None = None
    sections: Callable[[float], Array] | None = None

    def power(self, corner: float, f: Array) -> Array:
        """Squared gain at `f` cycles per sample."""
        at = 2 * np.pi * f
        if self.sections:
            return np.abs(sps.sosfreqz(self.sections(corner), worN=at)[1]) ** 2
        assert self.taps
        return np.abs(sps.freqz(*self.taps(corner), worN=at)[1]) ** 2

    def apply(self, corner: float, signal: Array) -> Array:
        """A filter that has run for long when the record begins: over its mirrored beginning first."""
        before = min(_MEMORY, signal.shape[-1] - 1)
        whole = np.concatenate([signal[..., before:0:-1], signal], axis=-1)
        start = whole[..., :1]
        if self.sections:
            filtered = sps.sosfilt(self.sections(corner), whole - start, axis=-1)
        else:
            assert self.taps
            filtered = sps.lfilter(*self.taps(corner), whole - start, axis=-1)
        rest = math.sqrt(self.power(corner, np.zeros(1))[0])
        return (filtered + rest * start)[..., before:]


def _by_sections(design: Callable[..., Array], *given: float, lowest: float = 0.003, **options: str) -> Design:
    return Design(lowest, 0.495, sections=lambda corner: design(*given, 2 * corner, output="sos", **options))


DESIGNS: dict[str, Design] = {
    **{f"butterworth {n}": _by_sections(sps.butter, n) for n in (1, 3, 4, 6)},
    **{f"bessel {n}": _by_sections(sps.bessel, n, norm="mag") for n in (2, 3, 4)},
    "chebyshev 4": _by_sections(sps.cheby1, 4, 0.5),
    "elliptic 4": _by_sections(sps.ellip, 4, 0.5, 50),
    "average": Design(0.01, 0.44, taps=_average),
    "one pole": Design(0.003, 0.6, taps=_pole),
    **{
        f"windowed {n}": Design(1 / n, 0.48, taps=lambda c, n=n: (sps.firwin(n, 2 * c), np.ones(1)))  # type: ignore[misc]
        for n in (15, 21, 31)
    },
}
HIGH_PASSES: dict[str, Design] = {
    **{f"butterworth {n}": _by_sections(sps.butter, n, lowest=1e-4, btype="highpass") for n in (1, 2, 3)},
    "bessel 2": _by_sections(sps.bessel, 2, lowest=1e-4, btype="highpass", norm="mag"),
    "chebyshev 4": _by_sections(sps.cheby1, 4, 0.5, lowest=1e-4, btype="highpass"),
    "windowed": Design(1 / 101, 0.48, taps=lambda c: (sps.firwin(101, 2 * c, pass_zero=False), np.ones(1))),
}
BUTTERWORTH = ("butterworth 1", "butterworth 2")


def low_pass(bench: Bench, nats: float, *, design: str | None = None) -> Part:
    """A digital filter at the output rate, of any design, in the sensor's own processor: on all that it puts out."""
    name = str(bench.rng.choice(list(DESIGNS))) if design is None else design
    return _filtered(bench, nats, "low_pass", name, DESIGNS[name])


def high_pass(bench: Bench, nats: float, *, designs: tuple[str, ...] = tuple(HIGH_PASSES)) -> Part:
    """The same that takes off what is slow, bias and walk."""
    name = str(bench.rng.choice(designs))
    part = _filtered(bench, nats, "high_pass", name, HIGH_PASSES[name], falling=False)
    return replace(part, form=None) if designs == BUTTERWORTH else part


def band_stop(bench: Bench, nats: float) -> Part:
    """The same that takes out a band, by its width."""
    centre = float(bench.rng.uniform(0.12, 0.3))
    name, made = _BAND_STOPS[int(bench.rng.integers(len(_BAND_STOPS)))]
    part = _filtered(bench, nats, "notch", name, made(centre), falling=False)
    return replace(part, frequency_hz=centre * bench.rate, parameters={})


def _stop_by_sections(design: Callable[..., Array], *given: float) -> Callable[[float], Design]:
    def at(centre: float) -> Design:
        def sections(width: float) -> Array:
            return design(*given, [2 * centre - width, 2 * centre + width], btype="bandstop", output="sos")

        return Design(0.002, 0.22, sections=sections)

    return at


def _windowed_stop(centre: float) -> Design:
    def taps(width: float) -> Taps:
        return sps.firwin(151, [2 * centre - width, 2 * centre + width]), np.ones(1)

    return Design(0.02, 0.22, taps=taps)


_BAND_STOPS: tuple[tuple[str, Callable[[float], Design]], ...] = (
    *((f"butterworth {n}", _stop_by_sections(sps.butter, n)) for n in (1, 2, 3)),
    ("elliptic 3", _stop_by_sections(sps.ellip, 3, 0.5, 40)),
    ("windowed", _windowed_stop),
)


def _filtered(bench: Bench, nats: float, mechanism: str, name: str, made: Design, *, falling: bool = True) -> Part:
    """A filter whose effect grows as its corner falls, or rises."""
    sensors = bench.some_sensors()
    chosen = np.isin(np.arange(bench.n_sensors), sensors)[:, None]
    f, power_of = grid(bench.n), -1.0 if falling else 1.0

    def spectrum(corner: float) -> Array:
        power = np.maximum(made.power(corner, f), FLOOR)
        return np.where(chosen, bench.spectrum * power, bench.spectrum)

    def worth(size: float) -> Array:
        return comparison(spectrum(size**power_of), bench.spectrum, bench.share)

    size = solve(nats, lambda x: float(worth(x).sum()), *sorted(c**power_of for c in (made.lowest, made.highest)))
    corner = size**power_of
    after, below = spectrum(corner), f[made.power(corner, f) < 0.5]
    half = float(below.min(initial=0.5) if falling else below.max(initial=f[0])) * bench.rate
    return coloured(
        bench,
        mechanism,
        nats,
        after,
        sensors,
        worth(size),
        converter=lambda x: np.where(chosen, made.apply(corner, x), x),
        look_alikes=("parameter_shift",) if bench.looks_like_parameters(after) else (),
        frequency_hz=half,
        parameters={"corner": quantity(half, "Hz")},
        form=name,
    )
