"""One noise model for several recordings of a sensor, and whether they agree on it."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from torch import Tensor

from gyrofuse._base.deprecation import RenamedAttribute
from gyrofuse._base.results import Result, scattered, sensor_label
from gyrofuse.fitting.gmwm import fit_gmwm
from gyrofuse.fitting.gmwm_result import GMWMResult
from gyrofuse.fitting.moments import search
from gyrofuse.fitting.moments.drift_sign import drifts_of, with_drift_sign
from gyrofuse.fitting.moments.fit import composition_of, fit_batch
from gyrofuse.fitting.moments.identifiability import notes
from gyrofuse.fitting.moments.inference import Fit, infer
from gyrofuse.fitting.moments.profile import profiled
from gyrofuse.fitting.moments.profile_objectives import MomentProfile
from gyrofuse.fitting.moments.records import SampleDesign
from gyrofuse.fitting.moments.white_kurtosis import white_excess_kurtosis, with_excess_kurtosis
from gyrofuse.fitting.spectral.model_tones import model_tones
from gyrofuse.fitting.structure import ModelStructure
from gyrofuse.io.recording import Recording
from gyrofuse.io.signals import as_recording
from gyrofuse.noise.processes import Model
from gyrofuse.wavelets.intervals import chi_square_tail

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# P value below which the recordings count as different: one in a hundred that agree does.
_DIFFERENT = 0.01


@dataclass(frozen=True, eq=False, repr=False)
class JointFit(Result):
    """One model for several recordings, beside those of each; `...` are the leading dimensions of the signals.

    Attributes:
        joint: Fit of one model to all recordings. Its J test is that of the pooled wavelet variances.
        separate: Fits of each recording alone.
        statistic: Objectives at the joint fit less those at the fits of each recording, `(..., sensor)`.
        dof: Degrees of freedom of the statistic, `(..., sensor)`: parameters of the joint fit that are not zero, once
            for each recording but one.
        p_value: P value of the test that all recordings have the same parameters, `(..., sensor)`.
        shift: Parameters of each recording less those of the joint fit, in standard errors of the recording's fit,
            `(recording, ..., sensor, parameter)`; NaN where a variance is zero.
    """

    joint: GMWMResult
    separate: tuple[GMWMResult, ...]
    statistic: Tensor
    dof: Tensor
    p_value: Tensor
    shift: Tensor

    degrees = RenamedAttribute("dof")
    _batched = ("joint", "statistic", "dof", "p_value")
    _keys: ClassVar = {"dof": "degrees"}

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Leading dimensions before the sensors; `()` for a single array."""
        return tuple(self.p_value.shape[:-1])

    def __getitem__(self, index: Any) -> JointFit:
        """One item, or some, of the leading batch dimensions."""
        one_by_one = (part[index] for part in self.shift)
        separate = tuple(one[index] for one in self.separate)
        return replace(super().__getitem__(index), separate=separate, shift=torch.stack(list(one_by_one)))

    @property
    def model(self) -> Model:
        """The one model."""
        return self.joint.model

    @property
    def n_samples(self) -> int:
        """Length of the recordings, all together."""
        return self.joint.n_samples

    @property
    def param_cov(self) -> Tensor:
        """Covariance of the one model's parameters, `(..., sensor, parameter, parameter)`."""
        return self.joint.param_cov

    def summary(self) -> str:
        """The verdict, and each parameter of every recording beside that of all, sensor by sensor."""
        lines = [
            f"Joint GMWM fit of {' + '.join(p.symbol for p in self.joint.model.processes)} to {len(self.separate)} "
            f"recordings of {', '.join(str(one.n_samples) for one in self.separate)} samples"
        ]
        for index in itertools.product(*map(range, self.p_value.shape)):
            head = f"sensor {sensor_label(self.joint.sensors, index, self.joint.axes)}"
            if not bool(self.p_value[index].isfinite()):
                lines += ["", f"{head}: not fitted"]
                continue
            lines += ["", f"{head}: {self._verdict(index)}"]
            names = ["joint", *(f"recording {r + 1}" for r in range(len(self.separate)))]
            lines.append(f"  {'parameter':<24}" + "".join(f"{name:>14}" for name in names) + "   largest shift")
            for k, name in enumerate(self.joint.param_names):
                values = [fit.params[index][k].item() for fit in (self.joint, *self.separate)]
                off = torch.stack([shift[index][k] for shift in self.shift])
                largest = "-" if bool(off.isnan().all()) else f"{off.abs().nan_to_num().max().item():.1f} sd"
                lines.append(f"  {name:<24}" + "".join(f"{value:>14.6g}" for value in values) + f"{largest:>16}")
        return "\n".join(lines)

    def _verdict(self, index: tuple[int, ...]) -> str:
        p = self.p_value[index].item()
        test_text = f"chi-square = {self.statistic[index].item():.4g}, {int(self.dof[index])} degrees, p = {p:.2g}"
        if p >= _DIFFERENT:
            return f"the recordings agree ({test_text})"
        return f"not stationary between the recordings ({test_text}); the joint fit is an average"

    def plot(self, ax: Axes | None = None, *, index: tuple[int, ...] | None = None) -> Axes:
        """Draw the joint fit of one sensor and the Allan deviations of the recordings.

        Args:
            ax: Axes to draw on; a new figure by default.
            index: Index of the sensor among the leading dimensions; the first by default.
        """
        from gyrofuse.fitting.plots import add_recordings

        index = (0,) * self.p_value.ndim if index is None else index
        ax = self.joint.plot(ax, index=index)
        add_recordings([one.wavelet_variance.mT[index] for one in self.separate], rate=self.joint.rate, ax=ax)
        return ax


