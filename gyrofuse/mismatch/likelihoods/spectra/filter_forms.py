"""Low-pass filters by their form and one number: digital ones, analogue ones as sampling leaves them, averages.

A form is an analogue prototype `H(u)` that halves the power at `u = 1`, of a warped frequency `u = g(f) / g(f_c)`: `g =
tan(pi f)` of the bilinear transform, or `g = 2 f` of an analogue filter in front of the converter, whose noise beyond
half the rate is folded back: `sum_k |H(g(f + k) / g(f_c))|^2` over its value at 0. A Gaussian window cuts a FIR
filter's ideal step off smoothly; pass bands with ripples have half a decibel of them; two poles that are damped less
than Butterworth's let more pass where they resonate. Beside those stand one and two poles `(1 - q) / (1 - q / z)`, the
mean over `a` samples, the last of which counts in part, and what sampling leaves of analogue means over `a` samples,
`sum_k sinc(a (f + k))^2m` over its value at 0: one mean, as of a converter that integrates, or two in a row, which
weigh in a triangle.
"""

from __future__ import annotations

import cmath
import functools
import math
from typing import NamedTuple

import torch
from scipy import signal
from torch import Tensor


class _Form(NamedTuple):
    """A prototype under a warp.

    Attributes:
        warp: "tan" or "straight".
        prototype: "butterworth", "bessel", "chebyshev", "damped", "window", or "folded" (Butterworth's with aliases).
        order: Of all but the last.
        width: Of a window's step, standard deviation over its middle; the damping ratio
            of two "damped" poles; decibels of a Chebyshev filter's ripple.
        power: Of `g(f_c)^-2` that `strength` is.
    """

    warp: str
    prototype: str
    order: int = 1
    width: float = 0.0
    power: int = 1


_FORMS = {
    "bilinear": _Form("tan", "butterworth"),
    "sampled": _Form("straight", "butterworth"),
    "bilinear2": _Form("tan", "butterworth", 2, power=2),
    "sampled2": _Form("straight", "butterworth", 2, power=2),
    **{f"bilinear{n}": _Form("tan", "butterworth", n) for n in (3, 4)},
    **{f"bessel{n}": _Form("tan", "bessel", n) for n in (2, 3, 4)},
    **{f"chebyshev4{more}": _Form("tan", "chebyshev", 4, width=w) for more, w in (("", 0.5), ("_3dB", 3.0))},
    # A suspension, or a filter that rings: damping ratios a factor of 1.2 apart, of which Butterworth's is 0.71.
    **{f"damped{k}": _Form("tan", "damped", 2, width=0.5 / 1.2**k) for k in range(10)},
    **{f"analogue{n}": _Form("straight", "folded", n, power=2) for n in (2, 4)},
    # Widths a factor of 1.6 apart: Hamming windows of 11 to 61 taps at a cutoff of a fifth of the rate.
    **{f"window{k}": _Form("straight", "window", width=0.08 * 1.6**k) for k in range(4)},
}
_POLES = {"pole": 1.0, "poles": math.sqrt(2) - 1}
_SAMPLED_MEANS = {"integrated": 1, "integrated2": 2}  # analogue means in a row
_MEANS = {"average": 1, **_SAMPLED_MEANS}
FILTERS = ("pole", "poles", *_MEANS, *_FORMS)
UNDONE = ("bilinear2", "sampled2", "bilinear4")  # of one pole it is what differences add
_HALVINGS = 60  # of an interval: double precision
_LONGEST = 0.9999  # pole: of a time constant of 10^4 samples


