"""Wavelet moments for arrays of inertial sensors in PyTorch.

Names, dimensions and units, the same everywhere; `...` are batch dimensions:

| name | dimensions | unit |
|---|---|---|
| `signal` | `(..., sensor, time)` | any rate unit, kept throughout; `Recording.unit` names it |
| `rate` | scalar | Hz |
| coefficients | list over level of `(..., sensor, time_j)`, `time_j = T - 2**j + 1` | as signal |
| `wavelet_cross_covariance` (WCCV) | `(..., level, sensor, sensor)` | signal^2 |
| `wavelet_variance` (WV) | `(..., level, sensor)` | signal^2 |
| `scale_weights` | `(level,)`, >= 0, sum 1 | - |
| `weights` | `(..., sensor)`, sum 1, may be negative | - |
| virtual signal | `(..., time)` | as signal |

Levels are `j = 1..J` with filters of length `2**j`; NaN is a missing sample. Formulas are numbered as in

- [Z] Zhang, Cucci, Molinari, Guerrier, Scale-wise Variance Minimization for Optimal Virtual Signals: An Approach for
  Redundant Gyroscopes, IEEE Transactions on Signal Processing 70, 2022,
- [V] Voirol, Cucci, Karemera, Chu, Molinari, Guerrier, Accounting for Vibration Noise in Stochastic Measurement Errors,
  arXiv:2303.18167, 2023.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from gyrofuse._base import __version__ as __version__
from gyrofuse._base.deprecation import find_moved_modules, moved_names
from gyrofuse._base.linalg import SingularCovarianceError
from gyrofuse._base.results import ConfidenceInterval
from gyrofuse.export.c_header import to_c_header
from gyrofuse.export.kalibr import to_kalibr
from gyrofuse.fitting.array.gmwm import fit_array_gmwm
from gyrofuse.fitting.bootstrap import bootstrap_gmwm
from gyrofuse.fitting.gmwm import fit_gmwm, fit_gmwm_moments
from gyrofuse.fitting.joint import fit_gmwm_joint
from gyrofuse.fitting.ranking.rank import rank_models
from gyrofuse.fusion.faults.parity import parity_test
from gyrofuse.fusion.faults.reference import fit_parity_reference
from gyrofuse.fusion.live import LiveSVO
from gyrofuse.fusion.multiscale import MultiScaleSVO, fit_multiscale
from gyrofuse.fusion.svo import SVO, fit_svo
from gyrofuse.fusion.weights.baselines import equal_weights, inverse_variance_weights, nonnegative_weights
from gyrofuse.fusion.weights.rdvg import rdvg_weights
from gyrofuse.fusion.weights.svo import SVOWeights, svo_weights
from gyrofuse.io.chunked import ChunkedRecording, open_recording
from gyrofuse.io.reading import read_recording
from gyrofuse.io.recording import Recording
from gyrofuse.io.saturation import mask_saturated
from gyrofuse.io.streams import RecordingError
from gyrofuse.noise.array_model import ArrayModel
from gyrofuse.noise.datasheet import datasheet
from gyrofuse.noise.parsing import model_from_dict, parse_model
from gyrofuse.noise.processes import (
    AR1,
    Drift,
    FlickerNoise,
    Matern32,
    Model,
    QuantizationNoise,
    RandomWalk,
    Sinusoid,
    WhiteNoise,
)
from gyrofuse.noise.state_space import state_space
from gyrofuse.wavelets.covariance import CrossCovariance, wavelet_cross_covariance, wavelet_variance
from gyrofuse.wavelets.haar import HaarFilterBank, haar_coefficients
from gyrofuse.wavelets.intervals import wavelet_cross_covariance_interval, wavelet_variance_interval
from gyrofuse.wavelets.robust import robust_wavelet_variance

if TYPE_CHECKING:
    from gyrofuse.fusion.streaming import stream_svo, write_virtual
    from gyrofuse.mismatch import diagnose
    from gyrofuse.wavelets.metric import WaveletCrossCovariance

__all__ = [
    "AR1",
    "SVO",
    "ArrayModel",
    "ChunkedRecording",
    "ConfidenceInterval",
    "CrossCovariance",
    "Drift",
    "FlickerNoise",
    "HaarFilterBank",
    "LiveSVO",
    "Matern32",
    "Model",
    "MultiScaleSVO",
    "QuantizationNoise",
    "RandomWalk",
    "Recording",
    "RecordingError",
    "SVOWeights",
    "SingularCovarianceError",
    "Sinusoid",
    "WaveletCrossCovariance",
    "WhiteNoise",
    "bootstrap_gmwm",
    "datasheet",
    "diagnose",
    "equal_weights",
    "fit_array_gmwm",
    "fit_gmwm",
    "fit_gmwm_joint",
    "fit_gmwm_moments",
    "fit_multiscale",
    "fit_parity_reference",
    "fit_svo",
    "haar_coefficients",
    "inverse_variance_weights",
    "mask_saturated",
    "model_from_dict",
    "nonnegative_weights",
    "open_recording",
    "parity_test",
    "parse_model",
    "rank_models",
    "rdvg_weights",
    "read_recording",
    "robust_wavelet_variance",
    "state_space",
    "stream_svo",
    "svo_weights",
    "to_c_header",
    "to_kalibr",
    "wavelet_cross_covariance",
    "wavelet_cross_covariance_interval",
    "wavelet_variance",
    "wavelet_variance_interval",
    "write_virtual",
]

# Names whose modules load more than torch and numpy.
_LAZY = {
    "WaveletCrossCovariance": "gyrofuse.wavelets.metric",
    "diagnose": "gyrofuse.mismatch",
    "stream_svo": "gyrofuse.fusion.streaming",
    "write_virtual": "gyrofuse.fusion.streaming",
}

# Names that have left, and where they are now.
_MOVED = {
    "Datasheet": "gyrofuse.noise.Datasheet",
    "Finding": "gyrofuse.mismatch.Finding",
    "MismatchReport": "gyrofuse.mismatch.MismatchReport",
    "ParityReference": "gyrofuse.fusion.ParityReference",
    "StateSpace": "gyrofuse.noise.StateSpace",
    "cross_covariance": "gyrofuse.wavelets.cross_covariance",
    "shrinkage_weights": "gyrofuse.fusion.shrinkage_weights",
    "subset_weights": "gyrofuse.fusion.subset_weights",
    "virtual_noise": "gyrofuse.fitting.virtual_noise",
    **{
        name: f"gyrofuse.fitting.{name}"
        for name in ("ArrayGMWMResult", "GMWMBootstrap", "GMWMResult", "JointFit", "RankResult", "moment_covariance")
    },
    "fit_jointly": "gyrofuse.fitting.joint.fit_gmwm_joint",
    "LongRecording": "gyrofuse.io.chunked.ChunkedRecording",
    "open_long": "gyrofuse.io.chunked.open_recording",
    "stretch_of": "gyrofuse.io.chunked.shard_bounds",
    **{
        name: f"gyrofuse.fusion.{name}"
        for name in (
            "EnoughData",
            "MultiScaleResult",
            "ParityResult",
            "RDVGResult",
            "SVOResult",
            "Selection",
            "StreamedSVOResult",
            "WeightsTest",
        )
    },
    "BootstrapWeightsCovariance": "gyrofuse.fusion.uncertainty.influence.BootstrapWeightsCovariance",
    "Gain": "gyrofuse.fusion.VarianceReduction",
    "block_bootstrap": "gyrofuse.wavelets.block_bootstrap.block_bootstrap",
    "bootstrap_wccv_covariance": "gyrofuse.wavelets.block_bootstrap.bootstrap_wccv_covariance",
    "bootstrap_wccv_interval": "gyrofuse.wavelets.block_bootstrap.bootstrap_wccv_interval",
    "bootstrap_weights_covariance": "gyrofuse.fusion.uncertainty.influence.bootstrap_weights_covariance",
    "fit_parity": "gyrofuse.fusion.faults.reference.fit_parity_reference",
    "find_saturation": "gyrofuse.io.saturation.find_saturation",
    "rdvg": "gyrofuse.fusion.weights.rdvg.rdvg",
    "resolve_scale_weights": "gyrofuse.fusion.weights.svo.resolve_scale_weights",
    "signal_bootstrap": "gyrofuse.wavelets.block_bootstrap.signal_bootstrap",
}
_moved = moved_names(__name__, _MOVED, stacklevel=3)

find_moved_modules()


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        value = getattr(import_module(_LAZY[name]), name)
        globals()[name] = value
        return value
    return _moved(name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