def fit_gmwm_joint(
    recordings: Sequence[Tensor | Recording],
    model: Model | str,
    *,
    n_levels: int | None = None,
    confidence_level: float = 0.95,
) -> JointFit:
    """Fit one noise model to several recordings of the same sensors, and test whether they agree.

    The wavelet variances are pooled, each level weighted by its number of coefficients, and fitted with the covariance
    of that mean. If the recordings agree, fits of each recording with the weights of the joint fit lower the sum of the
    objectives by a chi-square variable with as many degrees of freedom as there are parameters, once for each recording
    but one. Where the J test rejects the model itself, the difference is too large as well.

    Args:
        recordings: List of at least two `(..., sensor, time)` or `Recording`s of the same sensors in the same unit at
            the same rate; their lengths may differ.
        model: As for `fit_gmwm`.
        n_levels: Largest number of levels of each; by default all that hold two non-overlapping windows in it.
        confidence_level: Probability that an interval holds the true value.

    Returns:
        The joint fit, those of each recording, and the test, for every sensor.

    Raises:
        TypeError: Recordings that are no tensors.
        ValueError: Fewer than two recordings, or recordings that differ in sensors, rate or unit.

    References:
        [V] section V, for the average of the objectives of several recordings; W. K. Newey, K. D. West, International
        Economic Review 28, 1987, for the difference of objectives.
    """
    signals = _checked(recordings)
    separate = tuple(fit_gmwm(one, model, n_levels=n_levels, confidence_level=confidence_level) for one in recordings)
    first = separate[0]
    records = SampleDesign(
        tuple(signal.shape[-1] for signal in signals), tuple(one.wavelet_variance.shape[-2] for one in separate)
    )
    structure = composition_of(model, held=True)
    apart = [one.wavelet_variance.mT.flatten(0, -2) for one in separate]  # (item, level) each
    usable = torch.stack([one.params.flatten(0, -2).isfinite().all(-1) for one in separate]).all(0)
    apart = [variance[usable] for variance in apart]
    nu = records.pooled(apart)
    frequencies, disagreement = _frequencies(separate, structure, usable)
    fit = fit_batch(nu, frequencies, records, structure, "optimal")
    inference = infer(fit, structure, confidence_level)
    inference = profiled(inference, MomentProfile(fit, structure), fit, structure, confidence_level)
    kappa = _excess_kurtosis(signals, usable, structure, inference.estimates.params)
    inference = with_excess_kurtosis(inference, kappa, structure, sum(records.lengths), confidence_level)

    model_of = Model(list(structure.processes))
    # The sign of a drift is that of the sum of the slopes of the recordings.
    every = torch.stack([one.params.flatten(0, -2)[usable] for one in separate]).sum(0)
    slopes = every[:, drifts_of(model_of)].sum(-1)
    sign = torch.where(slopes < 0, -1.0, 1.0).to(torch.float64)
    joint = GMWMResult.build(
        inference=replace(inference, estimates=with_drift_sign(inference.estimates, model_of, sign)),
        notes=notes(structure, inference.estimates, records.longest, confidence_level),
        structure=structure,
        usable=usable,
        wavelet_variance=scattered(nu, usable, (len(usable),)),
        batch=first.params.shape[:-1],
        records=records,
        weighting="optimal",
        refined=False,
        confidence_level=confidence_level,
        sensors=first.sensors,
        rate=first.rate,
        unit=first.unit,
    )
    difference = _difference(apart, fit, structure, kappa) + disagreement
    present = fit.linear > 0
    known = present.sum(-1) + present[:, structure.nonlinear].sum(-1)
    dof = ((len(signals) - 1) * known).to(difference)
    batch = first.params.shape[:-1]
    return JointFit(
        joint=joint,
        separate=separate,
        statistic=scattered(difference, usable, batch),
        dof=scattered(dof, usable, batch),
        p_value=scattered(chi_square_tail(difference, dof), usable, batch),
        shift=torch.stack([_shift(one, joint) for one in separate]),
    )