def filter_strength(kind: str, corner: Tensor) -> Tensor:
    """Number of a filter whose power is halved at `corner` cycles per sample, before aliases come: 0 is none."""
    if kind in _POLES:
        return strength_of(kind, torch.sin(math.pi * corner).log())
    if kind in _MEANS:  # a longer mean passes less, until its first zero
        none = float(kind not in _SAMPLED_MEANS)  # length at which it does nothing
        low, high = torch.ones_like(corner), 1 / corner
        for _ in range(_HALVINGS):
            middle = (low + high) / 2
            more = filter_power(kind, middle.square() - none, corner[..., None])[..., 0] > 0.5
            low, high = torch.where(more, middle, low), torch.where(more, high, middle)
        return low.square() - none
    number = _warped(kind, corner).log()
    if _FORMS[kind].prototype == "window":  # its image lets a little more pass
        low, high = number - 1, number + 1
        for _ in range(_HALVINGS):
            number = (low + high) / 2
            more = filter_power(kind, strength_of(kind, number), corner[..., None])[..., 0] > 0.5
            low, high = torch.where(more, low, number), torch.where(more, number, high)
    return strength_of(kind, number)


def filter_corner(kind: str, strength: Tensor) -> Tensor:
    """Cycles per sample at which a filter halves the power, before aliases come; infinite where it never does."""
    if kind in _FORMS and _FORMS[kind].prototype != "window":
        form = _FORMS[kind]
        g = strength.clamp(min=1e-300).pow(-1 / (2 * form.power))
        return torch.atan(g) / math.pi if form.warp == "tan" else g / 2
    if kind in _POLES:
        g = filter_number(kind, strength).exp()
        return torch.where(g <= 1, g.clamp(max=1).asin() / math.pi, math.inf)
    # Before a mean's first zero.
    highest = 1 / (1 + strength).sqrt() if kind in _MEANS else torch.ones_like(strength)
    low, high = torch.zeros_like(strength), highest.clamp(max=0.5)
    falls = filter_power(kind, strength, high[..., None])[..., 0] < 0.5
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        more = filter_power(kind, strength, middle[..., None])[..., 0] > 0.5
        low, high = torch.where(more, middle, low), torch.where(more, high, middle)
    return torch.where(falls, low, math.inf)


def filter_number(kind: str, strength: Tensor) -> Tensor:
    """`log g(f_c)`, of which spectra tell about as much wherever the corner lies; of no filter it is large."""
    q = strength.clamp(min=1e-300)
    if kind in _POLES:  # power 1 / (1 + x sin^2), once or twice
        return -(4 * q / (1 - q).square() / _POLES[kind]).log() / 2
    if kind in _MEANS:  # power 1 - (a^2 - 1) (pi f)^2 / 3 at first, of analogue ones 1 - m (a pi f)^2 / 3
        return -(_MEANS[kind] * q / 3).log() / 2
    return -q.log() / (2 * _FORMS[kind].power)


def strength_of(kind: str, number: Tensor) -> Tensor:
    """Strength of a filter whose `log g(f_c)` is `number`."""
    if kind in _POLES:
        b = 1 + 2 * torch.exp(2 * number) / _POLES[kind]
        return b - (b.square() - 1).sqrt()
    if kind in _MEANS:
        return 3 / _MEANS[kind] * torch.exp(-2 * number)
    if _FORMS[kind].prototype == "chebyshev":  # corners above 0.495 of the rate would be another level of everything
        number = number.clamp(max=math.log(math.tan(math.pi * 0.495)))
    return torch.exp(-2 * _FORMS[kind].power * number)


def filter_power(kind: str, strength: Tensor, f: Tensor) -> Tensor:
    """Squared response `(..., frequency)` of filters of `strength` `(...,)`."""
    if kind in _POLES:
        q = strength[..., None].clamp(max=_LONGEST)
        power = (1 - q).square() / ((1 - q).square() + 4 * q * torch.sin(math.pi * f).square())
        return power if kind == "pole" else power.square()
    if kind in _SAMPLED_MEANS:
        a, folded = strength[..., None].clamp(min=0).sqrt(), _one_mean if kind == "integrated" else _two_means
        return folded(a, f) / folded(a, torch.zeros_like(f[..., :1]))
    if kind in _FORMS and _FORMS[kind].prototype == "butterworth":
        return 1 / (1 + _prototype_frequency(kind, strength, f).pow(2 * _FORMS[kind].order))
    if kind in _FORMS and _FORMS[kind].prototype == "folded":
        return _folded(kind, strength, f) / _folded(kind, strength, torch.zeros_like(f[..., :1]))
    return filter_response(kind, strength, f).abs().square()


