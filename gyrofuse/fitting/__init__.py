"""Noise models fitted to recordings: by wavelet moments, by spectra, and which of several fits."""

from gyrofuse.fitting.array.gmwm import fit_array_gmwm_moments
from gyrofuse.fitting.array.result import ArrayGMWMResult
from gyrofuse.fitting.bootstrap import GMWMBootstrap
from gyrofuse.fitting.gmwm_result import GMWMResult
from gyrofuse.fitting.joint import JointFit
from gyrofuse.fitting.moments.covariance import moment_covariance
from gyrofuse.fitting.ranking.rank import rank_models_moments
from gyrofuse.fitting.ranking.result import RankResult
from gyrofuse.fitting.virtual_noise import virtual_noise

__all__ = [
    "ArrayGMWMResult",
    "GMWMBootstrap",
    "GMWMResult",
    "JointFit",
    "RankResult",
    "fit_array_gmwm_moments",
    "moment_covariance",
    "rank_models_moments",
    "virtual_noise",
]