def _checked(recordings: Sequence[Tensor | Recording]) -> list[Tensor]:
    if isinstance(recordings, (Tensor, Recording)) or len(recordings) < 2:
        got = "one" if isinstance(recordings, (Tensor, Recording)) else str(len(recordings))
        raise ValueError(f"`recordings`: expected a list of at least two, got {got}; a single one is for fit_gmwm")
    signals = [as_recording(one, f"recordings[{i}]").values for i, one in enumerate(recordings)]
    for i, signal in enumerate(signals[1:], 1):
        if signal.shape[:-1] != signals[0].shape[:-1]:
            raise ValueError(
                f"`recordings`: expected the same sensors in all, got shape {tuple(signals[0].shape)} in the first and "
                f"{tuple(signal.shape)} in number {i}; only their lengths may differ"
            )
    known = [one for one in recordings if isinstance(one, Recording)]
    for name in ("rate", "unit"):
        values = list(dict.fromkeys(getattr(one, name) for one in known))
        if len(values) > 1:
            raise ValueError(
                f"`recordings`: expected one {name}, got {', '.join(map(str, values))}; convert or resample them first"
            )
    return signals


def _frequencies(
    separate: tuple[GMWMResult, ...], structure: ModelStructure, usable: Tensor
) -> tuple[tuple[Tensor, Tensor] | None, Tensor]:
    """Mean `beta` of the sinusoids over the recordings and its standard error, `(item, sinusoid)`, and a test of it.

    The test statistic, that the frequencies agree, is chi-square with one degree of freedom for each sinusoid and
    recording but one, `(item,)`.
    """
    names = [f"sinusoid_{k + 1}.beta" for k in range(sum(p.has_line for p in structure.processes))]
    if not names:
        return None, separate[0].params.new_zeros(int(usable.sum()))
    at = [separate[0].param_names.index(name) for name in names]
    beta = torch.stack([one.params.flatten(0, -2)[usable][:, at] for one in separate])  # (recording, item, sinusoid)
    variance = torch.stack([one.param_cov.diagonal(dim1=-2, dim2=-1).flatten(0, -2)[usable][:, at] for one in separate])
    weight = torch.where(variance > 0, 1 / variance, 0.0).nan_to_num()
    total = weight.sum(0)
    mean = torch.where(total > 0, (weight * beta).sum(0) / total, beta.mean(0))
    disagreement = (weight * (beta - mean).square()).sum((0, -1))
    return (mean, total.rsqrt()), disagreement


def _excess_kurtosis(signals: list[Tensor], usable: Tensor, structure: ModelStructure, params: Tensor) -> Tensor:
    """Excess kurtosis of the white noise of all recordings, `(item,)`: the mean weighted by their lengths.

    It is the same for all, as under the hypothesis of the test they have one noise.
    """
    lengths = [signal.shape[-1] for signal in signals]
    total = torch.zeros_like(params[:, 0])
    for signal, length in zip(signals, lengths, strict=True):
        series = signal.detach().reshape(-1, length)[usable]
        own = white_excess_kurtosis(series, model_tones(series, structure), structure, params)
        total = total + own * length / sum(lengths)
    return total


def _difference(apart: list[Tensor], fit: Fit, structure: ModelStructure, kappa: Tensor) -> Tensor:
    """Objectives of the recordings at the joint fit less those at the best of each, same weights, `(item,)`."""
    size = fit.variance.amax(-1, keepdim=True)
    linear = fit.linear / size
    total = torch.zeros_like(size[:, 0])
    covariances = fit.records.covariances(structure.model(linear, fit.shape), kappa)
    for variance, covariance in zip(apart, covariances, strict=True):
        nu, root = variance / size, search.whitening(covariance)
        tau = fit.tau[: nu.shape[-1]]
        residual = nu - structure.wavelet_variance(tau, linear, fit.shape)
        together = (root @ residual[..., None]).square().sum((-2, -1))
        _, _, alone, _ = search.minimise(nu, root, tau, structure, fit.shape, n_steps=200)
        total = total + together - alone
    return total.clamp(min=0)


def _shift(one: GMWMResult, joint: GMWMResult) -> Tensor:
    """Parameters of one recording less those of the joint fit, in its standard errors."""
    return torch.where(one.std_err > 0, (one.params - joint.params) / one.std_err, torch.nan)