def _folded(kind: str, strength: Tensor, f: Tensor) -> Tensor:
    """Power of an analogue filter with what is folded back from three rates to either side."""
    images = range(-3, 4)
    powers = [1 / (1 + _prototype_frequency(kind, strength, (f + k).abs()).pow(2 * _FORMS[kind].order)) for k in images]
    return sum(powers, torch.zeros_like(powers[0]))


def _one_mean(a: Tensor, f: Tensor) -> Tensor:
    """`sum_k sinc(a (f + k))^2`, by Poisson's formula `sum_n (1 - n / a) cos(2 pi f n) / a` over all `-a < n < a`."""
    last, half = a.ceil() - 1, math.pi * f
    rise = torch.sin(half)
    near = rise.abs() < 1e-9
    over = 1 / torch.where(near, 1.0, rise)
    alike = torch.where(near, 2 * last + 1, torch.sin((2 * last + 1) * half) * over)
    weighed = torch.where(near, last, torch.sin(last * half) * over).square()
    share = (last / a.clamp(min=1e-300)).nan_to_num()
    folded = ((1 - share) * alike + weighed / a.clamp(min=1e-300)) / a.clamp(min=1e-300)
    return torch.where(a <= 1, 1.0, folded.clamp(min=0))


def _two_means(a: Tensor, f: Tensor) -> Tensor:
    """`sum_k sinc(a (f + k))^4`; of seven images to either side the rest is less than a hundredth of the lobes."""
    images, turn = 7, math.pi * a
    sine, cosine = torch.sin(turn * f), torch.cos(turn * f)
    total = torch.zeros_like(turn * f)
    for k in range(-images, images + 1):
        x = turn * (f + k)
        near = x.abs() < 1e-9
        lobe = torch.where(
            near, 1.0, (sine * torch.cos(turn * k) + cosine * torch.sin(turn * k)) / torch.where(near, 1.0, x)
        )
        total += lobe.square().square()
    return total


def filter_response(kind: str, strength: Tensor, f: Tensor) -> Tensor:
    """Complex response `(..., frequency)`; causal but for windows and analogue means, which are without their delay."""
    if kind in _POLES:
        q = strength[..., None].clamp(max=_LONGEST)
        turn = 2 * math.pi * f
        response = (1 - q) / (1 - q * torch.polar(torch.ones_like(turn), -turn))
        return response if kind == "pole" else response.square()
    if kind in _SAMPLED_MEANS or (kind in _FORMS and _FORMS[kind].prototype == "folded"):
        ends = filter_power(kind, strength, f).sqrt()
        return torch.complex(ends, torch.zeros_like(ends))
    if kind == "average":
        a = (1 + strength[..., None]).sqrt()
        n, x = a.floor(), math.pi * f.clamp(min=1e-12)
        one = torch.ones_like(a * x)
        # Of the last sample a part, where their number is not whole.
        added = torch.polar(one, -(n - 1) * x) * (torch.sin(n * x) / torch.sin(x))
        return (added + (a - n) * torch.polar(one, -2 * n * x)) / a
    form, u = _FORMS[kind], _prototype_frequency(kind, strength, f)
    if form.prototype == "window":
        middle, whole = _window(form.width)
        x, rate = (v / middle for v in (u, _prototype_frequency(kind, strength, torch.ones_like(f[..., :1]))))
        # A digital response repeats itself: next to half the rate that of the image's step is added.
        ends = sum((_step(x + k * rate, form.width) for k in (-1, 0, 1)), torch.zeros_like(x))
        ends = (ends / whole).clamp(max=1)  # a pass band that reaches half the rate leaves no step
        return torch.complex(ends, torch.zeros_like(ends))
    response = torch.ones_like(u, dtype=torch.complex128)
    if form.prototype == "chebyshev":
        response = torch.where(strength[..., None] > 0, _at_rest(form), 1.0) * response
    for pole in _poles(form):
        response = response * (-pole) / (1j * u - pole)
    return response


