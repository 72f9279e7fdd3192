"""Noise models fitted to recordings: by wavelet moments, by spectra, and which of several fits."""

from gyrofuse.fitting.array.result import ArrayGMWMResult
from gyrofuse.fitting.bootstrap import GMWMBootstrap
from gyrofuse.fitting.gmwm_result import GMWMResult
from gyrofuse.fitting.joint import JointFit
from gyrofuse.fitting.moments.covariance import moment_covariance
from gyrofuse.fitting.ranking.result import RankResult

__all__ = ["ArrayGMWMResult", "GMWMBootstrap", "GMWMResult", "JointFit", "RankResult", "moment_covariance"]
