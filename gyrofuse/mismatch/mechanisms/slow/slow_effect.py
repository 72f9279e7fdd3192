"""Effects with one path for all sensors, each in its own size: what steps, warm-ups and temperature drifts share.

Held out are whitened differences of block means, which are independent: folds take them in turns. What a slow effect
does may all happen in one of them, so those that judge are turned such that every share of them sees the same part of
the effect. The other directions that come in are slow cosines: where the noise is stronger than thought, the shares
scatter more.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar, NamedTuple

import torch
from torch import Tensor

from gyrofuse.mismatch.decisions import NATS_AS_GOOD
from gyrofuse.mismatch.detectors.slow.estimates import Estimate, log_factors
from gyrofuse.mismatch.detectors.slow.hysteresis import strongest_relay
from gyrofuse.mismatch.detectors.slow.scans import Scan, SlowAnalysis, slow_analysis
from gyrofuse.mismatch.likelihoods.slow_noise import cosines
from gyrofuse.mismatch.likelihoods.slow_templates import SlowTemplates
from gyrofuse.mismatch.mechanisms import pictures
from gyrofuse.mismatch.mechanisms.finding_parts import Parameter
from gyrofuse.mismatch.mechanisms.mechanism import Finding, Mechanism, Rival
from gyrofuse.mismatch.signals.comparison import N_BLOCKS, Comparison, RecordingInfo, block_means
from gyrofuse.mismatch.signals.dims import Dims, OfSensors
from gyrofuse.mismatch.signals.folds import N_FOLDS, N_JUDGED, in_fold
from gyrofuse.mismatch.stats.limits import Z

_STRONG = 5e-4  # a slow effect leaves traces that look like another one: largest p value
_SHARES = N_JUDGED // N_FOLDS


@dataclass(frozen=True, eq=False)
class SlowEffect(Mechanism, SlowTemplates):
    """`x_i(t) = size_i path(t)`, and further paths of the same physics with sizes of their own.

    Attributes:
        size: Of the first path, `(sensor,)`; 0 in sensors that do not have it.
        log_factors: Of the slow noise beside it, `(sensor, part)`, against the simulation's: for weights.
    """

    likelihood: ClassVar[str] = "known paths"
    known_path: ClassVar[bool] = True
    additive: ClassVar[bool] = True
    size: OfSensors
    log_factors: Annotated[Tensor, Dims(("sensor", "part"))]

    @classmethod
    def of(cls, scan: Scan, rate: float, which: Sequence[int] | None = None) -> SlowEffect:
        """The best of a scan.

        Args:
            scan: Scan of the mechanism.
            rate: Hz.
            which: Positions of the sensors; those of the scan by default.
        """
        raise NotImplementedError

    @classmethod
    def owns(cls, scan: Scan) -> bool:
        """Whether the best of a scan under its name is of this form, where several forms share the name."""
        return True

    @classmethod
    def fit_in_place_of(cls, finding: Finding, comparison: Comparison) -> Rival | None:
        """Another path of the same sensors in the same noise."""
        scan, effect = slow_analysis(comparison).scan(cls.name), finding.effect
        if scan is None or not cls.owns(scan) or not isinstance(effect, SlowEffect):
            return None
        rival = cls.of(scan, comparison.info.rate, finding.sensors)
        return Rival(replace(rival, log_factors=effect.log_factors), scan.gain)

    @property
    def amplitudes(self) -> Tensor:
        return self.sizes

    @property
    def amplitude(self) -> Tensor:
        """How large it is said to be, `(sensor,)`, unit of `size`."""
        return self.size.abs()

    def with_amplitudes(self, amplitudes: Tensor) -> SlowEffect:
        return self.with_sizes(amplitudes)

    @property
    def sizes(self) -> Tensor:
        """Of each path, `(sensor, path)`."""
        return self.size[:, None]

    def with_sizes(self, sizes: Tensor) -> SlowEffect:
        """The same with other sizes `(sensor, path)`."""
        return replace(self, size=sizes[:, 0])

    def paths(self, n_samples: int, info: RecordingInfo) -> Tensor:
        """For sizes of one, `(path, time)`."""
        raise NotImplementedError

    def plot(self, comparison: Comparison, ax: pictures.Axes, *, sensor: int, fitted: bool) -> None:
        path = self._effect(comparison.n_samples, comparison.info)
        pictures.means_over_time(ax, comparison, sensor, path if fitted else None)

    def apply(self, signal: Tensor, info: RecordingInfo, generator: torch.Generator) -> Tensor:
        return signal + self._effect(signal.shape[-1], info)

    def remove(self, signal: Tensor, info: RecordingInfo) -> Tensor:
        return signal - self._effect(signal.shape[-1], info)

    def repair(self, comparison: Comparison, generator: torch.Generator) -> Comparison:
        return comparison.subtract(self._effect(comparison.n_samples, comparison.info))

    def fit_without(self, comparison: Comparison, fold: int) -> SlowEffect:
        """Sizes by generalised least squares without the whitened differences that the fold holds out."""
        y, paths, _ = self._whitened(comparison)
        kept = ~in_fold(y.shape[-1], fold)
        # A step may happen in what is held out: then its size is not determined.
        sizes = (torch.linalg.pinv(paths * kept[:, None]) @ (y * kept)[..., None])[..., 0]
        return self.with_sizes(torch.where(self.sizes != 0, sizes, 0.0))

    def held_out_scores(self, comparison: Comparison, fold: int) -> Tensor:
        y, paths, slow = self._whitened(comparison)
        judged = in_fold(y.shape[-1], fold)
        effect = paths @ self.sizes[..., None]  # (sensor, difference, 1)
        scale = self.sizes.norm(dim=-1).copysign(self.size)[:, None, None]
        directions = torch.cat([effect, scale * slow], -1)[:, judged].flatten(0, 1)
        length = directions[:, 0].norm() / math.sqrt(_SHARES)
        axes = torch.linalg.qr(directions).Q
        axes[:, 0] *= (axes[:, 0] @ directions[:, 0]).sign()
        shares = _hadamard(_SHARES) @ (axes.mT @ y[:, judged].flatten())
        return length * shares - length.square() / 2

    def score_difference_sd(self, own: Tensor, other: Mechanism, theirs: Tensor, comparison: Comparison) -> float:
        """Distance of two paths in units of the noise: a slow path has no blocks of its own, whose scatter would do."""
        if not isinstance(other, SlowEffect):
            return super().score_difference_sd(own, other, theirs, comparison)
        paths = [effect.remove(comparison.recording, comparison.info) for effect in (self, other)]
        covariance = slow_analysis(comparison).noise.covariance(self.log_factors).diff(dim=-1).diff(dim=-2)
        difference = block_means(paths[0] - paths[1]).diff()[..., None]
        return float(torch.linalg.solve_triangular(torch.linalg.cholesky(covariance), difference, upper=False).norm())

    def as_compared(self, comparison: Comparison) -> SlowEffect:
        """The same with the noise that a case has once its mechanism is explained there, without any doubt of that."""
        scan = slow_analysis(comparison).scan(self.name)
        return self if scan is None else replace(self, log_factors=scan.fit.log_factors)

    def is_seen(self, comparison: Comparison) -> bool:
        """Whether noise that was found later, as slow as it is, leaves it as unlikely."""
        analysis = slow_analysis(comparison)
        scan = analysis.scan(self.name)
        if scan is None:
            return False
        return scan.p_value <= _STRONG or (scan.family.jumps and analysis.several_steps is not None)

    def _whitened(self, comparison: Comparison) -> tuple[Tensor, Tensor, Tensor]:
        """Whitened differences of block means: of the data `(sensor, difference)`, of paths and of slow cosines.

        Those are `(sensor, difference, path)`, and `(sensor, difference, _SHARES - 1)`.
        """
        covariance = slow_analysis(comparison).noise.covariance(self.log_factors).diff(dim=-1).diff(dim=-2)
        paths = block_means(self.paths(comparison.n_samples, comparison.info))
        directions = torch.cat([paths, cosines()[: _SHARES - 1]])
        y = block_means(comparison.observed.steady[0])
        both = torch.cat([y[:, None], directions.expand(len(y), -1, -1)], 1).diff().mT
        root = torch.linalg.cholesky(covariance)
        white = torch.linalg.solve_triangular(root, both, upper=False)
        return white[..., 0], white[..., 1 : 1 + len(paths)], white[..., 1 + len(paths) :]

    def _effect(self, n_samples: int, info: RecordingInfo) -> Tensor:
        return self.sizes @ self.paths(n_samples, info)


class Strong(NamedTuple):
    """A scan that may be named.

    Attributes:
        analysis: What it is part of.
        scan: Scan of the mechanism.
        alternatives: Mechanisms that fit as well.
        log_factors: Of the slow noise beside it, with what else is there, `(sensor, part)`: for weights.
    """

    analysis: SlowAnalysis
    scan: Scan
    alternatives: tuple[str, ...]
    log_factors: Tensor


def strong_scan(comparison: Comparison, name: str, level: float) -> Strong | None:
    """The scan of a mechanism and its equals; None where it is not there, or where another one is better.

    A stronger random walk than the simulation's is one of them, under the name of what changes numbers. Where a relay
    that a temperature switches fits as well, it may be nothing that has a name here.
    """
    analysis = slow_analysis(comparison)
    scan = analysis.scan(name)
    several = analysis.several_steps if scan is not None and scan.family.jumps else None
    if scan is None or (several is None and scan.p_value > min(level, _STRONG)):
        return None
    rivals = {other.family.name: other.gain for other in analysis.scans if other is not scan}
    rivals["parameter_shift"] = analysis.wandering
    relay, strong = strongest_relay(comparison), Strong(analysis, scan, (), log_factors(scan))
    if relay is not None and relay.gain_beside(scan.relation) > scan.gain - NATS_AS_GOOD:
        return None
    if several is not None and several.gain > max(rivals.values()) + NATS_AS_GOOD:
        # Each is lost among the others, as in a walk: beside them it is the step that it is.
        first = several.first.scan(name)
        assert first is not None
        strong = strong._replace(analysis=several.first, scan=first)
    elif any(gain > scan.gain + NATS_AS_GOOD for gain in rivals.values()):
        return None
    else:
        longer = {other.family.name for other in analysis.scans if other.family.becomes == name}
        equals = [r for r, gain in rivals.items() if gain > scan.gain - NATS_AS_GOOD and r not in longer]
        strong = strong._replace(alternatives=tuple(equals))
    return strong if strong.scan.p_value <= min(level, _STRONG) else None


def in_seconds(samples: tuple[float, float, float], rate: float) -> Parameter:
    """A number of samples with its limits, in seconds."""
    value, low, high = samples
    return Parameter(value / rate, low / rate, high / rate, "s")


def slow_finding(
    comparison: Comparison,
    strong: Strong,
    effect: SlowEffect,
    found: Estimate,
    words: str,
    numbers: dict[str, Parameter],
    *,
    sizes: Sequence[tuple[str, str]] = (),
    time_s: float | None = None,
    channel: str | None = None,
) -> Finding:
    """A finding made of a scan.

    Args:
        comparison: Where it was found.
        strong: The scan.
        effect: Mechanism with its numbers.
        found: Its sizes.
        words: What the bias does.
        numbers: Onset, time constants or lag.
        sizes: Names and units of the sizes of its paths; by default that of one, in the unit of the signal.
        time_s: Onset.
        channel: That it follows.
    """
    info = comparison.info
    scan, sizes = strong.scan, sizes or [("size", info.measure)]
    which, of = scan.sensors, sizes[0][0]
    limits = {}
    for path, (name, unit) in enumerate(sizes[: found.size.shape[-1]]):
        for i in which:
            value, reach = float(effect.sizes[i, path]), Z * float(found.sd[i, path])
            limits[f"{name}[{i}]"] = Parameter.around(value, reach, unit)
    up_to, article = effect.amplitude, "an" if of[0] in "aeiou" else "a"
    largest = max(which, key=lambda i: float(up_to[i]))
    # A block is no more than half a wavelet there.
    levels = range(int(math.log2(comparison.n_samples / N_BLOCKS)) + 1, int(math.log2(comparison.n_samples)) + 1)
    return effect.found(
        f"the bias of {info.named(which)} {words}, with {article} {of} of up to "
        f"{float(up_to[largest]):.3g} {sizes[0][1]} (sensor {info.sensors[largest]})",
        scan.p_value,
        which,
        {**numbers, **limits},
        levels=tuple(levels),
        alternatives=strong.alternatives,
        time_s=time_s,
        channel=channel,
        gain=scan.gain,
    )


def _hadamard(n: int) -> Tensor:
    """Orthogonal with entries of one size, all positive in the first column; `n` is a power of two."""
    matrix = torch.ones(1, 1, dtype=torch.float64)
    while len(matrix) < n:
        matrix = torch.cat([torch.cat([matrix, matrix], 1), torch.cat([matrix, -matrix], 1)]) / math.sqrt(2)
    return matrix