def _step(x: Tensor, width: float) -> Tensor:
    """What a window leaves of an ideal filter's pass band, from -1 to 1."""
    return torch.special.ndtr((1 - x) / width) - torch.special.ndtr((-1 - x) / width)


def _warped(kind: str, f: Tensor) -> Tensor:
    return torch.tan(math.pi * f.clamp(max=0.49999999)) if _FORMS[kind].warp == "tan" else 2 * f


def _prototype_frequency(kind: str, strength: Tensor, f: Tensor) -> Tensor:
    """`u`, `(..., frequency)`."""
    return _warped(kind, f) * strength[..., None].clamp(min=0).pow(1 / (2 * _FORMS[kind].power))


@functools.lru_cache(maxsize=32)
def _poles(form: _Form) -> tuple[complex, ...]:
    """Of a prototype that halves the power at one."""
    if form.prototype == "damped":  # 1 / (1 - x^2 + 2 i d x), of power 1/2 at x^2 = 1 - 2 d^2 + sqrt((1 - 2 d^2)^2 + 1)
        most = 1 - 2 * form.width**2
        half = math.sqrt(most + math.hypot(most, 1))
        angle = math.acos(form.width)
        return tuple(-cmath.rect(1 / half, sign * angle) for sign in (-1, 1))
    if form.prototype == "bessel":
        return tuple(complex(p) for p in signal.bessel(form.order, 1.0, analog=True, output="zpk", norm="mag")[1])
    if form.prototype == "chebyshev":
        poles = signal.cheby1(form.order, form.width, 1.0, analog=True, output="zpk")[1]
        ripple = math.sqrt(10 ** (form.width / 10) - 1)
        # With ripples of more than halves it is within them that the power is halved, next to the last of all.
        half = math.cosh(math.acosh(max(1 / ripple, 1.0)) / form.order)
        return tuple(complex(p) / half for p in poles)
    return butterworth_poles(form.order)


def order_of(kind: str) -> int:
    """Order of a Butterworth filter by its form: "bilinear" and "sampled" are of the first."""
    return int(kind.lstrip("abcdefghijklmnopqrstuvwxyz") or 1)


@functools.lru_cache(maxsize=16)
def butterworth_poles(order: int) -> tuple[complex, ...]:
    """Of Butterworth's analogue prototype, which halves the power at one."""
    return tuple(complex(p) for p in signal.butter(order, 1.0, analog=True, output="zpk")[1])


def stopped(taken: Tensor, through: Tensor, depth: float | Tensor, order: int) -> Tensor:
    """Complex response of a Butterworth filter that stops what lies at large `s = taken / through`.

    Args:
        taken, through: Of each frequency; where `through` is zero all is stopped.
        depth: What it keeps from passing there, nepers.
        order: Number of its poles.
    """
    left = taken * torch.exp(-torch.as_tensor(depth, dtype=torch.float64) / order)
    response = torch.ones_like(left)
    for pole in butterworth_poles(order):
        response = response * (left - pole * through) / (taken - pole * through)
    return response


def _at_rest(form: _Form) -> float:
    """Response with ripples at frequency 0: with an even number of poles they start from below."""
    return 1.0 if form.order % 2 else 10 ** (-form.width / 20)


@functools.lru_cache(maxsize=16)
def _window(width: float) -> tuple[float, float]:
    """Middle of the step of a filter that halves the power at one, and its response at 0 before it is made one."""
    whole = math.erf(1 / width / math.sqrt(2))

    def response(x: float) -> float:
        return (math.erf((1 - x) / width / math.sqrt(2)) + math.erf((1 + x) / width / math.sqrt(2))) / 2 / whole

    low, high = 0.0, 1.0 + width
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        low, high = (middle, high) if response(middle) > math.sqrt(0.5) else (low, middle)
    return 1 / low, whole
